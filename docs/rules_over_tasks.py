"""
Prints how `gae_lambda="auto"` stands beside single fixed λ over several tasks, from committed results of sweeps.

    python docs/rules_over_tasks.py

The score of a setting on a task is the interquartile mean over runs of the return over training, in parts of that of the
task's best fixed λ; over tasks the mean counts. Intervals (95 %) come from a bootstrap that draws runs within each task;
rliable's wants as many runs for each task.
"""

from pathlib import Path

import numpy as np
import pandas as pd

from sb3_gae.sweep.results import read_results
from sb3_gae.sweep.statistics import interquartile_mean

RESULTS = Path(__file__).parents[1] / "benchmarks" / "results" / "sweeps"
#: for each task the files with fixed λ, and those with the rule as it is
TASKS = {
    "cart-pole": (["fig2-left", "repeat-cart-pole"], ["lambda-auto-cart-pole"]),
    "HalfCheetah-v5": (
        ["lambda-rules-HalfCheetah-v5", "lambda-auto-HalfCheetah-v5"],
        ["lambda-auto-HalfCheetah-v5", "lambda-auto-HalfCheetah-again"],
    ),
    "Hopper-v5": (["lambda-rules-Hopper-v5", "lambda-auto-Hopper-v5"], ["lambda-auto-Hopper-v5"]),
}
LAMBDAS = (0.84, 0.92, 0.96)
AUTO, FIXED = "auto_lambda", "trust_region"
RESAMPLES = 4_000


def returns_over_training(files: list[str], condition: str, gae_lambda: float | None = None) -> np.ndarray:
    """
    :param files: names of results
    :param condition: of the sweep
    :param gae_lambda: None for a rule
    :return: of each run, shape (runs,)
    """
    table = pd.concat([read_results(RESULTS / f"{file}.parquet") for file in files])
    chosen = table["condition"] == condition
    if gae_lambda is not None:
        chosen &= table["gae_lambda"] == gae_lambda
    return table[chosen].groupby(["sweep", "seed"])["mean_return"].mean().to_numpy()


def score(runs: np.ndarray) -> float:
    """
    :param runs: shape (runs,)
    :return: their interquartile mean
    """
    return float(interquartile_mean(runs[:, None])[0])


def all_runs() -> dict[str, dict[str | float, np.ndarray]]:
    """:return: by task and setting, each of shape (runs,)"""
    found: dict[str, dict[str | float, np.ndarray]] = {}
    for task, (fixed, with_rule) in TASKS.items():
        found[task] = {AUTO: returns_over_training(with_rule, AUTO)}
        found[task] |= {gae_lambda: returns_over_training(fixed, FIXED, gae_lambda) for gae_lambda in LAMBDAS}
    return found


def over_tasks(by_task: list[np.ndarray], units: list[float]) -> float:
    """
    :param by_task: runs of one setting
    :param units: of each task
    :return: mean score
    """
    return float(np.mean([score(runs) / unit for runs, unit in zip(by_task, units, strict=True)]))


def with_interval(point: float, drawn: np.ndarray) -> str:
    """:return: for the table"""
    low, high = np.quantile(drawn, [0.025, 0.975])
    return f"{point:.3f} [{low:.3f}, {high:.3f}]"


def main() -> None:
    runs = all_runs()
    units = [max(score(of[gae_lambda]) for gae_lambda in LAMBDAS) for of in runs.values()]
    settings = {name: [of[name] for of in runs.values()] for name in (AUTO, *LAMBDAS)}
    generator = np.random.default_rng(0)
    points = {name: over_tasks(by_task, units) for name, by_task in settings.items()}
    drawn = {
        name: np.array([over_tasks([generator.choice(each, len(each)) for each in by_task], units) for _ in range(RESAMPLES)])
        for name, by_task in settings.items()
    }
    print(f"| λ | runs ({', '.join(TASKS)}) | over tasks | auto ahead by |\n| --- | --- | ---: | ---: |")
    for name, by_task in settings.items():
        counts = ", ".join(str(len(each)) for each in by_task)
        ahead = "" if name == AUTO else with_interval(points[AUTO] - points[name], drawn[AUTO] - drawn[name])
        print(f"| {'auto' if name == AUTO else name} | {counts} | {with_interval(points[name], drawn[name])} | {ahead} |")


if __name__ == "__main__":
    main()
