"""Pages of results: text by hand, and between markers what comes from the results."""

import re
from collections.abc import Mapping, Sequence

from benchmarks.peers.errors import PeersError


def filled(page: str, sections: Mapping[str, str]) -> str:
    """
    :param page: its text
    :param sections: what belongs between the markers of each name; nothing where there are no results yet
    :return: the text with these sections, and all else as it was
    :raises PeersError: if a marker is missing
    """
    for name, content in sections.items():
        between = re.compile(rf"(<!-- results: {re.escape(name)} -->\n)(?:(?!<!-- results: ).)*?(<!-- end -->)", re.DOTALL)
        if len(between.findall(page)) != 1:
            raise PeersError(f"`page` must have the markers of {name!r} once: <!-- results: {name} --> and <!-- end -->.")
        body = f"\n{content}\n\n" if content else ""
        page = between.sub(lambda match, body=body: match[1] + body + match[2], page)  # type: ignore[misc]
    return page


def markdown_table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """
    :param heads: of the columns
    :param rows: as many cells each
    :return: nothing at all where there are no rows: a table without numbers would be read as one with
    """
    if not rows:
        return ""
    return "\n".join("| " + " | ".join(row) + " |" for row in (heads, ["---"] * len(heads), *rows))
