"""Rows of a CSV file that a measurement adds to as it goes, so that what is stored need not be run again."""

import argparse
import csv
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import torch as th


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
    :param rows: to be added, all with the same keys in the same order
    """
    rows, new = list(rows), not path.exists()
    path.parent.mkdir(exist_ok=True)
    with path.open("a", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        if new:
            writer.writeheader()
        writer.writerows(rows)


def measure(
    description: str | None,
    path: Path,
    agents: Iterable[tuple[str, int]],
    rows_of: Callable[[str, int], Iterable[dict[str, Any]]],
    summary: Callable[[], str],
) -> None:
    """
    The command of such a measurement: run what is not stored yet, agent by agent, and print the summary.

    :param description: of the command
    :param path: of the file
    :param agents: task and seed of each
    :param rows_of: measures one, with columns ``env`` and ``seed``; of floats four digits are stored
    :param summary: of all that is stored
    """
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--summary", action="store_true", help="run nothing")
    args = parser.parse_args()
    th.set_num_threads(1)
    known = {(row["env"], int(row["seed"])) for row in stored(path)}
    for env_id, seed in agents:
        if not args.summary and (env_id, seed) not in known:
            store(path, map(_shortened, rows_of(env_id, seed)))
    print(summary())


def _shortened(row: dict[str, Any]) -> dict[str, Any]:
    return {name: f"{value:.4g}" if isinstance(value, float) else value for name, value in row.items()}
