"""The pages of the benchmark against peers, README among them, say what the committed results say."""

import pytest

from benchmarks.peers import report
from benchmarks.peers.former import marked
from benchmarks.peers.page import filled
from benchmarks.peers.table import read_results


@pytest.fixture(scope="module")
def sections() -> dict[str, str]:
    return report.sections_of(marked(read_results()))


@pytest.mark.parametrize("path", report.PAGES)
def test_the_page_says_what_the_committed_results_say(path: str, sections: dict[str, str]) -> None:
    page = (report.ROOT / path).read_text()
    own = {name: sections[name] for name in report.PAGES[path]}
    assert page == filled(page, own), "run: python -m benchmarks.peers report"


def test_each_section_is_on_a_page(sections: dict[str, str]) -> None:
    assert set(sections) == {name for names in report.PAGES.values() for name in names}
