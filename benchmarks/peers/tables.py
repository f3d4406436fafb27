"""Markdown of the pages of results."""

import math
from collections.abc import Callable, Mapping

import numpy as np
import pandas as pd

from benchmarks.peers.aggregates import Interval, improvement, interquartile_means, normalized, ratio
from benchmarks.peers.algorithms import ALGORITHMS, OURS, TRPO
from benchmarks.peers.comparison import (
    common_algorithms,
    fewest_runs,
    final_scores,
    mujoco_runs,
    on_one_processor,
    score,
    scores_after,
    times_to_reach,
    verdict,
)
from benchmarks.peers.curves import Run, all_runs, runs_of, scores_of
from benchmarks.peers.page import markdown_table
from benchmarks.peers.plan import (
    ABLATION_TASKS,
    FEW_SEEDS,
)
from benchmarks.peers.protocol import CLASSIC_TASKS, LONG_STEPS, MUJOCO_STEPS, PUBLISHED_PPO
from benchmarks.peers.texts import decimal_text, is_any_former, number, score_text, seconds_text, short_title, with_note
from benchmarks.peers.variants import (
    VARIANTS,
)

#: parts of sb3-contrib TRPO's training time at which scores are compared
FRACTIONS = {"a fifth": 0.2, "half": 0.5, "all": 1.0}


def scores_table(table: pd.DataFrame) -> str:
    """
    :param table: of results
    :return: score of each algorithm on each MuJoCo task
    """
    runs = mujoco_runs(table)
    names = [name for name in ALGORITHMS if any(name in own for own in runs.values())]
    rows = [[task, *(score_text(own.get(name)) for name in names)] for task, own in runs.items()]
    return with_note(markdown_table(["task", *(ALGORITHMS[name].title for name in names)], rows))


def aggregate_table(table: pd.DataFrame) -> str:
    """
    :param table: of results
    :return: interquartile mean over tasks, and how probably ours is better
    """
    runs = mujoco_runs(table)
    scores = final_scores(runs) if runs else {}
    rows = [
        [
            ALGORITHMS[name].title,
            f"{len(scores[name])} × {len(runs)}",
            decimal_text(mean, len(scores[name])),
            "" if name == OURS else _against_ours(improvement, scores, name),
            "" if name == OURS else _against_ours(ratio, scores, name),
        ]
        for name, mean in interquartile_means(scores).items()
    ]
    return markdown_table(["", "runs × tasks", "IQM", "probability that ours is better", "IQM of ours / its own"], rows)


def summary(table: pd.DataFrame) -> str:
    """
    :param table: of results
    :return: in a sentence or two, how far ours is ahead over the MuJoCo tasks, and of how many runs that is said
    """
    runs = mujoco_runs(table)
    if not runs:
        return ""
    scores = final_scores(runs)
    means = interquartile_means(scores)
    others = sorted((name for name in means if name != OURS), key=lambda name: -means[name].point)
    factors = " and ".join(f"{_against_ours(ratio, scores, name)} times that of {short_title(name)}" for name in others)
    counts = ", ".join(f"{short_title(name)} {len(scores[name])}" for name in (OURS, *others))
    fewest = fewest_runs(own[name] for own in runs.values() for name in scores)
    caution = "" if fewest >= FEW_SEEDS else " **Few runs, so little is said of chance.**"
    tasks = f"Over {len(runs)} task{'s' * (len(runs) > 1)} the interquartile mean of {short_title(OURS)} is {factors}."
    former = [task for task, own in runs.items() if is_any_former(own[OURS])]
    old = f" Ours on {', '.join(former)} are of settings that are no longer shipped." if former else ""
    return f"{tasks} Runs on each task: {counts}.{caution}{old}"


def clock_table(table: pd.DataFrame) -> str:
    """
    :param table: of results
    :return: the same at equal seconds of training
    """
    runs = mujoco_runs(table)
    if not runs:
        return ""
    found = {title: scores_after(runs, fraction) for title, fraction in FRACTIONS.items()}
    means = {title: interquartile_means(scores) for title, scores in found.items()}
    rows = []
    for name in common_algorithms(on_one_processor(runs)):
        cells = []
        for title, scores in found.items():
            cells.append(decimal_text(means[title][name], len(scores[name])))
            cells.append("" if name == OURS else _against_ours(improvement, scores, name))
        rows.append([ALGORITHMS[name].title, *cells])
    heads = [head for title in FRACTIONS for head in (f"IQM after {title}", "ours is better")]
    return markdown_table(["", *heads], rows)


def reach_table(table: pd.DataFrame) -> str:
    """
    :param table: of results
    :return: how soon ours reaches what sb3-contrib's TRPO ends with
    """
    rows = []
    for task, reach in times_to_reach(mujoco_runs(table)).items():
        if not reach.is_learned:
            rows.append([task, number(reach.target), *[""] * 4, "TRPO ends no higher than it begins"])
            continue
        steps = number(round(reach.steps, -3)) if math.isfinite(reach.steps) else "–"
        times = [seconds_text(value) for value in (reach.seconds, reach.peer_seconds, reach.peer_training)]
        part = f"{reach.part:.2f}" if math.isfinite(reach.part) else "–"
        rows.append([task, number(reach.target), steps, *times, part])
    heads = ["task", "TRPO's final return", "steps of ours", "ours", "TRPO, first time", "TRPO, whole training"]
    return markdown_table([*heads, "ours / whole training"], rows)


def classic_table(table: pd.DataFrame) -> str:
    """
    :param table: of results
    :return: ours beside the zoo's trpo on classic control
    """
    rows = []
    for task, steps in CLASSIC_TASKS.items():
        own = all_runs(table, task, steps)
        if OURS in own and TRPO in own:
            rows.append([task, number(steps), score_text(own[OURS]), score_text(own[TRPO]), verdict(own)])
    heads = ["task", "steps", ALGORITHMS[OURS].title, ALGORITHMS[TRPO].title, "at least as good"]
    return with_note(markdown_table(heads, rows))


def long_table(table: pd.DataFrame) -> str:
    """
    :param table: of results
    :return: ours after three million steps beside what tianshou has published for PPO
    """
    rows = []
    for task, published in PUBLISHED_PPO.items():
        if runs := runs_of(table, task, OURS, LONG_STEPS):
            above = "yes" if score(runs).point > published else "no"
            rows.append([task, score_text(runs), number(published), above])
    return with_note(markdown_table(["task", ALGORITHMS[OURS].title, "PPO, as tianshou has published it", "above"], rows))


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


def _against_ours(measure: Callable[[np.ndarray, np.ndarray], Interval], scores: Mapping[str, np.ndarray], name: str) -> str:
    return decimal_text(measure(scores[OURS], scores[name]), min(len(scores[OURS]), len(scores[name])))
