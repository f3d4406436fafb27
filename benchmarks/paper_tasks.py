"""
What the shipped settings reach on the paper's tasks: rl-zoo3's own command over several seeds, and learning curves.

    python -m benchmarks.paper_tasks                          # every run that is not stored yet: hours
    python -m benchmarks.paper_tasks --tasks GaeBiped-v0 --seeds 0 1 2 --jobs 2
    python -m benchmarks.paper_tasks --tasks GaeBiped-v0 --seeds 1000 --steps 50000000   # the paper's 1 000 iterations
    python -m benchmarks.paper_tasks --report                 # runs nothing: the table, and the figure in docs/images

Each run is ``python -m rl_zoo3.train --algo trpo_gae --env TASK --seed SEED`` with one thread of torch, then the last
agent (not the best) plays 20 episodes, deterministically, in the gymnasium environment. A row and a curve are stored
as each run ends; what is stored is not run again. ``--steps`` trains for other than the shipped number of steps; the
figure has the seeds that are run by default.
"""

import argparse
import os
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import NamedTuple

import gymnasium as gym
import matplotlib
import numpy as np
import yaml
from rliable import library, metrics
from stable_baselines3.common.monitor import load_results
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from benchmarks.stored_rows import store, stored
from sb3_gae import TRPOGAE
from sb3_gae.zoo import default_hyperparams_path

RESULTS = Path(__file__).parent / "results" / "paper_tasks.csv"
CURVES = RESULTS.with_name("paper_tasks_curves.csv")
FIGURE = Path(__file__).parents[1] / "docs" / "images" / "paper_tasks.svg"
EPISODES = 20
POINTS = 100
COLUMNS = ["env", "seed", "steps", "train_seconds", "mean_return", "mean_length", "forward_velocity", "head_height"]


class Task(NamedTuple):
    """
    :param title: in the figure
    :param seeds: that are run unless the command line says otherwise
    """

    title: str
    seeds: range


TASKS = {
    "GaeCartPole-v0": Task("Cart-pole", range(5)),
    "GaeBiped-v0": Task("Biped", range(3)),
    "GaeQuadruped-v0": Task("Quadruped", range(3)),
    "GaeBipedStandup-v0": Task("Biped getting up", range(3)),
}


def run(env: str, seed: int, steps: int | None, folder: Path) -> tuple[dict[str, object], list[dict[str, object]]]:
    """Train and play one agent."""
    logs = folder / f"{env}-seed{seed}"
    # One thread a run: two runs side by side would otherwise wait for each other's
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "rl_zoo3.train", "--algo", "trpo_gae", "--env", env, "--seed", str(seed), "-f", str(logs)]
    command += [] if steps is None else ["-n", str(steps)]
    start = time.perf_counter()
    logs.mkdir(parents=True, exist_ok=True)
    with (logs / "output.txt").open("w") as output:
        subprocess.run(command, env=environment, check=True, stdout=output, stderr=subprocess.STDOUT)
    seconds = round(time.perf_counter() - start)
    agent = max((logs / "trpo_gae").glob(f"{env}_*"), key=lambda path: int(path.name.rsplit("_", 1)[1]))
    points = [{"env": env, "seed": seed, **point} for point in curve(agent)]
    row = {"env": env, "seed": seed, "train_seconds": seconds, **play(env, agent, seed)}
    return {name: row[name] for name in COLUMNS}, points


def curve(agent: Path) -> list[dict[str, object]]:
    """
    Mean return of the training episodes that ended in each hundredth of the training.

    From the monitor files: with batches of whole episodes they also have the surplus ones of environments that had
    contributed all of theirs.
    """
    episodes = load_results(str(agent))
    steps, returns = episodes["l"].cumsum().to_numpy(), episodes["r"].to_numpy()
    edges = np.linspace(0, steps[-1], POINTS + 1)
    part = np.minimum(np.searchsorted(edges, steps, side="left") - 1, POINTS - 1)
    return [
        {"steps": round(edges[i + 1]), "return": round(float(returns[part == i].mean()), 2)}
        for i in range(POINTS)
        if (part == i).any()
    ]


def play(env_id: str, agent: Path, seed: int) -> dict[str, object]:
    model = TRPOGAE.load(agent / f"{env_id}.zip", device="cpu")
    env = gym.make(env_id)
    statistics = agent / env_id / "vecnormalize.pkl"
    normalize = VecNormalize.load(str(statistics), DummyVecEnv([lambda: env])) if statistics.exists() else None
    returns, lengths, velocities, heights = [], [], [], []
    for episode in range(EPISODES):
        observation, _ = env.reset(seed=10_000 + 100 * seed + episode)
        total, length, over = 0.0, 0, False
        while not over:
            seen = normalize.normalize_obs(observation) if normalize else observation
            action, _ = model.predict(seen, deterministic=True)
            observation, reward, terminated, truncated, info = env.step(action)
            total, length, over = total + float(reward), length + 1, terminated or truncated
            velocities.append(info.get("forward_velocity", np.nan))
            heights.append(env.unwrapped.data.sensor("head_position").data[2] if "Standup" in env_id else np.nan)
        returns.append(total)
        lengths.append(length)
    means = {"mean_return": returns, "mean_length": lengths, "forward_velocity": velocities, "head_height": heights}
    return {"steps": model.num_timesteps} | {name: round(float(np.mean(values)), 3) for name, values in means.items()}


