"""The results page of the benchmark against peers says what the committed results say."""

from benchmarks.peers import report
from benchmarks.peers.page import filled
from benchmarks.peers.table import read_results


def test_the_page_says_what_the_committed_results_say() -> None:
    page = report.PAGE.read_text()
    assert page == filled(page, report.sections_of(read_results())), "run: python -m benchmarks.peers report"
