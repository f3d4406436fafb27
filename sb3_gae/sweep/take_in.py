"""Exported results back into a sweep: what was run elsewhere, or long ago, need not be run again."""

import json
import math
from collections.abc import Iterator
from typing import Any

import pandas as pd

from sb3_gae.sweep.agreement import check_alike, check_made_with, made_in
from sb3_gae.sweep.provenance import PROVENANCE_COLUMNS
from sb3_gae.sweep.recorder import COLUMNS as ROW_COLUMNS
from sb3_gae.sweep.runs import cell_of, check_runs, finished, runs_of
from sb3_gae.sweep.study import SweepStudy

_ADVICE = "import them into a sweep of another --name"


def take_in(study: SweepStudy, table: pd.DataFrame) -> int:
    """
    Add the cells of an exported file that a sweep does not have, or none of them. A cell that is done stays as it is.

    :param study: of the sweep
    :param table: from :func:`~sb3_gae.sweep.results.read_results`
    :return: number of cells that were added
    :raises SweepError: if runs are not whole or have other settings than the sweep, or the storage cannot be used
    """
    table = finished(table)
    check_runs(table, "The table")
    made = made_in(table)
    check_made_with(made, study.task_settings(), _ADVICE)
    check_alike([*study.made(), *made], _ADVICE)
    return sum(study.add_finished(cell_of(run.iloc[0]), list(_rows_of(run)), **_about(run.iloc[0])) for run in runs_of(table))


def _rows_of(run: pd.DataFrame) -> Iterator[dict[str, float]]:
    for values in run[list(ROW_COLUMNS)].itertuples(index=False, name=None):
        yield dict(zip(ROW_COLUMNS, values, strict=True))


def _about(row: Any) -> dict[str, Any]:
    return {
        "settings": json.loads(row.settings or "{}"),
        "provenance": {name: row[name] for name in PROVENANCE_COLUMNS},
        "setup_seconds": None if math.isnan(row.setup_seconds) else float(row.setup_seconds),
    }
