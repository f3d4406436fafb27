"""The timed rows by what was done, what was varied, and who did it."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from benchmarks.speed.case import LIMIT, OURS, PEER
from benchmarks.speed.growth import exponent

Row = Mapping[str, Any]


class Group(NamedTuple):
    """
    One part against one size.

    :param part: what was done
    :param varied: which size was varied
    :param rows: of all contenders at all sizes
    """

    part: str
    varied: str
    rows: Sequence[Row]

    @property
    def sizes(self) -> list[int]:
        """Increasing."""
        return sorted({row["size"] for row in self.rows})

    @property
    def contenders(self) -> list[str]:
        """In the order in which they were timed."""
        return list(dict.fromkeys(row["contender"] for row in self.rows))

    def at(self, contender: str, size: int) -> Row | None:
        """
        :param contender: who did it
        :param size: of :attr:`sizes`
        :return: what was found, None if nothing was
        """
        found = [row for row in self.rows if (row["contender"], row["size"]) == (contender, size)]
        return found[0] if found else None

    def ratio(self, contender: str, other: str, size: int) -> float | None:
        """
        :param contender: who did it
        :param other: who else did
        :param size: of :attr:`sizes`
        :return: the cost of the former over that of the latter, None if one is missing
        """
        above, below = self.at(contender, size), self.at(other, size)
        return None if above is None or below is None else above["median"] / below["median"]

    def growth(self, contender: str) -> float:
        """
        :param contender: who did it
        :return: see :func:`~benchmarks.speed.growth.exponent`
        """
        rows = [row for row in self.rows if row["contender"] == contender]
        return exponent([row["size"] for row in rows], [row["median"] for row in rows])


def groups_of(rows: Sequence[Row]) -> list[Group]:
    """
    :param rows: of results
    :return: in the order of the results
    """
    names = dict.fromkeys((row["part"], row["varied"]) for row in rows)
    return [Group(*name, [row for row in rows if (row["part"], row["varied"]) == name]) for name in names]


#: as the tables and figures call them
TITLES = {OURS: "ours", "double backward": "ours, by double backward", PEER: "peer", LIMIT: "limit"}
