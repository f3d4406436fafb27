"""Results into files that other programs read."""

import tempfile
from collections.abc import Callable
from pathlib import Path

import pandas as pd

from sb3_gae.sweep.errors import SweepError
from sb3_gae.sweep.results import NO_PARQUET, identities, is_parquet, read_results
from sb3_gae.sweep.runs import STATE_COLUMN, different_results, finished

SUFFIXES = (".csv", ".csv.gz", ".parquet")


def export(table: pd.DataFrame, path: str | Path) -> Path:
    """
    Write a table of results, whole or not at all. A file of the same sweep is replaced if nothing in it is lost.

    :param table: of results, from :func:`~sb3_gae.sweep.results.results_of`
    :param path: ending in ``.csv``, ``.csv.gz`` or ``.parquet``
    :return: the path
    :raises SweepError: if there is nothing to write, the file is another's or holds more, or it cannot be written
    """
    path = Path(path)
    if not path.name.endswith(SUFFIXES):
        raise SweepError(f"`output` must end in {', '.join(SUFFIXES)}, got {path.name!r}.")
    if table.empty:
        raise SweepError("There is nothing to export: no cell has finished yet; see: python -m sb3_gae.sweep status")
    if path.exists():
        _check_replaceable(table, path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        _write_whole(path, lambda to: _write(table, to))
    except OSError as error:
        raise SweepError(f"`output`: {path} cannot be written ({error}); name another file.") from error
    return path


def _check_replaceable(table: pd.DataFrame, path: Path) -> None:
    try:
        before = read_results(path, partial=True)
    except SweepError as error:
        raise SweepError(f"`output`: {path} exists and is not replaced ({error}); name another file or remove it.") from None
    if other := set(before["sweep"]) - set(table["sweep"]):
        raise SweepError(f"`output`: {path} holds the sweep {', '.join(sorted(other))!r}; name another file or remove it.")
    if STATE_COLUMN in before and STATE_COLUMN not in table:
        raise SweepError(f"`output`: {path} has runs that are not finished, too; pass --partial, or name another file.")
    if others := different_results(finished(before), finished(table)):
        raise SweepError(
            f"`output`: {path} has other results than the storage for {others} of the runs that both have, as after a change "
            "of settings or code; name another file or remove it."
        )
    if lost := len(identities(before) - identities(table)):
        raise SweepError(f"`output`: {path} holds {lost} rows that are not in the storage; name another file or remove it.")


def _write(table: pd.DataFrame, path: Path) -> None:
    if not is_parquet(path):
        table.to_csv(path, index=False, lineterminator="\n")
        return
    try:
        table.to_parquet(path, index=False, compression="zstd")
    except ImportError:
        raise SweepError(NO_PARQUET) from None


def _write_whole(path: Path, write: Callable[[Path], None]) -> None:
    """Beside the file first, so that a reader, or a full disk, never sees half of it."""
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=f".{path.name}.") as folder:
        part = Path(folder) / path.name
        write(part)
        part.replace(path)
