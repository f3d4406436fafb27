"""
How fast whole iterations are with Ray workers, beside one process, SubprocVecEnv, and sb3-contrib's TRPO.

    python benchmarks/ray_speed.py                              # writes benchmarks/results/ray_speed.csv
    python benchmarks/ray_speed.py --tasks BipedalWalker-v3 --rounds 5
    python benchmarks/ray_speed.py --address 10.0.0.1:6379      # workers of a cluster, such as hosts in network namespaces
    python benchmarks/ray_speed.py --messages                   # only what a further worker costs
    python benchmarks/ray_speed.py --smoke                      # tiny, to see that it runs; writes nothing

BipedalWalker-v3 is a plain gymnasium environment that has no batched form; the quadruped and the biped have one. Networks
are 100-50-25 and observations are normalized for all. All ways are at work in turn, round by round, so that a busy
machine slows all of them; the first round warms up. Workers have one thread each. Nothing else should run.

Rows hold the seconds of rollout and update of one iteration and, for workers, what ``RayVecEnv.last_collection`` says.
"""

import argparse
import csv
import itertools
import os
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

import ray
import torch as th
from rollout_speed import Learner, make_learner
from sb3_contrib import TRPO
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

from sb3_gae import TRPOGAE, RayVecEnv
from sb3_gae.vec_env.choice import batched_vec_env

RESULTS = Path(__file__).parent / "results" / "ray_speed.csv"
FIELDS = ("task", "way", "workers", "n_envs", "batch", "cores", "round", "rollout_s", "update_s", "collection_s", "worker_s")
FIELDS += ("weights_bytes", "shares_bytes", "states_bytes")
WORKERS = (1, 2)

#: of these the smallest batches are timed, to tell what each further worker costs
MESSAGES_TASK, MESSAGES_WORKERS, MESSAGES_STEPS = "GaeQuadruped-v0", (1, 2, 4, 8, 16), 8


class Task(NamedTuple):
    """
    :param env: id
    :param n_envs: of ours, in one process and on all workers together
    :param subproc_envs: of a SubprocVecEnv, each a process of its own; all are run, and the fastest counts
    :param batch: steps of an iteration
    :param peer_batch: of the ways that send each step of each environment through a pipe, or step one after another: a step
        takes as long in any batch, and a batch of 200 000 would take them minutes
    """

    env: str
    n_envs: int
    subproc_envs: tuple[int, ...]
    batch: int
    peer_batch: int


class Way(NamedTuple):
    """
    :param name: what collects
    :param workers: number of workers or processes
    :param n_envs: at once
    :param make: the learner, ready to iterate
    """

    name: str
    workers: int
    n_envs: int
    make: Callable[[], Learner]


TASKS = (
    Task("BipedalWalker-v3", 16, (2, 8, 16), 20_000, 20_000),
    Task("GaeQuadruped-v0", 256, (2, 16), 200_000, 10_000),
    Task("GaeBiped-v0", 256, (2, 16), 50_000, 10_000),
)
SMOKE = (Task("BipedalWalker-v3", 2, (2,), 64, 64), Task("GaeQuadruped-v0", 4, (2,), 64, 64))


def ways(task: Task, workers: Sequence[int]) -> Iterator[Way]:
    def learner(algorithm: Any, n_envs: int, **env_kwargs: Any) -> Callable[[], Learner]:
        batched = env_kwargs["vec_env_cls"] not in (SubprocVecEnv, DummyVecEnv)
        return lambda: make_learner(algorithm, task.env, n_envs, task.batch if batched else task.peer_batch, **env_kwargs)

    yield Way("one process", 0, task.n_envs, learner(TRPOGAE, task.n_envs, vec_env_cls=batched_vec_env))
    for k in workers:
        env_kwargs = {"vec_env_cls": RayVecEnv, "vec_env_kwargs": {"n_workers": k}}
        yield Way("ray workers", k, task.n_envs, learner(TRPOGAE, task.n_envs, **env_kwargs))
    for n_envs in task.subproc_envs:
        yield Way("SubprocVecEnv", n_envs, n_envs, learner(TRPOGAE, n_envs, vec_env_cls=SubprocVecEnv))
        yield Way("sb3-contrib, SubprocVecEnv", n_envs, n_envs, learner(TRPO, n_envs, vec_env_cls=SubprocVecEnv))
    n_envs = max(task.subproc_envs)
    yield Way("sb3-contrib, DummyVecEnv", 0, n_envs, learner(TRPO, n_envs, vec_env_cls=DummyVecEnv))


def measure(task: Task, rounds: int, workers: Sequence[int]) -> Iterator[dict[str, Any]]:
    running = [(way, way.make()) for way in ways(task, workers)]
    for number, (way, learner) in itertools.product(range(rounds + 1), running):
        learner.iterate()
        if number > 0:
            yield row(task, way, learner, number)
    for _, learner in running:
        assert learner.model.env is not None
        learner.model.env.close()


