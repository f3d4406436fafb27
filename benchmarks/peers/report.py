"""The pages of results and their figures, from the committed results and nothing else."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import pandas as pd

from benchmarks.peers import over_tasks, tables, targets, tuning_tables
from benchmarks.peers.errors import PeersError
from benchmarks.peers.former import marked, notes_on_former
from benchmarks.peers.page import filled
from benchmarks.peers.places import ROOT
from benchmarks.peers.shipped import shipped_table
from benchmarks.peers.table import read_results

_TABLES: dict[str, Callable[[pd.DataFrame], str]] = {
    "summary": over_tasks.summary,
    "targets": targets.targets_table,
    "scores": tables.scores_table,
    "over tasks": over_tasks.aggregate_table,
    "clock": over_tasks.clock_table,
    "reach": tables.reach_table,
    "classic": tables.classic_table,
    "three million": tables.long_table,
    "ablation": tables.ablation_table,
    "tuning": tuning_tables.tuning_table,
    "tuning long": tuning_tables.long_tuning_table,
    "tuning pendulum": tuning_tables.pendulum_tuning_table,
    "tuning swimmer": tuning_tables.swimmer_tuning_table,
    "tuning humanoid": tuning_tables.humanoid_tuning_table,
    "tuning damping": tuning_tables.damping_tuning_table,
    "origin": tables.origin_list,
}
#: preset that makes what a section needs, of those that would leave a chapter empty without
_PRESETS = {
    "classic": "classic",
    "three million": "mujoco-3m",
    "ablation": "ablation",
    **{name: name.replace(" ", "-") for name in _TABLES if name.startswith("tuning")},
}
#: title of each figure, by the section of the page that it stands in
_FIGURES = {
    "figure steps": ("peers_steps", "Return against steps on each task"),
    "figure seconds": ("peers_seconds", "Return against seconds of training on each task"),
    "figure over tasks": ("peers_over_tasks", "Interquartile mean over tasks, against steps and against time"),
}


_OF_TUNING = [name for name in _TABLES if name.startswith("tuning")]
#: sections of each page, by its path in the repository
PAGES = {
    "README.md": ["summary", "scores"],
    "docs/benchmarks.md": [*(name for name in _TABLES if name not in _OF_TUNING), *_FIGURES],
    "docs/tuning.md": ["shipped", *_OF_TUNING],
}


def sections_of(table: pd.DataFrame) -> dict[str, str]:
    """
    :param table: of results, see :func:`~benchmarks.peers.former.marked`
    :return: Markdown by the name of the section
    """
    has_figures = bool(tables.reach_table(table))
    drawn = {name: f"![{title}](images/{file}.svg)" * has_figures for name, (file, title) in _FIGURES.items()}
    made = {name: make(table) for name, make in _TABLES.items()} | {"shipped": shipped_table()}
    for name, preset in _PRESETS.items():
        made[name] = made[name] or f"Not run yet: `python -m benchmarks.peers run --preset {preset} --jobs 2`."
    return made | drawn


class Written(NamedTuple):
    """
    :param paths: of pages and figures
    :param notes: a line for each training with runs of settings that are no longer shipped
    """

    paths: list[Path]
    notes: list[str]


def write_report(root: Path = ROOT) -> Written:
    """
    :param root: of the repository, where :data:`PAGES` are filled and figures drawn
    :return: what was done
    :raises PeersError: if there are no results
    """
    table = read_results()
    if table.empty:
        raise PeersError("There are no results yet; run and export first: python -m benchmarks.peers run")
    # The other commands would wait for it
    from matplotlib import rc_context

    from benchmarks.peers.figures import draw_all
    from sb3_gae.sweep.figures.files import save_figure
    from sb3_gae.sweep.figures.style import STYLE

    notes, table = notes_on_former(table), marked(table)
    sections = sections_of(table)
    written = []
    for path, names in PAGES.items():
        page = root / path
        page.write_text(filled(page.read_text(), {name: sections[name] for name in names}))
        written.append(page)
    images = root / "docs" / "images"
    images.mkdir(parents=True, exist_ok=True)
    with rc_context(STYLE):
        for name, figure in draw_all(table).items():
            save_figure(figure, images / f"{name}.svg")
            written.append(images / f"{name}.svg")
    return Written(written, notes)
