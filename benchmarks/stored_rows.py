"""Rows of a CSV file that a measurement adds to as it goes, so that what is stored need not be run again."""

import csv
from collections.abc import Iterable
from pathlib import Path
from typing import Any


def stored(path: Path) -> list[dict[str, str]]:
    """
    :param path: of the file
    :return: its rows, none if there is no such file
    """
    if not path.exists():
        return []
    with path.open() as file:
        return list(csv.DictReader(file))


def store(path: Path, rows: Iterable[dict[str, Any]]) -> None:
    """
    :param path: of the file, made if there is none
    :param rows: to be added, all with the same keys; floats keep four digits
    """
    rows, new = list(rows), not path.exists()
    with path.open("a", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        if new:
            writer.writeheader()
        writer.writerows({name: f"{v:.4g}" if isinstance(v, float) else v for name, v in row.items()} for row in rows)
