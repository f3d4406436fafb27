"""Runs in a table of results: which rows are one, whether they are whole, and each one once."""

import math
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import numpy as np
import pandas as pd

from sb3_gae.sweep.conditions import CONDITIONS, did_you_mean
from sb3_gae.sweep.errors import SweepError
from sb3_gae.sweep.grid import Cell
from sb3_gae.sweep.ledger import Status
from sb3_gae.sweep.recorder import COLUMNS as ROW_COLUMNS

#: what a run is of
CELL_COLUMNS = ("task", "condition", "gamma", "gae_lambda", "seed", "iterations", "overrides")
#: of partial results
STATE_COLUMN = "state"
# The number of a trial names a run only within its sweep, and two machines may give both the same name
_RUN_COLUMNS = [*CELL_COLUMNS, "sweep", "trial"]
# What a run that is made again has in common with the first. Older files say of `no_vf` the λ that it did not use
_RESULT_COLUMNS = [name for name in ROW_COLUMNS if name not in ("seconds", "lambda_used")]


def cell_of(row: Any) -> Cell:
    """
    :param row: of a table of results
    :return: the cell that it is of
    :raises SweepError: if a value is outside its domain
    """
    gae_lambda = None if math.isnan(row.gae_lambda) else row.gae_lambda
    return Cell(row.task, row.condition, row.gamma, gae_lambda, int(row.seed), int(row.iterations), row.overrides)


def runs_of(table: pd.DataFrame) -> Iterator[pd.DataFrame]:
    """
    :param table: of one sweep or of several
    :return: the rows of each run
    """
    for _, rows in table.groupby(_RUN_COLUMNS, sort=False, dropna=False):
        yield rows


def finished(table: pd.DataFrame) -> pd.DataFrame:
    """
    :param table: of results, perhaps partial
    :return: the same without runs that are not finished, and without the column that tells them apart
    """
    if STATE_COLUMN not in table:
        return table
    return table[table[STATE_COLUMN] == Status.DONE].drop(columns=STATE_COLUMN).reset_index(drop=True)


def check_runs(table: pd.DataFrame, where: str) -> None:
    """
    :param table: of finished runs
    :param where: it comes from, for the message
    :raises SweepError: if a condition is unknown, or iterations of a run are missing or there twice
    """
    for name in table["condition"].unique():
        if name not in CONDITIONS:
            raise SweepError(
                f"{where} has the condition {name!r}, which this sb3-gae does not know{did_you_mean(name, CONDITIONS)}"
            )
    runs = table.groupby(_RUN_COLUMNS, sort=False, dropna=False)["iteration"]
    found = runs.agg(["size", "nunique", "min", "max"]).reset_index()
    whole = (found[["size", "nunique", "max"]].eq(found["iterations"], axis=0)).all(axis=1) & (found["min"] == 1)
    if not whole.all():
        first = found[~whole].iloc[0]
        raise SweepError(
            f"{where} does not have each iteration from 1 to {first['iterations']} once of {cell_of(first)}; "
            "it was cut short or changed: export it anew."
        )


def combine(
    tables: Iterable[tuple[str, pd.DataFrame]], matters: Callable[[pd.DataFrame], bool] = lambda run: True
) -> pd.DataFrame:
    """
    :param tables: of finished runs, each with the name of its file
    :param matters: says of a run's rows whether they will be used
    :return: all of them in one; of runs that are there several times the first
    :raises SweepError: if these have different results, and matter
    """
    seen: dict[str, tuple[str, pd.DataFrame]] = {}
    tables = list(tables)
    for name, table in tables:
        for run in runs_of(table):
            cell = cell_of(run.iloc[0])
            before, first = seen.setdefault(cell.key, (name, run))
            if first is not run and not _have_same_results(first, run) and matters(run):
                of_cell = f"seed {cell.seed} of {cell.label}, {cell.iterations} iterations"
                where = f"both {before} and {name}" if before != name else f"{name} twice"
                raise SweepError(f"{of_cell} is in {where} with different results; leave out one of them.")
    runs = [run for _, run in seen.values()]
    return pd.concat(runs, ignore_index=True) if runs else tables[0][1]


def different_results(one: pd.DataFrame, other: pd.DataFrame) -> int:
    """
    :param one: of finished runs
    :param other: likewise
    :return: number of the cells that are in both with different results
    """
    first, second = ({cell_of(run.iloc[0]).key: run for run in runs_of(table)} for table in (one, other))
    return sum(not _have_same_results(first[key], second[key]) for key in first.keys() & second.keys())


def _have_same_results(first: pd.DataFrame, second: pd.DataFrame) -> bool:
    one, other = (run.sort_values("iteration")[_RESULT_COLUMNS].to_numpy(float) for run in (first, second))
    return np.array_equal(one, other, equal_nan=True)
