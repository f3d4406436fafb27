"""Learning curves as arrays, out of a table of results."""

from typing import NamedTuple

import numpy as np
import pandas as pd

from benchmarks.peers.algorithms import ALGORITHMS
from benchmarks.peers.former import FORMER
from benchmarks.peers.protocol import EVALUATIONS, SCORED_PART
from benchmarks.peers.variants import SHIPPED


class Run(NamedTuple):
    """
    One training. Its arrays have an element for each evaluation, in the order of steps.

    :param seed: of the training
    :param steps: of training until then
    :param seconds: of training until then, of the processor: one thread on a core of its own, so that waiting for it does not
        count; what else runs on the machine still takes of its caches and its clock rate
    :param returns: mean over the episodes
    :param processor: that it ran on; seconds of one say nothing beside those of another
    :param is_former: whether its settings are no longer the shipped ones
    """

    seed: int
    steps: np.ndarray
    seconds: np.ndarray
    returns: np.ndarray
    processor: str
    is_former: bool = False

    @property
    def score(self) -> float:
        """Mean return of the evaluations of the last part; one at least, however large the batches are."""
        return float(self.returns[self.steps > (1 - SCORED_PART) * self.steps[-1]].mean())


def runs_of(table: pd.DataFrame, task: str, algorithm: str, steps: int, variant: str = SHIPPED) -> list[Run]:
    """
    :param table: of results
    :param task: id of the environment
    :param algorithm: key of :data:`~benchmarks.peers.algorithms.ALGORITHMS`
    :param steps: of the trainings
    :param variant: key of :data:`~benchmarks.peers.variants.EVERY_VARIANT`
    :return: in the order of their seeds
    """
    if table.empty:
        return []
    wanted = (table["task"] == task) & (table["algorithm"] == algorithm) & (table["steps"] == steps)
    chosen = table[wanted & (table["variant"] == variant)]
    return [_run(int(seed), rows.sort_values("step")) for seed, rows in chosen.groupby("seed")]


def _run(seed: int, rows: pd.DataFrame) -> Run:
    steps, seconds, returns = (rows[name].to_numpy(float) for name in ("step", "cpu_seconds", "mean_return"))
    return Run(seed, steps, seconds, returns, rows["processor"].iloc[-1], bool(rows[FORMER].iloc[-1]))


def all_runs(table: pd.DataFrame, task: str, steps: int) -> dict[str, list[Run]]:
    """
    :param table: of results
    :param task: id of the environment
    :param steps: of the trainings
    :return: for each algorithm that has any
    """
    found = {algorithm: runs_of(table, task, algorithm, steps) for algorithm in ALGORITHMS}
    return {algorithm: runs for algorithm, runs in found.items() if runs}


def scores_of(runs: list[Run]) -> np.ndarray:
    """
    :param runs: of one algorithm on one task
    :return: a score for each, shape (runs,)
    """
    return np.array([run.score for run in runs])


def against_steps(runs: list[Run], steps: int) -> tuple[np.ndarray, np.ndarray]:
    """
    :param runs: of one algorithm on one task
    :param steps: of the trainings
    :return: steps at which evaluations are due, shape (P,), and the returns there, shape (runs, P), on straight lines between
        the evaluations, which take place at the first update after that
    """
    grid = np.linspace(0, steps, EVALUATIONS + 1)
    return grid, np.stack([np.interp(grid, run.steps, run.returns) for run in runs])


def against_seconds(runs: list[Run]) -> tuple[np.ndarray, np.ndarray]:
    """
    :param runs: of one algorithm on one task
    :return: seconds of training until the fastest run had ended, shape (P,), and the returns then, shape (runs, P)
    """
    grid = np.linspace(0, min(run.seconds[-1] for run in runs), EVALUATIONS + 1)
    return grid, np.stack([np.interp(grid, run.seconds, run.returns) for run in runs])


def first_reach(run: Run, target: float) -> tuple[float, float]:
    """
    :param run: of any algorithm
    :param target: a mean return
    :return: steps and seconds of training before the first evaluation that reached it, infinite if none did
    """
    reached = np.flatnonzero(run.returns >= target)
    if len(reached) == 0:
        return np.inf, np.inf
    return float(run.steps[reached[0]]), float(run.seconds[reached[0]])
