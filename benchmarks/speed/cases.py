"""All that is timed, contenders of one size next to each other."""

from collections.abc import Callable, Iterator

from benchmarks.speed.advantage_cases import advantage_cases
from benchmarks.speed.case import Case
from benchmarks.speed.iteration_cases import iteration_cases, stepping_cases
from benchmarks.speed.plan import Plan
from benchmarks.speed.product_cases import product_cases
from benchmarks.speed.update_cases import update_cases

_SOURCES: tuple[Callable[[Plan], Iterator[Case]], ...] = (
    advantage_cases,
    product_cases,
    update_cases,
    stepping_cases,
    iteration_cases,
)


def all_cases(plan: Plan) -> list[Case]:
    """
    :param plan: with the sizes
    :return: in the order in which they are timed
    """
    return [case for source in _SOURCES for case in source(plan)]
