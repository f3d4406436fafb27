"""Markdown of the pages of results."""

import math
from collections.abc import Callable, Iterable, Mapping

import numpy as np
import pandas as pd

from benchmarks.peers.aggregates import Interval, improvement, interquartile_means, normalized, ratio
from benchmarks.peers.algorithms import ALGORITHMS, OURS, TRPO
from benchmarks.peers.comparison import (
    Runs,
    common_algorithms,
    fewest_runs,
    final_scores,
    mujoco_runs,
    on_one_processor,
    score,
    scores_after,
    times_to_reach,
)
from benchmarks.peers.curves import Run, all_runs, runs_of, scores_of
from benchmarks.peers.page import markdown_table
from benchmarks.peers.plan import (
    ABLATION_TASKS,
    CLASSIC_SEEDS,
    FEW_SEEDS,
    HUMANOID,
    PENDULUM,
    SEEDS,
    SWIMMER,
    SWIMMER_TUNING_STEPS,
    TUNING_STEPS,
    TUNING_TASKS,
)
from benchmarks.peers.protocol import CLASSIC_TASKS, LONG_STEPS, MUJOCO_STEPS, PUBLISHED_PPO
from benchmarks.peers.variants import (
    CANDIDATES,
    DAMPING_CANDIDATES,
    HUMANOID_CANDIDATES,
    PENDULUM_CANDIDATES,
    SWIMMER_CANDIDATES,
    VARIANTS,
    Variant,
)
from sb3_gae.sweep.statistics import interquartile_mean

#: parts of sb3-contrib TRPO's training time at which scores are compared
FRACTIONS = {"a fifth": 0.2, "half": 0.5, "all": 1.0}


def scores_table(table: pd.DataFrame) -> str:
    """
    :param table: of results
    :return: score of each algorithm on each MuJoCo task
    """
    runs = mujoco_runs(table)
    names = [name for name in ALGORITHMS if any(name in own for own in runs.values())]
    rows = [[task, *(_score(own.get(name)) for name in names)] for task, own in runs.items()]
    return markdown_table(["task", *(ALGORITHMS[name].title for name in names)], rows)


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
            _decimal(mean, len(scores[name])),
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
    factors = " and ".join(f"{_against_ours(ratio, scores, name)} times that of {_short(name)}" for name in others)
    counts = ", ".join(f"{_short(name)} {len(scores[name])}" for name in (OURS, *others))
    fewest = fewest_runs(own[name] for own in runs.values() for name in scores)
    caution = "" if fewest >= FEW_SEEDS else " **Few runs, so little is said of chance.**"
    tasks = f"Over {len(runs)} task{'s' * (len(runs) > 1)} the interquartile mean of {_short(OURS)} is {factors}."
    return f"{tasks} Runs on each task: {counts}.{caution}"


def _short(name: str) -> str:
    return ALGORITHMS[name].title.split(" (")[0].split(",")[0]


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
            cells.append(_decimal(means[title][name], len(scores[name])))
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
        times = [_seconds(value) for value in (reach.seconds, reach.peer_seconds, reach.peer_training)]
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
            rows.append([task, number(steps), _score(own[OURS]), _score(own[TRPO]), verdict(own)])
    return markdown_table(["task", "steps", ALGORITHMS[OURS].title, ALGORITHMS[TRPO].title, "at least as good"], rows)


def verdict(own: dict[str, list[Run]]) -> str:
    """
    :param own: runs of one task by algorithm
    :return: whether ours is at least as good as sb3-contrib's TRPO
    """
    ours, other = score(own[OURS]), score(own[TRPO])
    if ours.point >= other.point:
        return "yes"
    return "no" if ours.high < other.low else "within the bands"


def long_table(table: pd.DataFrame) -> str:
    """
    :param table: of results
    :return: ours after three million steps beside what tianshou has published for PPO
    """
    rows = []
    for task, published in PUBLISHED_PPO.items():
        if runs := runs_of(table, task, OURS, LONG_STEPS):
            above = "yes" if score(runs).point > published else "no"
            rows.append([task, _score(runs), number(published), above])
    return markdown_table(["task", ALGORITHMS[OURS].title, "PPO, as tianshou has published it", "above"], rows)


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
            rows.append([about.title, *(_score(runs) for runs in own.values()), _against(own, shipped)])
    return markdown_table(["", *ABLATION_TASKS, "IQM over tasks, as shipped = 1"], rows if len(rows) > 1 else [])


