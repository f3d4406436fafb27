"""Which results are of settings that are no longer shipped."""

import json
from collections.abc import Iterator
from typing import NamedTuple

import pandas as pd

from benchmarks.peers.algorithms import OURS
from benchmarks.peers.plan import Cell
from benchmarks.peers.settings import described, settings_of
from benchmarks.peers.variants import VARIANTS

FORMER = "former"


class _Group(NamedTuple):
    """Seeds of one training."""

    cell: Cell
    rows: pd.DataFrame
    of_today: pd.DataFrame


def marked(table: pd.DataFrame) -> pd.DataFrame:
    """
    :param table: of results
    :return: with a column that says whether a run is of former settings, and without such runs where there are any of today's:
        no group of seeds has both
    """
    if table.empty:
        return table.assign(**{FORMER: False})
    parts = [
        group.of_today.assign(**{FORMER: False}) if len(group.of_today) else group.rows.assign(**{FORMER: True})
        for group in _groups(table)
    ]
    return pd.concat(parts, ignore_index=True)


def notes_on_former(table: pd.DataFrame) -> list[str]:
    """
    :param table: of results
    :return: a line for each group of seeds of which some are of former settings
    """
    notes = []
    for cell, rows, of_today in _groups(table):
        seeds, current = rows["seed"].nunique(), of_today["seed"].nunique()
        if current < seeds:
            what = cell.name.removesuffix(f"_seed{cell.seed}")
            done = "left out" if current else "marked"
            notes.append(f"{what}: {seeds - current} of {seeds} runs are of settings that are no longer shipped; {done}")
    return notes


def _groups(table: pd.DataFrame) -> Iterator[_Group]:
    for (task, algorithm, variant, steps), rows in table.groupby(["task", "algorithm", "variant", "steps"]):
        cell = Cell(task, algorithm, variant, 0, int(steps))
        yield _Group(cell, rows, rows[_is_of_today(cell, rows)])


def _is_of_today(cell: Cell, rows: pd.DataFrame) -> pd.Series:
    # What was tried in tuning is what it was, and the settings of the peers are their owners'
    if cell.algorithm != OURS or cell.variant not in VARIANTS:
        return pd.Series(True, index=rows.index)
    today = described(OURS, settings_of(cell))
    return rows["settings"].map(lambda text: described(OURS, json.loads(text)) == today)
