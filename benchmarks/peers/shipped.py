"""The shipped settings of the MuJoCo tasks, side by side."""

from collections.abc import Callable
from typing import Any

from benchmarks.peers.algorithms import OURS
from benchmarks.peers.page import markdown_table
from benchmarks.peers.plan import Cell
from benchmarks.peers.protocol import MUJOCO_STEPS, MUJOCO_TASKS
from benchmarks.peers.settings import our_defaults, settings_of
from benchmarks.peers.variants import SHIPPED

_COLUMNS: dict[str, Callable[[dict[str, Any]], str]] = {
    "batch": lambda settings: f"{settings['n_envs']} × {settings['n_steps']:,}".replace(",", " "),
    "γ": lambda settings: f"{settings['gamma']}",
    "λ": lambda settings: f"{settings['gae_lambda']}",
    "KL": lambda settings: f"{settings['target_kl']}",
    "ln std": lambda settings: f"{_policy_kwargs(settings).get('log_std_init', 0)}",
    "`cg_damping`": lambda settings: f"{settings['cg_damping']:g}",
    "`vf_cg_damping`": lambda settings: f"{settings['vf_cg_damping']}".removesuffix(".0"),
}


def shipped_table() -> str:
    """:return: what differs between the tasks, defaults of :class:`~sb3_gae.TRPOGAE` included"""
    rows = []
    for task in MUJOCO_TASKS:
        settings = our_defaults() | settings_of(Cell(task, OURS, SHIPPED, 0, MUJOCO_STEPS))
        rows.append([task, *(show(settings) for show in _COLUMNS.values())])
    return markdown_table(["task", *_COLUMNS], rows)


def _policy_kwargs(settings: dict[str, Any]) -> dict[str, Any]:
    # A string of Python in rl-zoo3's files; the zoo evaluates it in the same way
    given = settings["policy_kwargs"]
    return eval(given) if isinstance(given, str) else given or {}
