"""Where the runs of a plan stand."""

import time
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from tqdm import tqdm

from benchmarks.peers.cost import Speeds, cost_of
from benchmarks.peers.journal import Record, State, journal_path, read_record
from benchmarks.peers.plan import Cell
from benchmarks.peers.settings import described, settings_of


class Standing(NamedTuple):
    """
    :param cell: of the plan
    :param record: what the file of its run says
    :param state: of the run
    """

    cell: Cell
    record: Record
    state: State


def standings(cells: Sequence[Cell], logs: Path, committed: Mapping[Cell, str]) -> list[Standing]:
    """
    :param cells: of the plan
    :param logs: folder of all runs
    :param committed: settings of the runs whose results are committed, see :func:`~benchmarks.peers.table.committed_settings`
    :return: where each stands
    """
    return [_standing(cell, read_record(journal_path(logs, cell)), committed) for cell in cells]


def _standing(cell: Cell, record: Record, committed: Mapping[Cell, str]) -> Standing:
    settings = described(cell.algorithm, settings_of(cell))
    state = record.state(settings)
    # What has begun here, and may be one of the seeds that others run as well, goes on
    if state not in (State.DONE, State.UNFINISHED) and committed.get(cell) == settings:
        state = State.COMMITTED
    return Standing(cell, record, state)


def left_of(table: Sequence[Standing], again: Sequence[State] = ()) -> list[Cell]:
    """
    :param table: where the cells stand
    :param again: states that are run again, beside those that are not finished
    :return: what there is to run, in the order of the plan
    """
    return [one.cell for one in table if one.state in (State.NEW, State.UNFINISHED, *again)]


def summary(table: Sequence[Standing], left: Sequence[Cell], speeds: Speeds, jobs: int) -> str:
    """
    :param table: where the cells stand
    :param left: to be run
    :param speeds: measured beforehand
    :param jobs: runs side by side
    :return: for people: counts, what failed, and how long the rest takes
    """
    counts = Counter(one.state for one in table)
    lines = [f"{len(table)} runs: " + ", ".join(f"{counts[state]} {state}" for state in State if counts[state])]
    for one in table:
        if one.state == State.FAILED and one.record.end is not None:
            lines.append(f"  failed: {one.cell.name}: {one.record.end['reason']}")
        elif one.state == State.STALE:
            lines.append(f"  stale: {one.cell.name} was run with other settings than today's; run it again with --again stale")
    if left:
        runs = [(one.cell, one.record) for one in table if one.state == State.DONE]
        hours = {cell: cost_of(cell, speeds, runs) / 3600 for cell in left}
        total = sum(hours.values())
        lines.append(
            f"{len(left)} runs left, about {total:.1f} core-hours, {total / jobs:.1f} hours with {jobs} side by side:"
        )
        for task in dict.fromkeys(cell.task for cell in left):
            own = [cell for cell in left if cell.task == task]
            lines.append(f"  {task}: {sum(hours[cell] for cell in own):.1f} core-hours ({_by_kind(own, hours)})")
    return "\n".join(lines)


def _by_kind(cells: Sequence[Cell], hours: dict[Cell, float]) -> str:
    """Number of runs and hours of each, such as ``trpo 5 × 0.2``."""
    kinds: dict[str, list[float]] = {}
    for cell in cells:
        kinds.setdefault(cell.kind, []).append(hours[cell])
    return ", ".join(f"{kind} {len(own)} × {sum(own) / len(own):.2g}" for kind, own in kinds.items())


class Bar:
    """
    A line that counts steps of training.

    :param cells: that are run
    :param logs: folder of all runs
    """

    #: seconds between looks at the files
    INTERVAL = 5.0

    def __init__(self, cells: Sequence[Cell], logs: Path):
        self._cells, self._logs = cells, logs
        # What has ended and is among the cells is run again: until then its file says nothing of this run
        self._old = {cell: record for cell in cells if (record := self._read(cell)).end is not None}
        total = sum(cell.steps for cell in cells)
        self._shown = time.monotonic()
        steps, _ = self._count()
        self._bar = tqdm(total=total, initial=steps, unit=" steps", unit_scale=True, smoothing=0, dynamic_ncols=True)

    def show(self) -> None:
        """Look at the files, if the last look was long enough ago."""
        if time.monotonic() - self._shown < self.INTERVAL:
            return
        self._shown = time.monotonic()
        self._bar.n, done = self._count()
        self._bar.set_postfix_str(f"{done}/{len(self._cells)} runs", refresh=False)
        self._bar.refresh()

    def close(self) -> None:
        """Leave the line as it is."""
        self._bar.close()

    def _count(self) -> tuple[int, int]:
        found = ((cell, self._read(cell)) for cell in self._cells)
        records = {cell: record for cell, record in found if record != self._old.get(cell)}
        # What failed is not run any further
        steps = sum(
            cell.steps if record.end is not None else min(record.steps, cell.steps) for cell, record in records.items()
        )
        return steps, sum(record.end is not None for record in records.values())

    def _read(self, cell: Cell) -> Record:
        return read_record(journal_path(self._logs, cell))