def is_known(env: str, seed: int, steps: int | None) -> bool:
    """Whether such a run is stored; the last batch of a run goes beyond what was asked for."""
    asked = steps or int(float(yaml.safe_load(default_hyperparams_path().read_text())[env]["n_timesteps"]))
    return any(
        (row["env"], int(row["seed"])) == (env, seed) and 0 <= int(row["steps"]) - asked < 0.02 * asked
        for row in stored(RESULTS)
    )


def table() -> None:
    """Interquartile means over seeds with bootstrap intervals of 95 %, as rliable computes them."""
    results = stored(RESULTS)
    lengths = {(row["env"], length_of(row)) for row in results}
    for env, length in sorted(lengths, key=lambda one: (list(TASKS).index(one[0]), one[1])):
        rows = [row for row in results if (row["env"], length_of(row)) == (env, length)]
        print(f"{env}, {len(rows)} seeds, {length:g} million steps in {'/'.join(row['train_seconds'] for row in rows)} s")
        for name in ("mean_return", "mean_length", "forward_velocity", "head_height"):
            values = np.array([float(row[name]) for row in rows])
            if not np.isnan(values).any():
                point, low, high = interval(values)
                each = ", ".join(f"{value:g}" for value in values)
                print(f"  {name:<16} IQM {point:.5g} [{low:.5g}, {high:.5g}] ({each})")


def length_of(row: dict[str, str]) -> float:
    """Million steps of training, as they were asked for: the last batch of a run goes a little beyond."""
    return float(f"{int(row['steps']) / 1e6:.2g}")


def interval(values: np.ndarray) -> tuple[float, float, float]:
    np.random.seed(0)
    point, bounds = library.get_interval_estimates(
        {"": values[:, None]}, lambda x: np.array([metrics.aggregate_iqm(x)]), reps=2000
    )
    low, high = bounds[""].flatten()
    return point[""][0], low, high


def figure() -> None:
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    points = stored(CURVES)
    tasks = [env for env in TASKS if any(point["env"] == env for point in points)]
    plt.rcParams.update({"font.size": 9, "svg.hashsalt": "sb3-gae", "axes.spines.top": False, "axes.spines.right": False})
    drawing, axes = plt.subplots(1, len(tasks), figsize=(3.2 * len(tasks), 2.9), squeeze=False, facecolor="white")
    for axis, env in zip(axes[0], tasks, strict=True):
        seeds = sorted({int(point["seed"]) for point in points if point["env"] == env} & set(TASKS[env].seeds))
        for seed in seeds:
            own = [point for point in points if point["env"] == env and int(point["seed"]) == seed]
            steps = np.array([float(point["steps"]) for point in own]) / 1e6
            axis.plot(steps, [float(point["return"]) for point in own], linewidth=1.4, label=f"seed {seed}")
        axis.set_title(TASKS[env].title, fontsize=10)
        axis.set_xlabel("million steps")
        axis.set_xlim(left=0)
        axis.grid(alpha=0.25)
        axis.legend(frameon=False, fontsize=7.5, loc="lower right")
    axes[0][0].set_ylabel("return of training episodes")
    drawing.tight_layout()
    FIGURE.parent.mkdir(exist_ok=True)
    drawing.savefig(FIGURE, metadata={"Date": None})
    print(f"wrote {FIGURE}")


def run_all(pairs: list[tuple[str, int]], args: argparse.Namespace) -> list[str]:
    """:return: what went wrong, a line for each run that did; the others are stored"""
    failures = []
    with ThreadPoolExecutor(args.jobs) as pool:
        runs = {pool.submit(run, env, seed, args.steps, args.folder): f"{env}, seed {seed}" for env, seed in pairs}
        for done in as_completed(runs):
            try:
                row, points = done.result()
            except subprocess.CalledProcessError as error:
                failures.append(f"{runs[done]}: exit status {error.returncode}, see output.txt in {args.folder}")
                continue
            store(CURVES, points)
            store(RESULTS, [row])
            print(row, flush=True)
    return failures


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", choices=list(TASKS), default=list(TASKS))
    parser.add_argument("--seeds", nargs="+", type=int, help="other than each task's own")
    parser.add_argument("--steps", type=int, help="to train for, other than the shipped number")
    parser.add_argument("--jobs", type=int, default=2, help="runs side by side")
    parser.add_argument("--folder", type=Path, default=Path("logs/paper_tasks"), help="where rl-zoo3 writes")
    parser.add_argument("--report", action="store_true", help="run nothing")
    args = parser.parse_args()
    failures: list[str] = []
    if not args.report:
        wanted = [(env, seed) for env in args.tasks for seed in args.seeds or TASKS[env].seeds]
        left = [pair for pair in wanted if not is_known(*pair, args.steps)]
        failures = run_all(left, args)
    table()
    if stored(CURVES):
        figure()
    sys.exit("".join(f"\n{failure}" for failure in failures) or None)


if __name__ == "__main__":
    main()
