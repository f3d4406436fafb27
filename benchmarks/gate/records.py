"""What was recorded of unchanged code, and the history of what the gate measured, in files of the repository."""

import csv
import json
from pathlib import Path
from typing import Any

RESULTS = Path(__file__).parents[1] / "results"
#: what the bands are derived from
RECORDS = RESULTS / "gate.json"
#: a row for each number of each recorded commit
HISTORY = RESULTS / "gate_history.csv"
HISTORY_COLUMNS = ("date", "commit", "part", "name", "value", "low", "high")


def read_records() -> dict[str, Any]:
    """
    :return: what :mod:`benchmarks.gate.parts` has recorded of each part, by its name, and under ``"of"`` of which code that is
    :raises SystemExit: if nothing was ever recorded
    """
    if not RECORDS.exists():
        raise SystemExit(f"There is no {RECORDS}; record what unchanged code does: python -m benchmarks.gate record")
    return json.loads(RECORDS.read_text())


def write_records(records: dict[str, Any]) -> None:
    """
    :param records: as :func:`read_records` returns them
    """
    RECORDS.parent.mkdir(exist_ok=True)
    RECORDS.write_text(json.dumps(records, indent=1, sort_keys=True, ensure_ascii=False) + "\n")


def add_to_history(rows: list[dict[str, Any]]) -> None:
    """
    :param rows: with the keys of :data:`HISTORY_COLUMNS`
    """
    new = not HISTORY.exists()
    with HISTORY.open("a", newline="") as file:
        writer = csv.DictWriter(file, HISTORY_COLUMNS, lineterminator="\n")
        if new:
            writer.writeheader()
        writer.writerows(rows)
