"""Results as a table with a row for each evaluation: from the files of runs, and in the committed files."""

import json
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import pandas as pd

from benchmarks.peers.errors import PeersError
from benchmarks.peers.journal import Record, State, read_record
from benchmarks.peers.plan import Cell

RESULTS = Path(__file__).parents[1] / "results" / "peers"
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
        "settings_hash": record.start["settings_hash"],
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


def export(table: pd.DataFrame, folder: Path = RESULTS) -> list[Path]:
    """
    Write a file for each task; runs that stand in a file already and are not in the table stay there.

    :param table: of :func:`gather`
    :param folder: of the files
    :return: their paths
    :raises PeersError: if there is nothing to write
    """
    if table.empty:
        raise PeersError("There is nothing to export: no run is done; see: python -m benchmarks.peers status")
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for task, rows in table.groupby("task"):
        path = folder / f"{task}.parquet"
        if path.exists():
            rows = replaced(pd.read_parquet(path), rows)
        part = path.with_name(f".{path.name}")
        ordered = rows.sort_values([*_OF_THE_RUN, "step"]).reset_index(drop=True)
        ordered.to_parquet(part, index=False, compression="zstd")
        # A reader, or a full disk, never sees half of it
        part.replace(path)
        paths.append(path)
    return paths


def replaced(before: pd.DataFrame, rows: pd.DataFrame) -> pd.DataFrame:
    """
    :param before: a table
    :param rows: of other runs, or of the same
    :return: both, without what the first has of runs that the second has
    """
    new = set(rows[_OF_THE_RUN].itertuples(index=False, name=None))
    kept = [run not in new for run in before[_OF_THE_RUN].itertuples(index=False, name=None)]
    return pd.concat([before[kept], rows], ignore_index=True)


def read_results(folder: Path = RESULTS) -> pd.DataFrame:
    """
    :param folder: that :func:`export` wrote to
    :return: all rows; an empty table if there are no files
    """
    files: Iterable[Path] = sorted(folder.glob("*.parquet"))
    tables = [pd.read_parquet(file) for file in files]
    return pd.concat(tables, ignore_index=True) if tables else pd.DataFrame(columns=[*_OF_THE_RUN, "step"])