def tuning_table(table: pd.DataFrame) -> str:
    """
    :param table: of results
    :return: score of each run with settings that were tried, by the seeds for tuning
    """
    return _tried(table, TUNING_STEPS)


def long_tuning_table(table: pd.DataFrame) -> str:
    """
    :param table: of results
    :return: the same of runs of the full length
    """
    return _tried(table, MUJOCO_STEPS)


def pendulum_tuning_table(table: pd.DataFrame) -> str:
    """
    :param table: of results
    :return: score of the settings that were tried on Pendulum-v1
    """
    found = _tried_on(table, PENDULUM, PENDULUM_CANDIDATES, CLASSIC_TASKS[PENDULUM])
    return markdown_table(["", PENDULUM], [[title, _score(runs)] for title, runs in found.items()])


def swimmer_tuning_table(table: pd.DataFrame) -> str:
    """
    :param table: of results
    :return: score of each run with the settings that were tried on Swimmer-v5, the worst first
    """
    return _run_by_run([""], {(): _tried_on(table, SWIMMER, SWIMMER_CANDIDATES, SWIMMER_TUNING_STEPS)})


def humanoid_tuning_table(table: pd.DataFrame) -> str:
    """
    :param table: of results
    :return: the same on Humanoid-v5
    """
    return _run_by_run([""], {(): _tried_on(table, HUMANOID, HUMANOID_CANDIDATES, MUJOCO_STEPS)})


def damping_tuning_table(table: pd.DataFrame) -> str:
    """
    :param table: of results
    :return: the same with each damping of the value fit, task by task
    """
    found: dict[tuple[str, ...], dict[str, list[Run]]] = {
        (task,): _tried_on(table, task, candidates, MUJOCO_STEPS) for task, candidates in DAMPING_CANDIDATES.items()
    }
    return _run_by_run(["task", "`vf_cg_damping`"], found)


def _run_by_run(heads: list[str], found: Mapping[tuple[str, ...], dict[str, list[Run]]]) -> str:
    """A row for each settings, by the cells that begin it and its title."""
    rows = [
        [*first, title, ", ".join(number(run) for run in sorted(scores_of(runs))), _score(runs)]
        for first, by_title in found.items()
        for title, runs in by_title.items()
    ]
    return markdown_table([*heads, "runs, the worst first", "together"], rows)


def _tried_on(table: pd.DataFrame, task: str, candidates: dict[str, Variant], steps: int) -> dict[str, list[Run]]:
    """Runs by the title of the settings, of those that were run."""
    found = {about.title: runs_of(table, task, OURS, steps, variant) for variant, about in candidates.items()}
    return {title: runs for title, runs in found.items() if runs}


def _tried(table: pd.DataFrame, steps: int) -> str:
    rows = []
    for variant, about in CANDIDATES.items():
        own = [runs_of(table, task, OURS, steps, variant) for task in TUNING_TASKS]
        if any(own):
            rows.append([about.title, *(", ".join(number(run.score) for run in runs) for runs in own)])
    return markdown_table(["", *TUNING_TASKS], rows)


def _against(own: dict[str, list[Run]], shipped: dict[str, list[Run]]) -> str:
    if not all(own.values()):
        return ""
    scores = [scores_of(runs) for runs in own.values()]
    mean = interquartile_means({"": normalized(scores, [scores_of(runs) for runs in shipped.values()])})[""]
    return _decimal(mean, fewest_runs([*own.values(), *shipped.values()]))


