"""Numbers and names as the pages of results write them."""

import math

from benchmarks.peers.aggregates import Interval
from benchmarks.peers.algorithms import ALGORITHMS
from benchmarks.peers.comparison import score
from benchmarks.peers.curves import Run, scores_of
from benchmarks.peers.plan import FEW_SEEDS
from sb3_gae.sweep.statistics import interquartile_mean

_FORMER_SIGN = "†"


def number(value: float) -> str:
    """
    :param value: any
    :return: whole, with spaces between thousands; two digits behind the point if it is small
    """
    return f"{value:.2f}" if abs(value) < 10 else f"{value:,.0f}".replace(",", " ")


def decimal_text(interval: Interval, n_runs: int) -> str:
    """
    :param interval: of an estimate
    :param n_runs: behind it
    :return: the interval as well, where there are runs enough for one: of one or two it would say nothing of chance
    """
    return f"{interval.point:.2f}" + f" [{interval.low:.2f}, {interval.high:.2f}]" * (n_runs >= FEW_SEEDS)


def seconds_text(value: float) -> str:
    """
    :param value: seconds, infinite for never
    :return: whole ones
    """
    return f"{value:.0f} s" if math.isfinite(value) else "never"


def short_title(name: str) -> str:
    """
    :param name: key of :data:`~benchmarks.peers.algorithms.ALGORITHMS`
    :return: its title in a sentence, such as ``sb3-contrib's TRPO``
    """
    title, _, owner = ALGORITHMS[name].title.partition(", ")
    return f"{owner}'s {title}" if owner else title.split(" (")[0]


def score_text(runs: list[Run] | None) -> str:
    """
    :param runs: of one algorithm on one task
    :return: interquartile mean, its interval if there are runs enough, how many there are, and a sign if their settings are no
        longer shipped
    """
    if not runs:
        return ""
    if len(runs) < FEW_SEEDS:
        text = f"{number(float(interquartile_mean(scores_of(runs))))} ({len(runs)} run{'s' * (len(runs) > 1)})"
    else:
        found = score(runs)
        text = f"{number(found.point)} [{number(found.low)}, {number(found.high)}] ({len(runs)})"
    return text + f" {_FORMER_SIGN}" * is_any_former(runs)


def is_any_former(runs: list[Run]) -> bool:
    """
    :param runs: of one algorithm on one task
    :return: whether any is of settings that are no longer shipped
    """
    return any(run.is_former for run in runs)


def with_note(markdown: str) -> str:
    """
    :param markdown: a table
    :return: with what the sign in it means, if it is there
    """
    note = f"\n\n{_FORMER_SIGN} Of settings that are no longer shipped."
    return markdown + note * (_FORMER_SIGN in markdown)
