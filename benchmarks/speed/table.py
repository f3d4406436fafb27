"""The timed rows by what was done, what was varied, and who did it."""

from collections.abc import Iterator, Mapping, Sequence
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


class Target(NamedTuple):
    """
    :param title: for people
    :param part: what is timed
    :param largest: the most that ours may cost, in units of the limit
    :param varied: at the largest batch, or number of environments, that is timed
    """

    title: str
    part: str
    largest: float
    varied: str = "batch"


TARGETS = (
    Target("update: at most 2 times the matrix products of its arithmetic", "update", 2.0),
    Target("collecting: at most 1.5 times the batched physics, GaeBiped-v0", "rollout, GaeBiped-v0", 1.5),
    Target("collecting: at most 1.5 times the batched physics, HalfCheetah-v5", "rollout, HalfCheetah-v5", 1.5),
    Target("… with more environments", "rollout, HalfCheetah-v5", 1.5, "environments"),
    Target("the biped end to end: at least 0.3 of the speed of open-loop physics", "iteration, GaeBiped-v0", 1 / 0.3),
)


def groups_of(rows: Sequence[Row]) -> list[Group]:
    """
    :param rows: of results
    :return: in the order of the results
    """
    names = dict.fromkeys((row["part"], row["varied"]) for row in rows)
    return [Group(*name, [row for row in rows if (row["part"], row["varied"]) == name]) for name in names]


def judged(groups: Sequence[Group]) -> Iterator[tuple[Target, int, float]]:
    """
    :param groups: of results
    :return: each target that something was timed for, the largest size, and ours in units of the limit there
    """
    by_name = {(group.part, group.varied): group for group in groups}
    for target in TARGETS:
        group = by_name.get((target.part, target.varied))
        if group is not None and (found := group.ratio(OURS, LIMIT, group.sizes[-1])) is not None:
            yield target, group.sizes[-1], found


#: as the tables and figures call them
TITLES = {OURS: "ours", "double backward": "ours, by double backward", PEER: "peer", LIMIT: "limit"}