def messages(counts: Sequence[int], rounds: int) -> Iterator[dict[str, Any]]:
    """Batches of a few steps, with one environment on each worker."""
    for k in counts:
        task = Task(MESSAGES_TASK, k, (), k * MESSAGES_STEPS, 0)
        env_kwargs = {"vec_env_cls": RayVecEnv, "vec_env_kwargs": {"n_workers": k}}
        way = Way("messages", k, k, lambda: make_learner(TRPOGAE, task.env, k, task.batch, **env_kwargs))  # noqa: B023
        learner = way.make()
        for number in range(rounds + 1):
            learner.iterate()
            if number > 0:
                yield row(task, way, learner, number)
        assert learner.model.env is not None
        learner.model.env.close()


def row(task: Task, way: Way, learner: Learner, number: int) -> dict[str, Any]:
    assert learner.model.env is not None
    found: dict[str, Any] = {
        "task": task.env,
        "way": way.name,
        "workers": way.workers,
        "n_envs": way.n_envs,
        "batch": learner.model.n_steps * way.n_envs,
        "cores": os.cpu_count(),
        "round": number,
        "rollout_s": f"{learner.rollouts[-1]:.4f}",
        "update_s": f"{learner.updates[-1]:.4f}",
    }
    base = learner.model.env.unwrapped
    if isinstance(base, RayVecEnv) and (record := base.last_collection) is not None:
        found |= {"collection_s": f"{record.seconds:.4f}", "worker_s": f"{record.worker_seconds:.4f}"}
        found |= {name: getattr(record, name) for name in ("weights_bytes", "shares_bytes", "states_bytes")}
    return found


def report(rows: Sequence[dict[str, Any]]) -> None:
    """Median speeds, and by how much each way is behind the workers, round by round."""
    key = lambda row: (row["way"], int(row["workers"]), int(row["n_envs"]))  # noqa: E731
    speeds = {
        way: [int(row["batch"]) / (float(row["rollout_s"]) + float(row["update_s"])) for row in group]
        for way, group in itertools.groupby(sorted(rows, key=key), key)
    }
    fastest = max((way for way in speeds if way[0] == "ray workers"), key=lambda way: median(speeds[way]))
    print(f"\n{rows[0]['task']}, {rows[0]['cores']} cores")
    for way, values in sorted(speeds.items(), key=lambda item: -median(item[1])):
        ratios = [ours / theirs for ours, theirs in zip(speeds[fastest], values, strict=True)]
        print(
            f"  {way[0]:28s} {way[1]:3d} workers {way[2]:4d} envs {median(values):9.0f} steps/s; {fastest[1]} Ray worker(s) "
            f"are {median(ratios):.2f} times as fast ({min(ratios):.2f} to {max(ratios):.2f})"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", choices=[task.env for task in TASKS], default=[task.env for task in TASKS])
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--workers", type=int, nargs="+", default=WORKERS)
    parser.add_argument("--address", help="of a Ray cluster; else one is started on this machine")
    parser.add_argument("--out", type=Path, default=RESULTS)
    parser.add_argument("--messages", action="store_true", help="only the smallest batches, in place of those of the file")
    parser.add_argument("--smoke", action="store_true", help="tiny, and nothing is written")
    args = parser.parse_args()
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    if args.address:
        os.environ["RAY_ADDRESS"] = args.address
    else:
        # A place for the workers of all ways, which are there at once and at work in turn
        ray.init(num_cpus=max(sum(args.workers), *MESSAGES_WORKERS), include_dashboard=False)
    warnings.filterwarnings("ignore", message="You have specified a mini-batch size")
    print(f"Python {sys.version.split()[0]}, torch {th.__version__}, {th.get_num_threads()} threads")
    rows: list[dict[str, Any]] = []
    tasks: Sequence[Task] = SMOKE if args.smoke else [task for task in TASKS if task.env in args.tasks]
    if args.messages:
        tasks = ()
        with args.out.open(newline="") as file:
            rows = [row for row in csv.DictReader(file) if row["way"] != "messages"]
    for task in tasks:
        of_task = list(measure(task, 1 if args.smoke else args.rounds, args.workers))
        report(of_task)
        rows.extend(of_task)
        if not args.smoke:
            write(rows, args.out)
    rows.extend(of_messages := list(messages((1, 2) if args.smoke else MESSAGES_WORKERS, 2 if args.smoke else 20)))
    print("\nbatches of 8 steps a worker:")
    for k, group in itertools.groupby(of_messages, lambda row: row["workers"]):
        print(f"  {k:3d} workers {median(float(row['collection_s']) for row in group) * 1000:.1f} ms")
    if not args.smoke:
        write(rows, args.out)


def write(rows: Sequence[dict[str, Any]], path: Path) -> None:
    path.parent.mkdir(exist_ok=True)
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, FIELDS)
        writer.writeheader()
        writer.writerows(rows)


if __name__ == "__main__":
    main()
