"""Results as a table: a row for each iteration of each finished cell, from a study or from an exported file."""

import json
import zlib
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
from optuna.trial import FrozenTrial, TrialState

from sb3_gae.sweep.errors import SweepError, in_one_line
from sb3_gae.sweep.grid import Cell
from sb3_gae.sweep.ledger import Outcome, Status, standings
from sb3_gae.sweep.provenance import PROVENANCE_COLUMNS
from sb3_gae.sweep.recorder import COLUMNS as ROW_COLUMNS
from sb3_gae.sweep.runs import CELL_COLUMNS, STATE_COLUMN, cell_of, check_runs, finished
from sb3_gae.sweep.study import FORMAT, SweepStudy

_TEXT_COLUMNS = ("sweep", "task", "condition", "overrides", *PROVENANCE_COLUMNS, "settings")
_COUNT_COLUMNS = ("format", "seed", "iterations", "iteration", "timesteps", "episodes", "trial")
#: of the table and of exported files
COLUMNS = ("format", "sweep", *CELL_COLUMNS, *ROW_COLUMNS, "setup_seconds", "trial", *PROVENANCE_COLUMNS, "settings")


def results_of(study: SweepStudy, *, partial: bool = False) -> pd.DataFrame:
    """
    :param study: of a sweep
    :param partial: whether to include what is stored of other runs; a column ``state`` then tells ``done``, ``running``,
        ``failed``, ``stopped`` and ``lost`` apart
    :return: finished cells, with the columns of :data:`~sb3_gae.sweep.results.COLUMNS`, in the order of their trials
    :raises SweepError: if the storage cannot be used any more
    """
    trials = study.trials()
    done = {
        standing.trial.number for standing in standings(trials).values() if standing.status == Status.DONE and standing.trial
    }
    states = {trial.number: Status.DONE if trial.number in done else _state_of(trial) for trial in trials}
    rows = [
        row | {STATE_COLUMN: str(states[trial.number])}
        for trial in sorted(trials, key=lambda trial: trial.number)
        if trial.number in done or (partial and "cell" in trial.user_attrs)
        for row in _rows_of(trial, study.name)
    ]
    return _typed(pd.DataFrame(rows, columns=[*COLUMNS, *([STATE_COLUMN] if partial else [])]))


def _state_of(trial: FrozenTrial) -> str:
    return "running" if trial.state == TrialState.RUNNING else str(trial.user_attrs.get("outcome", Outcome.FAILED))


def _rows_of(trial: FrozenTrial, sweep: str) -> Iterator[dict[str, Any]]:
    stored = trial.user_attrs
    constants: dict[str, Any] = {
        "format": FORMAT,
        "sweep": sweep,
        **stored["cell"],
        "setup_seconds": stored.get("setup_seconds"),
        "trial": trial.number,
        **{name: stored.get("provenance", {}).get(name, "") for name in PROVENANCE_COLUMNS},
        "settings": json.dumps(stored.get("settings", {}), sort_keys=True),
    }
    for name in sorted(name for name in stored if name.startswith("rows:")):
        chunk = stored[name]
        for values in zip(*chunk.values(), strict=True):
            yield constants | dict(zip(chunk, values, strict=True))


def read_results(path: str | Path, *, partial: bool = False) -> pd.DataFrame:
    """
    :param path: of an exported ``.csv`` (perhaps compressed) or ``.parquet`` file
    :param partial: whether to keep what is not finished, if the file has such runs
    :return: its table, with the columns of :data:`~sb3_gae.sweep.results.COLUMNS`
    :raises SweepError: if there is no such file, it is something else, another version wrote it, or runs in it are not whole
    """
    path = Path(path)
    try:
        table = _checked(read_parquet(path) if is_parquet(path) else _read_csv(path), path)
    except FileNotFoundError:
        raise SweepError(f"There is no results file {path}; make it with: python -m sb3_gae.sweep export") from None
    except SweepError:
        raise
    except (OSError, ValueError, EOFError, zlib.error) as error:
        raise SweepError(f"{path} cannot be read as a results file ({in_one_line(error)}).") from error
    check_runs(finished(table), str(path))
    return table if partial else finished(table)


def _checked(table: pd.DataFrame, path: Path) -> pd.DataFrame:
    """
    :param table: as it was read
    :param path: it was read from, for messages
    :return: the same, with the columns of :data:`~sb3_gae.sweep.results.COLUMNS`
    :raises SweepError: if it is something else, or another version wrote it
    :raises ValueError: if values are missing, or of the wrong type
    """
    if "format" not in table or "sweep" not in table:
        raise SweepError(f"{path} is not a results file of a sweep; make one with: python -m sb3_gae.sweep export")
    versions = sorted(set(table["format"]))
    if versions != [FORMAT] and versions:
        written = ", ".join(map(str, versions))
        raise SweepError(f"{path} is of format {written}, and this sb3-gae knows {FORMAT}; export it anew from its storage.")
    if missing := [name for name in COLUMNS if name not in table]:
        raise SweepError(f"{path} lacks the columns {', '.join(missing)}; export it anew from its storage.")
    return _typed(table)


def _read_csv(path: Path) -> pd.DataFrame:
    # Texts as they are: a commit may look like a number
    return pd.read_csv(path, dtype=dict.fromkeys((*_TEXT_COLUMNS, STATE_COLUMN), str), float_precision="round_trip")


def is_parquet(path: Path) -> bool:
    """
    :param path: of an exported file
    :return: whether it is Parquet, else CSV
    """
    return path.suffix == ".parquet"


def read_parquet(path: Path) -> pd.DataFrame:
    """
    :param path: of the file
    :return: its table
    :raises SweepError: if no library for it is installed
    """
    try:
        return pd.read_parquet(path)
    except ImportError:
        raise SweepError(NO_PARQUET) from None


NO_PARQUET = 'Parquet needs pyarrow: pip install "sb3-gae[sweep]", or use a .csv file.'


def _typed(table: pd.DataFrame) -> pd.DataFrame:
    """The same types, whether from a study, CSV or Parquet."""
    types: dict[str, Any] = dict.fromkeys(COLUMNS, float)
    types |= dict.fromkeys(_COUNT_COLUMNS, "int64") | dict.fromkeys(_TEXT_COLUMNS, object)
    table = table[[*COLUMNS, *([STATE_COLUMN] if STATE_COLUMN in table else [])]]
    return table.fillna(dict.fromkeys(_TEXT_COLUMNS, "")).astype(types)


def identities(table: pd.DataFrame) -> set[tuple[Any, ...]]:
    """
    :param table: of results
    :return: what tells its rows apart
    """
    columns: Sequence[str] = (*CELL_COLUMNS, "iteration")
    return set(table[list(columns)].fillna({"gae_lambda": -1.0}).itertuples(index=False, name=None))


def rows_of_cells(table: pd.DataFrame, cells: Iterable[Cell]) -> pd.DataFrame:
    """
    :param table: of results
    :param cells: of a grid
    :return: the rows of these cells
    """
    trials = table.drop_duplicates("trial")
    keys = {cell.key for cell in cells}
    own = [trial.trial for trial in trials.itertuples() if cell_of(trial).key in keys]
    return table[table["trial"].isin(own)].reset_index(drop=True)
