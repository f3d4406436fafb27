"""How many steps a second each algorithm takes on each task, roughly: for the estimate of a dry run."""

import csv
import math
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch as th

from benchmarks.peers.algorithms import ALGORITHMS
from benchmarks.peers.clock import TrainingClock
from benchmarks.peers.cost import COLUMNS, EVALUATION
from benchmarks.peers.evaluation import Act
from benchmarks.peers.plan import Cell, cells_of
from benchmarks.peers.recorder import Recorder
from benchmarks.peers.settings import settings_of
from benchmarks.peers.variants import SHIPPED

# Two batches of algorithms that have large ones
_LEAST_STEPS = 1_000
_PROBED_STEPS = 1_000


class NoEvaluations(Recorder):
    """In the place of a recorder where only time matters."""

    def __init__(self) -> None:
        pass

    def next_after(self, steps: int) -> float:  # type: ignore[override]
        return math.inf

    def evaluate(self, steps: int, act: Act) -> None:
        pass


def measure(path: Path, tasks: list[str]) -> None:
    """
    Train for two batches each, and write the speeds as they are found; what stands in the file is not measured again, and a
    peer that is not installed is left out.

    :param path: of the table
    :param tasks: ids of environments
    """
    th.set_num_threads(1)
    new = not path.exists()
    with path.open("a+", newline="") as file:
        file.seek(0)
        known = {(row["task"], row["algorithm"]) for row in ([] if new else csv.DictReader(file))}
        writer = csv.writer(file, lineterminator="\n")
        if new:
            writer.writerow(COLUMNS)
        for task, algorithm in _pairs(tasks):
            if (task, algorithm) in known:
                continue
            try:
                speed = speed_of_evaluation(task) if algorithm == EVALUATION else speed_of(task, algorithm)
            except ModuleNotFoundError as error:
                print(f"{task} {algorithm}: not measured ({error})", flush=True)
                continue
            writer.writerow([task, algorithm, round(speed)])
            file.flush()
            print(f"{task} {algorithm}: {speed:.0f} steps in a second of one core", flush=True)


def _pairs(tasks: list[str]) -> Iterator[tuple[str, str]]:
    for task in tasks:
        yield task, EVALUATION
        yield from dict.fromkeys((task, cell.algorithm) for cell in cells_of(["classic", "mujoco"]) if cell.task == task)


def speed_of(task: str, algorithm: str) -> float:
    """
    :param task: id of the environment
    :param algorithm: to measure
    :return: steps in a second of one core, from two batches at the beginning of a training
    """
    cell = Cell(task, algorithm, SHIPPED, 0, _LEAST_STEPS)
    settings = settings_of(cell)
    clock = TrainingClock()
    with tempfile.TemporaryDirectory() as folder:
        if ALGORITHMS[algorithm].library == "tianshou":
            from benchmarks.peers.tianshou_run import run_in_tianshou

            cell = cell._replace(steps=2 * settings["collection_step_num_env_steps"])
            steps = run_in_tianshou(cell, settings, Path(folder), clock, NoEvaluations())
        else:
            from benchmarks.peers.zoo_run import run_in_zoo

            cell = cell._replace(steps=max(_LEAST_STEPS, 2 * settings.get("n_steps", 1) * settings.get("n_envs", 1)))
            steps = run_in_zoo(cell, settings | {"n_timesteps": cell.steps}, Path(folder), clock, NoEvaluations(), None)
    return steps / clock.read()[1]


def speed_of_evaluation(task: str) -> float:
    """
    :param task: id of the environment
    :return: steps of an evaluation in a second of one core, with a policy of the usual size
    """
    import gymnasium as gym
    from stable_baselines3 import A2C

    env = gym.make(task)
    model = A2C("MlpPolicy", env, device="cpu")
    observation, _ = env.reset(seed=0)
    start = time.process_time()
    for i in range(_PROBED_STEPS):
        # A tenth of the calls, each for ten environments as in an evaluation
        if i % 10 == 0:
            actions = model.predict(np.stack([observation] * 10), deterministic=True)[0]
        observation, _, terminated, truncated, _ = env.step(actions[0])
        if terminated or truncated:
            observation, _ = env.reset()
    return _PROBED_STEPS / (time.process_time() - start)
