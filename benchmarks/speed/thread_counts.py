"""
What threads do to an iteration, each combination in a process of its own.

torch reads its number of threads from the environment as it starts, and threads that it has once started go on spinning
between products, so what a process has done before would be seen in the next combination.
"""

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

import torch as th

from benchmarks.peers.errors import PeersError
from benchmarks.rollout_speed import make_learner
from benchmarks.speed import results
from benchmarks.speed.iteration_cases import tasks
from benchmarks.speed.split import QUICK_SHAPES, SHAPES
from sb3_gae import TRPOGAE
from sb3_gae.vec_env.choice import batched_vec_env

COUNTS = (1, 2)
#: which would say how many threads torch has
_VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")


class Combination(NamedTuple):
    """
    :param torch: threads of torch, None for what it chooses by itself
    :param physics: threads of the physics, None for what the environments choose by themselves
    """

    torch: int | None
    physics: int | None


#: nothing set first
COMBINATIONS = (Combination(None, None), *(Combination(torch, physics) for torch in COUNTS for physics in COUNTS))


def iterate(task: str, n_envs: int, n_steps: int, which: Combination, rounds: int) -> dict[str, Any]:
    """
    Time iterations in this process.

    :param task: id of the environment
    :param n_envs: environments that are stepped at once
    :param n_steps: of each of them in a rollout
    :param which: numbers of threads
    :param rounds: iterations, after one to warm up
    :return: medians in seconds of the clock and of the processor, and the numbers of threads that there were
    """
    if which.torch is not None:
        th.set_num_threads(which.torch)
    env_kwargs: dict[str, Any] = {"vec_env_cls": batched_vec_env, "vec_env_kwargs": {"n_threads": which.physics}}
    learner = make_learner(TRPOGAE, task, n_envs, n_envs * n_steps, **env_kwargs)
    in_processor = []
    for _ in range(rounds + 1):
        start = time.process_time()
        learner.iterate()
        in_processor.append(time.process_time() - start)
    env: Any = learner.model.env
    times = {"rollout": learner.rollouts, "update": learner.updates, "iteration": learner.wholes, "processor": in_processor}
    return {
        "torch_threads": th.get_num_threads(),
        "physics_threads": env.unwrapped.n_threads if hasattr(env.unwrapped, "n_threads") else 1,
        **{name: float(f"{median(seconds[1:]):.4g}") for name, seconds in times.items()},
    }


def threads(output: Path, quick: bool) -> None:
    """
    :param output: file of results, to be written
    :param quick: whether to do next to nothing
    :raises PeersError: if a combination fails
    """
    shapes = QUICK_SHAPES if quick else SHAPES
    rows = list(_rows({task: shapes[task] for task in tasks()}, rounds=2 if quick else 9))
    results.write(output, rows, quick=quick)


def _rows(shapes: dict[str, tuple[int, int]], rounds: int) -> Iterator[dict[str, Any]]:
    for task, (n_envs, n_steps) in shapes.items():
        for which in COMBINATIONS:
            asked = {"task": task, "batch": n_envs * n_steps, "rounds": rounds, "nothing_set": which.torch is None}
            yield asked | _in_process(task, n_envs, n_steps, which, rounds)


def _in_process(task: str, n_envs: int, n_steps: int, which: Combination, rounds: int) -> dict[str, Any]:
    job = json.dumps([task, n_envs, n_steps, which, rounds])
    environment = {name: value for name, value in os.environ.items() if name not in _VARIABLES}
    command = [sys.executable, "-m", __name__, job]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise PeersError(f"Iterations of {task} failed with {which}:\n{done.stderr}")
    return json.loads(done.stdout.splitlines()[-1])


if __name__ == "__main__":
    _task, _n_envs, _n_steps, _which, _rounds = json.loads(sys.argv[1])
    print(json.dumps(iterate(_task, _n_envs, _n_steps, Combination(*_which), _rounds)))
