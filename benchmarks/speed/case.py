"""One thing that is timed, at one size."""

from collections.abc import Callable, Mapping
from typing import NamedTuple

#: who does it: this package; this package for networks that are no MLPs; sb3-contrib or SB3; nobody can do it faster
OURS, DOUBLE_BACKWARD, PEER, LIMIT = "ours", "double backward", "peer", "limit"


class Prepared(NamedTuple):
    """
    :param call: what is timed
    :param before: puts things back before each call, and is not timed; None for nothing
    :param repeats: how many of what the cost is of are in a call
    :param facts: to be kept beside the times, numbers by name
    """

    call: Callable[[], object]
    before: Callable[[], object] | None = None
    repeats: int = 1
    facts: Mapping[str, int] = {}


class Case(NamedTuple):
    """
    :param part: what is done
    :param varied: which size is varied
    :param size: its value
    :param contender: who does it
    :param prepare: everything up to the first call
    """

    part: str
    varied: str
    size: int
    contender: str
    prepare: Callable[[], Prepared]

    def __str__(self) -> str:
        return f"{self.part}, {self.varied} {self.size}, {self.contender}"
