"""Files of results, small enough to be committed."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from benchmarks.peers.errors import PeersError
from benchmarks.peers.provenance import origin

RESULTS = Path(__file__).parents[1] / "results"
#: of each verb
SPEED, TARGETS, SECONDS, THREADS = (
    RESULTS / f"{name}.json" for name in ("speed", "speed_targets", "iteration_seconds", "threads")
)


def rows_of(raw: Mapping[str, Any]) -> list[dict[str, Any]]:
    """
    :param raw: what pytest-benchmark wrote
    :return: a row for each case: median and interquartile range in seconds, of one of what the cost is of
    """
    rows = []
    for benchmark in raw["benchmarks"]:
        about, stats = benchmark["extra_info"], benchmark["stats"]
        times = {name: float(f"{stats[name] / about['repeats']:.4g}") for name in ("median", "iqr")}
        case = {name: about[name] for name in ("part", "varied", "size", "contender")}
        rows.append(case | times | {"rounds": stats["rounds"]} | about["facts"])
    return rows


def write(path: Path, rows: list[dict[str, Any]], **about: Any) -> None:
    """
    :param path: to be written, with a line for each row, so that a difference can be read
    :param rows: of results
    :param about: how they were measured; where and with what is added
    """
    head = {"origin": {name: value for name, value in origin().items() if value != ""}, **about}
    lines = ",\n  ".join(json.dumps(row, ensure_ascii=False) for row in rows)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(head, indent=1, ensure_ascii=False)[:-2] + f',\n "rows": [\n  {lines}\n ]\n}}\n')


def read(path: Path) -> dict[str, Any]:
    """
    :param path: of a file that :func:`write` wrote
    :return: ``rows``, ``origin``, and how they were measured; no rows where there is no file yet
    :raises PeersError: if it is no such file
    """
    if not path.exists():
        return {"rows": [], "origin": {}}
    try:
        found = json.loads(path.read_text())
    except ValueError as error:
        raise PeersError(f"{path} is no file of results; measure anew, see python -m benchmarks.speed --help") from error
    if not (isinstance(found, dict) and {"rows", "origin"} <= found.keys()):
        raise PeersError(f"{path} has no rows of results; measure anew, see python -m benchmarks.speed --help")
    return found
