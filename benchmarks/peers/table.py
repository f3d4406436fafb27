"""Results as a table with a row for each evaluation: from the files of runs, and in the committed files."""

import json
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd

from benchmarks.peers.errors import PeersError
from benchmarks.peers.journal import Record, State, read_record
from benchmarks.peers.places import RESULTS
from benchmarks.peers.plan import Cell
from benchmarks.peers.settings import described

FORMAT = 1
_OF_THE_RUN = list(Cell._fields)


def rows_of(record: Record) -> Iterator[dict[str, Any]]:
    """
    :param record: of a run that is done
    :return: a row for each evaluation
    """
    assert record.start is not None
    cell = Cell(*record.start["cell"])
    constants = {
        "format": FORMAT,
        **cell._asdict(),
        "settings": json.dumps(record.start["settings"], sort_keys=True),
        **record.start["origin"],
        "begun": record.start["time"],
    }
    for line in record.evaluations:
        # Of the evaluation, not of the plan: `steps` is already the length of the training
        values = {name: value for name, value in line.items() if name not in ("kind", "steps")}
        yield {**constants, "step": line["steps"], **values}


def gather(logs: Path) -> tuple[pd.DataFrame, list[str]]:
    """
    :param logs: folder of all runs
    :return: rows of the runs that are done, and a line for each run that failed
    """
    rows: list[dict[str, Any]] = []
    failures = []
    for path in sorted(logs.glob("*.jsonl")):
        record = read_record(path)
        if record.start is None or record.end is None:
            continue
        if record.end["status"] == State.DONE:
            rows += rows_of(record)
        else:
            failures.append(f"{path.stem}: {record.end['reason']}")
    return pd.DataFrame(rows), failures


class Exported(NamedTuple):
    """
    :param paths: of the files
    :param notes: a line for each run of which the file had another
    """

    paths: list[Path]
    notes: list[str]


def export(table: pd.DataFrame, folder: Path) -> Exported:
    """
    Write a file for each task. A run that stands in a file already stays there, unless the table has the same run, begun no
    earlier.

    :param table: of :func:`gather`
    :param folder: of the files
    :return: what was done
    :raises PeersError: if there is nothing to write
    """
    if table.empty:
        raise PeersError("There is nothing to export: no run is done; see: python -m benchmarks.peers status")
    folder.mkdir(parents=True, exist_ok=True)
    paths, notes = [], []
    for task, rows in table.groupby("task"):
        path = folder / f"{task}.parquet"
        if path.exists():
            before = pd.read_parquet(path)
            notes += _changes(_begun(before), _begun(rows))
            rows = merged(before, rows)
        part = path.with_name(f".{path.name}")
        ordered = rows.sort_values([*_OF_THE_RUN, "step"]).reset_index(drop=True)
        ordered.to_parquet(part, index=False, compression="zstd")
        # A reader, or a full disk, never sees half of it
        part.replace(path)
        paths.append(path)
    return Exported(paths, notes)


def merged(before: pd.DataFrame, rows: pd.DataFrame) -> pd.DataFrame:
    """
    :param before: a table
    :param rows: of other runs, or of the same
    :return: both; of runs that both have, the one that was begun later, that of the second if they began at once
    """
    old, new = _begun(before), _begun(rows)
    return pd.concat(
        [
            before[[cell not in new or old[cell] > new[cell] for cell in _cells(before)]],
            rows[[cell not in old or old[cell] <= new[cell] for cell in _cells(rows)]],
        ],
        ignore_index=True,
    )


def _changes(old: dict[Cell, int], new: dict[Cell, int]) -> list[str]:
    notes = []
    for cell in new.keys() & old.keys():
        if old[cell] > new[cell]:
            notes.append(f"not exported, since the file has a run that was begun later: {cell.name}")
        elif old[cell] < new[cell]:
            notes.append(f"replaced by a run that was begun later: {cell.name}")
    return sorted(notes)


def _cells(table: pd.DataFrame) -> list[Cell]:
    return [Cell(*values) for values in table[_OF_THE_RUN].itertuples(index=False, name=None)]


def _begun(table: pd.DataFrame) -> dict[Cell, int]:
    """Second in which each run was begun."""
    return dict(zip(_cells(table), table["begun"], strict=True))


def committed_settings(folder: Path) -> dict[Cell, str]:
    """
    :param folder: that :func:`export` wrote to
    :return: settings of each run, see :func:`~benchmarks.peers.settings.described`
    """
    found: dict[Cell, str] = {}
    for file in folder.glob("*.parquet"):
        runs = pd.read_parquet(file, columns=[*_OF_THE_RUN, "settings"]).drop_duplicates()
        for cell, settings in zip(_cells(runs), runs["settings"], strict=True):
            found[cell] = described(cell.algorithm, json.loads(settings))
    return found


def read_results(folder: Path = RESULTS) -> pd.DataFrame:
    """
    :param folder: that :func:`export` wrote to
    :return: all rows; an empty table if there are no files
    """
    files: Iterable[Path] = sorted(folder.glob("*.parquet"))
    tables = [pd.read_parquet(file) for file in files]
    return pd.concat(tables, ignore_index=True) if tables else pd.DataFrame(columns=[*_OF_THE_RUN, "step"])
