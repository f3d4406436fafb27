"""Markdown of the settings that were tried."""

from collections.abc import Mapping

import pandas as pd

from benchmarks.peers.algorithms import OURS
from benchmarks.peers.curves import Run, runs_of, scores_of
from benchmarks.peers.page import markdown_table
from benchmarks.peers.plan import HUMANOID, PENDULUM, SWIMMER, SWIMMER_TUNING_STEPS, TUNING_STEPS, TUNING_TASKS
from benchmarks.peers.protocol import CLASSIC_TASKS, MUJOCO_STEPS
from benchmarks.peers.texts import number, score_text
from benchmarks.peers.variants import (
    CANDIDATES,
    DAMPING_CANDIDATES,
    HUMANOID_CANDIDATES,
    PENDULUM_CANDIDATES,
    SWIMMER_CANDIDATES,
    Variant,
)


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
    return markdown_table(["", PENDULUM], [[title, score_text(runs)] for title, runs in found.items()])


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
        [*first, title, ", ".join(number(run) for run in sorted(scores_of(runs))), score_text(runs)]
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
