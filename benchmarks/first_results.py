"""
What the shipped settings reach: rl-zoo3's own commands over several seeds, each agent played by a process of its own.

    python -m benchmarks.first_results            # about an hour on two cores
    python -m benchmarks.first_results --summary  # only the table, from the stored results

Each run is ``python -m rl_zoo3.train --algo trpo_gae --env TASK --seed SEED`` with nothing else set, then
``python -m rl_zoo3.enjoy`` on the last agent (not the best), deterministic, for 20 whole episodes or more.
Rows are appended to results/first_results.csv as runs end; what stands there is not run again.
"""

import argparse
import os
import re
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rliable import library, metrics

from benchmarks.stored_rows import store, stored

RESULTS = Path(__file__).parent / "results" / "first_results.csv"
EVALUATION_SEED = 10_000


class Task(NamedTuple):
    env: str
    seeds: range
    longest_episode: int


TASKS = [Task("CartPole-v1", range(5), 500), Task("HalfCheetah-v5", range(3), 1000)]
COLUMNS = ["env", "seed", "mean_return", "std_return", "episodes", "train_seconds"]


def run(task: Task, seed: int, folder: Path) -> dict[str, object]:
    """Train and play one agent."""
    where = ["--algo", "trpo_gae", "--env", task.env, "-f", str(folder / f"{task.env}-seed{seed}")]
    start = time.perf_counter()
    zoo("train", *where, "--seed", str(seed), "--verbose", "0")
    train_seconds = time.perf_counter() - start
    steps = str(20 * task.longest_episode)
    played = zoo("enjoy", *where, "--no-render", "-n", steps, "--seed", str(EVALUATION_SEED + seed))
    (episodes,) = re.findall(r"^(\d+) Episodes$", played, re.MULTILINE)
    ((mean, std),) = re.findall(r"Mean reward: (\S+) \+/- (\S+)", played)
    return dict(zip(COLUMNS, [task.env, seed, mean, std, episodes, round(train_seconds)], strict=True))


def zoo(verb: str, *arguments: str) -> str:
    # One thread a run: two runs side by side would otherwise wait for each other's
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-m", f"rl_zoo3.{verb}", *arguments]
    done = subprocess.run(command, env=environment, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
    if done.returncode != 0:
        raise RuntimeError(f"{' '.join(command)} failed:\n{done.stdout[-4000:]}")
    return done.stdout


def summary() -> None:
    """Interquartile mean over seeds with a bootstrap interval of 95 %, as rliable computes them."""
    for task in TASKS:
        returns = np.array([float(row["mean_return"]) for row in stored(RESULTS) if row["env"] == task.env])
        if len(returns) == 0:
            continue
        np.random.seed(0)
        scores = {task.env: returns[:, None]}
        point, interval = library.get_interval_estimates(scores, lambda x: np.array([metrics.aggregate_iqm(x)]), reps=2000)
        low, high = interval[task.env].flatten()
        each = ", ".join(f"{value:.0f}" for value in returns)
        print(f"{task.env}: IQM {point[task.env][0]:.0f} [{low:.0f}, {high:.0f}] over {len(returns)} seeds ({each})")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--jobs", type=int, default=2, help="runs side by side")
    parser.add_argument("--folder", type=Path, default=Path("logs/first_results"), help="where rl-zoo3 writes")
    parser.add_argument("--summary", action="store_true", help="run nothing")
    args = parser.parse_args()
    if not args.summary:
        known = {(row["env"], int(row["seed"])) for row in stored(RESULTS)}
        left = [(task, seed) for task in TASKS for seed in task.seeds if (task.env, seed) not in known]
        with ThreadPoolExecutor(args.jobs) as pool:
            for done in as_completed([pool.submit(run, task, seed, args.folder) for task, seed in left]):
                row = done.result()
                store(RESULTS, [row])
                print(row, flush=True)
    summary()


if __name__ == "__main__":
    main()
