"""Arrays for figures, out of a table of results."""

import math
from typing import NamedTuple

import numpy as np
import pandas as pd

from sb3_gae.sweep.conditions import CONDITIONS, find_condition
from sb3_gae.sweep.errors import SweepError
from sb3_gae.sweep.grid import Curve

#: one number for a run: its return at an iteration, or the mean over all until then, the area under its learning curve
SCORES = ("last", "training")


class Series(NamedTuple):
    """
    :param curve: what the runs have in common
    :param returns: mean return of the episodes of each iteration, shape (seeds, iterations); the last known one where none
        ended
    :param ended: whether episodes ended in the iteration, shape (seeds, iterations)
    """

    curve: Curve
    returns: np.ndarray
    ended: np.ndarray

    @property
    def n_seeds(self) -> int:
        """Number of runs."""
        return len(self.returns)


def series_of(table: pd.DataFrame) -> list[Series]:
    """
    :param table: results of one task, with runs of one length
    :return: one for each curve: in the order of conditions, γ rising, λ falling
    :raises SweepError: if a condition is unknown, or runs of a curve do not have the same iterations, each once
    """
    found = []
    for (condition, gamma, gae_lambda), rows in table.groupby(["condition", "gamma", "gae_lambda"], dropna=False):
        find_condition(condition)
        # What is not there is no iteration without an episode, and must not be filled in
        if rows.duplicated(["seed", "iteration"]).any() or len(rows) != rows["seed"].nunique() * rows["iteration"].max():
            of_lambda = "" if math.isnan(gae_lambda) else f", λ = {gae_lambda:g}"
            raise SweepError(f"Runs of {condition}, γ = {gamma:g}{of_lambda} are not whole, or there twice.")
        wide = rows.pivot(index="seed", columns="iteration", values="mean_return")
        # In some batches no episode ends; the last known return stands for them
        returns = wide.ffill(axis="columns").to_numpy()
        curve = Curve(gamma, None if math.isnan(gae_lambda) else gae_lambda, condition)
        found.append(Series(curve, returns, wide.notna().to_numpy()))
    names = list(CONDITIONS)
    without_vf_first = {name: (CONDITIONS[name].uses_lambda, names.index(name)) for name in names}
    return sorted(
        found, key=lambda one: (without_vf_first[one.curve.condition], one.curve.gamma, -(one.curve.gae_lambda or 0.0))
    )


class Scores(NamedTuple):
    """
    :param values: of each series, of shape (seeds,)
    :param when: they are from, for labels
    """

    values: list[np.ndarray]
    when: str


def scores_of(series: list[Series], by: str = "last", iteration: int | None = None) -> Scores:
    """
    :param series: of runs of one length
    :param by: one of :data:`SCORES`
    :param iteration: from 1, later ones do not count; None for the last
    :return: a number for each run
    :raises SweepError: if ``by`` is unknown, the runs are shorter, or in some no episode had ended by then
    """
    if by not in SCORES:
        raise SweepError(f"`by` must be one of {', '.join(SCORES)}, got {by!r}.")
    n_iterations = series[0].returns.shape[1]
    iteration = n_iterations if iteration is None else iteration
    if not 1 <= iteration <= n_iterations:
        raise SweepError(f"`iteration` must be from 1 to {n_iterations}, the length of the runs, got {iteration}.")
    if any(np.isnan(one.returns[:, iteration - 1]).any() for one in series):
        raise SweepError(f"`iteration`: in some runs no episode had ended by iteration {iteration}; choose a later one.")
    if by == "last":
        return Scores([one.returns[:, iteration - 1] for one in series], f"at iteration {iteration}")
    # In the first batches of long episodes none may have ended
    means = [np.nanmean(one.returns[:, :iteration], axis=1) for one in series]
    return Scores(means, f"over {iteration} iterations")


def with_lambda(series: list[Series]) -> list[Series]:
    """
    :param series: of a figure that shows one condition
    :return: those that have a λ
    :raises SweepError: if they are of several conditions, or there is none
    """
    found = [one for one in series if one.curve.gae_lambda is not None]
    conditions = sorted({one.curve.condition for one in found})
    if len(conditions) != 1:
        held = f"the selection has {', '.join(conditions)}; choose with --conditions" if found else "the selection has none"
        raise SweepError(f"This figure shows one condition that has a λ, and {held}.")
    return found
