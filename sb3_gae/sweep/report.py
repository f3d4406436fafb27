"""Where a sweep stands, as text."""

from collections import Counter
from typing import Any

from sb3_gae.sweep.grid import Cell
from sb3_gae.sweep.ledger import Standing, Status

_LISTED = 20


def overview(name: str, table: dict[str, Standing]) -> str:
    """
    :param name: of the sweep
    :param table: where each cell stands, by its key
    :return: counts in all, and a line for each curve
    """
    counts = Counter(standing.status for standing in table.values())
    parts = [f"{counts[Status.DONE]} done"]
    parts += [f"{counts[status]} {status}" for status in (Status.RUNNING, Status.FAILED) if counts[status]]
    parts.append(f"{counts[Status.WAITING] + counts[Status.MISSING]} left")
    lines = [f"sweep {name!r}: {len(table)} cells, {', '.join(parts)}"]
    curves: dict[str, list[Standing]] = {}
    for key, standing in table.items():
        curves.setdefault(_curve_of(Cell.from_key(key)), []).append(standing)
    for curve, standings in curves.items():
        done = sum(standing.status == Status.DONE for standing in standings)
        lines.append(f"  {done:>3}/{len(standings)} {curve}")
    return "\n".join(lines)


def failures(table: dict[str, Standing], *, tracebacks: bool = False) -> str:
    """
    :param table: where each cell stands, by its key
    :param tracebacks: whether each line is followed by the traceback
    :return: a line for each cell that failed, with its reason; at most the first 20
    """
    failed = [
        f"failed: {_named(key)}: {one.reason}\n{one.traceback if tracebacks else ''}"
        for key, one in table.items()
        if one.status == Status.FAILED
    ]
    more = f"... and {len(failed) - _LISTED} more\n" if len(failed) > _LISTED else ""
    advice = "Run them again with --retry-failed; see their tracebacks with status --tracebacks.\n" if failed else ""
    return "".join(failed[:_LISTED]) + more + advice


def running(table: dict[str, Standing]) -> str:
    """
    :param table: where each cell stands, by its key
    :return: a line for each cell that runs: where, and how far it is
    """
    lines = []
    for key, standing in table.items():
        if standing.status == Status.RUNNING and standing.trial is not None:
            sign: dict[str, Any] = standing.trial.user_attrs.get("sign_of_life", {})
            reached = max(standing.trial.intermediate_values, default=0)
            who = f"process {sign.get('pid', '?')} on {sign.get('host', '?')}"
            lines.append(f"running: {_named(key)}: {reached} iterations stored, {who}\n")
    return "".join(lines)


def _curve_of(cell: Cell) -> str:
    overrides = "" if cell.overrides == "{}" else f", {cell.overrides}"
    return f"{cell.label}, {cell.iterations} iterations{overrides}"


def _named(key: str) -> str:
    return str(Cell.from_key(key))
