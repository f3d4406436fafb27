"""A progress bar that counts what every machine has done, read from the storage."""

import time
from collections.abc import Sequence
from types import TracebackType
from typing import Self

from tqdm import tqdm

from sb3_gae.sweep.grid import Cell
from sb3_gae.sweep.ledger import Standing, Status
from sb3_gae.sweep.study import SweepStudy


class Progress:
    """
    A context that shows iterations done, and the time left at the speed since it began.

    :param study: of the sweep
    :param cells: that count
    :param show: whether to show anything
    """

    def __init__(self, study: SweepStudy, cells: Sequence[Cell], *, show: bool = True):
        self._study, self._cells = study, cells
        total = sum(cell.iterations for cell in cells)
        self._bar = tqdm(total=total, initial=self._count()[0], unit="it", smoothing=0, dynamic_ncols=True, disable=not show)
        self._shown = time.monotonic()

    def __enter__(self) -> Self:
        self.show()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None) -> None:
        if error is None:
            self.show()
        self._bar.close()

    def show_now_and_then(self, seconds: float) -> None:
        """:param seconds: to wait since it was last shown"""
        if time.monotonic() - self._shown > seconds:
            self.show()

    def show(self) -> None:
        """Read the storage and show what it says."""
        if self._bar.disable:
            return
        iterations, done, failed = self._count()
        self._bar.set_postfix_str(f"{done}/{len(self._cells)} cells" + (f", {failed} failed" if failed else ""), refresh=False)
        # Backwards where a cell begins anew
        self._bar.n = iterations
        self._bar.refresh()
        self._shown = time.monotonic()

    def _count(self) -> tuple[int, int, int]:
        table = self._study.standings()
        found = [(cell, table[cell.key]) for cell in self._cells if cell.key in table]
        iterations = sum(_iterations_of(cell, standing) for cell, standing in found)
        done, failed = (sum(standing.status == status for _, standing in found) for status in (Status.DONE, Status.FAILED))
        return iterations, done, failed


def _iterations_of(cell: Cell, standing: Standing) -> int:
    # A failed cell is not run any further: for the time left it counts as done
    if standing.status in (Status.DONE, Status.FAILED):
        return cell.iterations
    if standing.status != Status.RUNNING or standing.trial is None:
        return 0
    return max(standing.trial.intermediate_values, default=0)
