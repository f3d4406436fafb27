"""Tables of the pages of results, task by task."""

import math

import numpy as np
import pandas as pd

from benchmarks.peers.aggregates import improvement, interquartile_means, normalized
from benchmarks.peers.algorithms import ALGORITHMS, OURS, TRPO
from benchmarks.peers.comparison import fewest_runs, mujoco_runs, score, times_to_reach, verdict
from benchmarks.peers.curves import Run, all_runs, runs_of, scores_of
from benchmarks.peers.page import markdown_table
from benchmarks.peers.plan import ABLATION_TASKS
from benchmarks.peers.protocol import CLASSIC_TASKS, LONG_STEPS, MUJOCO_STEPS, PUBLISHED_PPO
from benchmarks.peers.texts import decimal_text, number, score_text, seconds_text, short_title, with_note
from benchmarks.peers.variants import VARIANTS


def scores_table(table: pd.DataFrame) -> str:
    """
    :param table: of results
    :return: score of each algorithm on each MuJoCo task
    """
    runs = mujoco_runs(table)
    names = [name for name in ALGORITHMS if any(name in own for own in runs.values())]
    rows = [[task, *(score_text(own.get(name)) for name in names)] for task, own in runs.items()]
    return with_note(markdown_table(["task", *(ALGORITHMS[name].title for name in names)], rows))


def reach_table(table: pd.DataFrame) -> str:
    """
    :param table: of results
    :return: how soon ours reaches what sb3-contrib's TRPO ends with
    """
    rows = []
    for task, reach in times_to_reach(mujoco_runs(table)).items():
        steps = [number(round(value, -3)) if math.isfinite(value) else "never" for value in (reach.steps, reach.peer_steps)]
        times = [seconds_text(value) for value in (reach.seconds, reach.peer_seconds, reach.peer_training)]
        parts = [_part(reach.seconds, seconds) for seconds in (reach.peer_seconds, reach.peer_training)]
        rows.append([task, number(reach.target), *steps, *times, *parts])
    heads = ["task", "TRPO's final return", "steps of ours", "steps of TRPO", "ours", "TRPO", "TRPO, whole training"]
    return markdown_table([*heads, "ours / TRPO", "ours / whole training"], rows)


def _part(seconds: float, of: float) -> str:
    return f"{seconds / of:.2f}" if math.isfinite(seconds) and math.isfinite(of) else "–"


def classic_table(table: pd.DataFrame) -> str:
    """
    :param table: of results
    :return: ours beside the zoo's trpo on classic control
    """
    rows = []
    for task, steps in CLASSIC_TASKS.items():
        own = all_runs(table, task, steps)
        if OURS in own and TRPO in own:
            ours, other = own[OURS], own[TRPO]
            better = improvement(*(scores_of(runs)[:, None] for runs in (ours, other)))
            probability = decimal_text(better, fewest_runs([ours, other]))
            rows.append([task, number(steps), score_text(ours), score_text(other), probability, verdict(own)])
    heads = ["task", "steps", ALGORITHMS[OURS].title, ALGORITHMS[TRPO].title, "probability that ours is better"]
    return with_note(markdown_table([*heads, "at least as good"], rows))


def long_table(table: pd.DataFrame) -> str:
    """
    :param table: of results
    :return: ours after three million steps beside what tianshou has published for PPO
    """
    rows = []
    for task, published in PUBLISHED_PPO.items():
        if runs := runs_of(table, task, OURS, LONG_STEPS):
            above = "yes" if score(runs).point > published else "no"
            largest = number(float(np.mean([run.returns.max() for run in runs])))
            rows.append([task, score_text(runs), largest, number(published), above])
    heads = ["task", ALGORITHMS[OURS].title, "its largest evaluations", "PPO, as tianshou has published it", "above"]
    return with_note(markdown_table(heads, rows))


def ablation_table(table: pd.DataFrame) -> str:
    """
    :param table: of results
    :return: score with each choice undone, beside the shipped settings
    """
    shipped = {task: runs_of(table, task, OURS, MUJOCO_STEPS) for task in ABLATION_TASKS}
    rows = []
    for variant, about in VARIANTS.items():
        own = {task: runs_of(table, task, OURS, MUJOCO_STEPS, variant) for task in ABLATION_TASKS}
        if any(own.values()) and all(shipped.values()):
            rows.append([about.title, *(score_text(runs) for runs in own.values()), _against(own, shipped)])
    return with_note(markdown_table(["", *ABLATION_TASKS, "IQM over tasks, as shipped = 1"], rows if len(rows) > 1 else []))


def _against(own: dict[str, list[Run]], shipped: dict[str, list[Run]]) -> str:
    if not all(own.values()):
        return ""
    scores = [scores_of(runs) for runs in own.values()]
    mean = interquartile_means({"": normalized(scores, [scores_of(runs) for runs in shipped.values()])})[""]
    return decimal_text(mean, fewest_runs([*own.values(), *shipped.values()]))


def origin_list(table: pd.DataFrame) -> str:
    """
    :param table: of results
    :return: versions and machines that the results are from, those of tuning left out
    """
    table = table[table["variant"].isin(list(VARIANTS))] if len(table) else table
    if table.empty:
        return ""
    names = {"processor": "processor", "cores": "cores", "cores_of_run": "cores of a run", "python": "Python"}
    names |= {name: name.replace("_", "-") for name in ("sb3_gae", "sb3_contrib", "stable_baselines3", "rl_zoo3", "tianshou")}
    names |= {name: name for name in ("gymnasium", "mujoco", "envpool", "torch")}
    held = {
        title: sorted({str(value) for value in table[name] if value != ""}) for name, title in names.items() if name in table
    }
    lines = [f"- {title}: {', '.join(values)}" for title, values in held.items() if values]
    return "\n".join([*lines, f"- {_disturbance(table)}"])


def _disturbance(table: pd.DataFrame) -> str:
    """How much longer than the processor's the seconds of the wall were."""
    ends = (
        table.sort_values("step")
        .groupby(["task", "algorithm", "variant", "seed", "steps"])[["wall_seconds", "cpu_seconds"]]
        .last()
    )
    ratios = (ends["wall_seconds"] / ends["cpu_seconds"]).groupby("algorithm")
    of_each = [f"{short_title(name)} {own.median():.2f}, at most {own.max():.2f}" for name, own in ratios]
    return f"seconds of the wall for each of the processor, median over runs: {'; '.join(of_each)}"
