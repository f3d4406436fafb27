"""Short learning runs with fixed seeds: the mean return of the training episodes over the whole run."""

from collections.abc import Iterable

import numpy as np
import torch as th

from sb3_gae.sweep.experiment import Experiment
from sb3_gae.sweep.grid import Cell
from sb3_gae.sweep.plan import Options
from sb3_gae.sweep.recorder import Row

#: shipped settings, but for the last: a value fit that follows the batch as far as it can, so that the order of the
#: two steps tells
RUNS = {
    "CartPole-v1": Cell("CartPole-v1", "trust_region", 0.98, 0.98, seed=0, iterations=25),
    "HalfCheetah-v5": Cell("HalfCheetah-v5", "trust_region", 0.99, 0.95, seed=0, iterations=16),
    "CartPole-v1, order of the steps": Cell(
        "CartPole-v1",
        "trust_region",
        0.98,
        0.98,
        seed=0,
        iterations=25,
        overrides='{"vf_steps": 40, "vf_trust_region": 10.0}',
    ),
}
#: of the gate; what it is judged by is recorded with other seeds as well
SEEDS = range(4)


def learning_scores(name: str, seeds: Iterable[int] = SEEDS) -> list[float]:
    """
    :param name: a key of :data:`RUNS`
    :param seeds: of the runs
    :return: one number for each seed
    """
    th.set_num_threads(1)
    return [score(RUNS[name], seed) for seed in seeds]


def score(cell: Cell, seed: int) -> float:
    """
    :param cell: whose seed is another one
    :param seed: of the run
    :return: the mean over iterations of the mean return of the episodes that ended in them
    """
    rows: list[Row] = []
    named = Cell(cell.task, cell.condition, cell.gamma, cell.gae_lambda, seed, cell.iterations, cell.overrides)
    Experiment(named, Options(device="cpu")).run(rows.append)
    return float(np.nanmean([row["mean_return"] for row in rows]))