def targets_table(table: pd.DataFrame) -> str:
    """
    :param table: of results
    :return: each target, what was measured, and whether it is met
    """
    runs = mujoco_runs(table)
    rows = [*_mujoco_targets(runs)] if runs else []
    classic = {task: all_runs(table, task, steps) for task, steps in CLASSIC_TASKS.items()}
    if complete := {task: own for task, own in classic.items() if OURS in own and TRPO in own}:
        short = [task for task, own in complete.items() if verdict(own) != "yes"]
        measured = f"{len(complete) - len(short)} of {len(complete)} tasks" + (f"; not {', '.join(short)}" if short else "")
        fewest = fewest_runs(own[name] for own in complete.values() for name in (OURS, TRPO))
        rows.append(["classic control: at least as good as the zoo's trpo", measured, *_met(not short, fewest, CLASSIC_SEEDS)])
    long = {task: runs_of(table, task, OURS, LONG_STEPS) for task in PUBLISHED_PPO}
    if found := {task: score(own).point for task, own in long.items() if own}:
        below = [task for task, value in found.items() if value <= PUBLISHED_PPO[task]]
        measured = ", ".join(f"{task} {number(value)}" for task, value in found.items())
        fewest = fewest_runs(own for own in long.values() if own)
        rows.append(["3 million steps: above tianshou's published PPO", measured, *_met(not below, fewest)])
    return markdown_table(["target", "measured", "fewest runs", "met"], rows)


def _mujoco_targets(runs: Runs) -> Iterable[list[str]]:
    scores = final_scores(runs)
    means = {name: mean.point for name, mean in interquartile_means(scores).items() if name != OURS}
    best = max(means, key=lambda name: means[name])
    factor = ratio(scores[OURS], scores[best])
    title = ALGORITHMS[best].title
    fewest = fewest_runs(own[name] for own in runs.values() for name in (OURS, TRPO))
    of_all = fewest_runs(own[name] for own in runs.values() for name in scores)
    target = "IQM over tasks at least 1.3 times the best peer's"
    yield [target, f"{_decimal(factor, of_all)} ({title})", *_met(factor.point >= 1.3, of_all, FEW_SEEDS)]
    under = [task for task, own in runs.items() if verdict(own) == "no"]
    yield ["no task under sb3-contrib's TRPO by more than the bands", ", ".join(under) or "none is", *_met(not under, fewest)]
    if not (timed := on_one_processor(runs)):
        return
    parts = {task: reach.part for task, reach in times_to_reach(runs).items() if reach.is_learned}
    slow = [f"{task} ({part:.2f})" if math.isfinite(part) else f"{task} (never)" for task, part in parts.items() if part > 0.2]
    yield [
        "its final return in a fifth of its time",
        "not on " + ", ".join(slow) if slow else "on all",
        *_met(not slow, fewest_runs(own[name] for own in timed.values() for name in (OURS, TRPO))),
    ]


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
    ratios = ends["wall_seconds"] / ends["cpu_seconds"]
    return f"seconds of the wall for each of the processor: {ratios.median():.2f}, at most {ratios.max():.2f}"


def number(value: float) -> str:
    """
    :param value: any
    :return: whole, with spaces between thousands; two digits behind the point if it is small
    """
    return f"{value:.2f}" if abs(value) < 10 else f"{value:,.0f}".replace(",", " ")


def _score(runs: list[Run] | None) -> str:
    if not runs:
        return ""
    if len(runs) < FEW_SEEDS:
        return f"{number(float(interquartile_mean(scores_of(runs))))} ({len(runs)} run{'s' * (len(runs) > 1)})"
    found = score(runs)
    return f"{number(found.point)} [{number(found.low)}, {number(found.high)}] ({len(runs)})"


def _decimal(interval: Interval, n_runs: int) -> str:
    """The interval as well, where there are runs enough behind it for one: of one or two it would say nothing of chance."""
    return f"{interval.point:.2f}" + f" [{interval.low:.2f}, {interval.high:.2f}]" * (n_runs >= FEW_SEEDS)


def _against_ours(measure: Callable[[np.ndarray, np.ndarray], Interval], scores: Mapping[str, np.ndarray], name: str) -> str:
    return _decimal(measure(scores[OURS], scores[name]), min(len(scores[OURS]), len(scores[name])))


def _seconds(value: float) -> str:
    return f"{value:.0f} s" if math.isfinite(value) else "never"


def _met(is_met: bool, fewest: int, enough: int = SEEDS) -> tuple[str, str]:
    """Behind how many runs it is, and whether it holds."""
    answer = "yes" if is_met else "**no**"
    return str(fewest), answer if fewest >= enough else f"so far {answer}"
