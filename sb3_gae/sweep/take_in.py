"""Exported results back into a sweep: what was run elsewhere, or long ago, need not be run again."""

import json
import math
from collections.abc import Iterator
from typing import Any

import pandas as pd

from sb3_gae.sweep.provenance import PROVENANCE_COLUMNS
from sb3_gae.sweep.recorder import COLUMNS as ROW_COLUMNS
from sb3_gae.sweep.results import cell_of
from sb3_gae.sweep.study import SweepStudy


def take_in(study: SweepStudy, table: pd.DataFrame) -> int:
    """
    Add the cells of an exported file that a sweep does not have. A cell that is done stays as it is.

    :param study: of the sweep
    :param table: from :func:`~sb3_gae.sweep.results.read_results`
    :return: number of cells that were added
    :raises SweepError: if the storage cannot be used
    """
    return sum(study.add_finished(cell_of(run.iloc[0]), list(_rows_of(run)), **_about(run.iloc[0])) for run in runs_of(table))


def runs_of(table: pd.DataFrame) -> Iterator[pd.DataFrame]:
    """
    :param table: of one sweep or of several
    :return: the rows of each run
    """
    # The number of a trial names a run only within its sweep
    for _, rows in table.groupby(["sweep", "trial"], sort=False):
        yield rows


def _rows_of(run: pd.DataFrame) -> Iterator[dict[str, float]]:
    for values in run[list(ROW_COLUMNS)].itertuples(index=False, name=None):
        yield dict(zip(ROW_COLUMNS, values, strict=True))


def _about(row: Any) -> dict[str, Any]:
    return {
        "settings": json.loads(row.settings or "{}"),
        "provenance": {name: row[name] for name in PROVENANCE_COLUMNS},
        "setup_seconds": None if math.isnan(row.setup_seconds) else float(row.setup_seconds),
    }
