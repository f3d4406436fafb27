"""Results of runs that never were, for tests of what is made of them."""

from collections.abc import Iterator

import numpy as np
import pandas as pd

from benchmarks.peers.algorithms import A2C, OURS, PPO, TIANSHOU_NPG, TIANSHOU_TRPO, TRPO
from benchmarks.peers.plan import ABLATION_TASKS
from benchmarks.peers.protocol import EVALUATIONS, LONG_STEPS, MUJOCO_STEPS
from benchmarks.peers.variants import SHIPPED

#: final return and seconds of a whole training
ENDS = {
    **{OURS: (3000.0, 100.0), TRPO: (2000.0, 400.0), PPO: (1500.0, 1000.0), A2C: (500.0, 800.0)},
    **dict.fromkeys((TIANSHOU_TRPO, TIANSHOU_NPG), (1000.0, 300.0)),
}
TASKS = ("HalfCheetah-v5", "Hopper-v5")
SEEDS = 3
A_PROCESSOR = "a processor"


def a_run(task: str, algorithm: str, seed: int, steps: int, variant: str = SHIPPED, end: float | None = None) -> pd.DataFrame:
    """
    :return: rows of a run that climbs to its end in the first half of its training, and stays there; seeds differ by 1
    """
    last, seconds = ENDS[algorithm]
    part = np.linspace(0, 1, EVALUATIONS + 1)
    return pd.DataFrame(
        {
            "format": 1,
            "task": task,
            "algorithm": algorithm,
            "variant": variant,
            "seed": seed,
            "steps": steps,
            "step": part * steps,
            "wall_seconds": 1.5 * part * seconds,
            "cpu_seconds": part * seconds,
            "mean_return": np.minimum(1, 2 * part) * ((last if end is None else end) + seed),
            "processor": A_PROCESSOR,
            "former": False,
        }
    )


def results() -> pd.DataFrame:
    """:return: a table with something for every section of the page"""
    return pd.concat(_runs(), ignore_index=True)


def _runs() -> Iterator[pd.DataFrame]:
    for seed in range(SEEDS):
        for task in TASKS:
            yield from (a_run(task, algorithm, seed, MUJOCO_STEPS) for algorithm in (OURS, TRPO, PPO))
        yield a_run(TASKS[0], A2C, seed, MUJOCO_STEPS)
        yield a_run("CartPole-v1", OURS, seed, 100_000, end=450)
        yield a_run("CartPole-v1", TRPO, seed, 100_000, end=500)
        yield a_run("Ant-v5", OURS, seed, LONG_STEPS, end=5000)
        yield a_run(ABLATION_TASKS[2], OURS, seed, MUJOCO_STEPS)
        yield from (a_run(task, OURS, seed, MUJOCO_STEPS, "monte-carlo", end=1500) for task in ABLATION_TASKS)
