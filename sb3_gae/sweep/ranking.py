"""Curves of a sweep from best to worst, with what the bands allow to say of their order."""

from typing import NamedTuple

import numpy as np
import pandas as pd

from sb3_gae.sweep.conditions import CONDITIONS
from sb3_gae.sweep.figures.wording import with_interval
from sb3_gae.sweep.grid import Curve
from sb3_gae.sweep.series import scores_of, series_of
from sb3_gae.sweep.statistics import Estimate, difference, estimate_each

#: for a bootstrap over runs; of 3 against 3 it finds a difference in every fifth pair of equals
_ENOUGH_SEEDS = 5


class Rank(NamedTuple):
    """
    One curve among others; estimates have arrays of shape (1,).

    :param curve: what its runs have in common
    :param n_seeds: number of runs
    :param training: mean return over all iterations, the area under the learning curve: how fast it learns
    :param last: return at the chosen iteration
    :param behind: how far the best curve is ahead, by the criterion of the ranking; None for the best itself
    """

    curve: Curve
    n_seeds: int
    training: Estimate
    last: Estimate
    behind: Estimate | None


def rank_curves(table: pd.DataFrame, iteration: int | None = None, by: str = "training") -> list[Rank]:
    """
    :param table: what a :class:`~sb3_gae.sweep.selection.Selection` kept
    :param iteration: from 1; None for the last. Later ones do not count
    :param by: ``training`` or ``last``, see :class:`Rank`
    :return: the best one first
    :raises SweepError: if ``by`` is unknown, the runs are shorter, or in some no episode had ended by then
    """
    series = series_of(table)
    scores = scores_of(series, by, iteration).values
    of_training, of_last = (estimate_each(scores_of(series, each, iteration).values) for each in ("training", "last"))
    ranked = of_training if by == "training" else of_last
    order = np.argsort([-float(found.iqm[0]) for found in ranked], kind="stable")
    best = scores[order[0]]
    return [
        Rank(
            series[place].curve,
            series[place].n_seeds,
            of_training[place],
            of_last[place],
            difference(best, scores[place]) if place != order[0] else None,
        )
        for place in order
    ]


def caution(ranks: list[Rank]) -> str:
    """
    :param ranks: any
    :return: what to bear in mind of the intervals, empty if there is nothing
    """
    if all(rank.n_seeds >= _ENOUGH_SEEDS for rank in ranks):
        return ""
    return f"With fewer than {_ENOUGH_SEEDS} seeds the intervals are too narrow to tell chance."


def as_markdown(ranks: list[Rank]) -> str:
    """
    :param ranks: the best first
    :return: a table
    """
    lines = [
        "| condition | γ | λ | seeds | mean over training | at the end | behind the best by |",
        "| --- | ---: | ---: | ---: | ---: | ---: | ---: |",
    ]
    for curve, n_seeds, training, last, behind in ranks:
        gae_lambda = "" if curve.gae_lambda is None else f"{curve.gae_lambda:g}"
        cells = [CONDITIONS[curve.condition].title, f"{curve.gamma:g}", gae_lambda, str(n_seeds)]
        cells += [with_interval(training), with_interval(last), "" if behind is None else with_interval(behind)]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)
