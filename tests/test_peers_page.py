"""The results page of the benchmark against peers, and README, say what the committed results say."""

import pytest

from benchmarks.peers import report
from benchmarks.peers.page import filled
from benchmarks.peers.table import read_results


@pytest.fixture(scope="module")
def sections() -> dict[str, str]:
    return report.sections_of(read_results())


def test_the_page_says_what_the_committed_results_say(sections: dict[str, str]) -> None:
    page = report.PAGE.read_text()
    assert page == filled(page, sections), "run: python -m benchmarks.peers report"


def test_readme_says_what_the_committed_results_say(sections: dict[str, str]) -> None:
    readme = report.README.read_text()
    assert readme == filled(readme, {name: sections[name] for name in report.OF_README}), (
        "run: python -m benchmarks.peers report"
    )
