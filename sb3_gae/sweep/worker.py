"""A process that runs one cell after another until none is to be had."""

import contextlib
import ctypes
import gc
import math
import multiprocessing
import signal
import time
import traceback
import warnings
from collections.abc import Callable
from types import FrameType
from typing import Any

import torch as th

from sb3_gae.sweep.errors import SweepError, in_one_line
from sb3_gae.sweep.experiment import Experiment
from sb3_gae.sweep.ledger import Outcome
from sb3_gae.sweep.liveness import patience_with
from sb3_gae.sweep.patience import Patience
from sb3_gae.sweep.plan import Options, Plan
from sb3_gae.sweep.provenance import provenance
from sb3_gae.sweep.recorder import Row
from sb3_gae.sweep.settings import import_packages
from sb3_gae.sweep.study import Claim, SweepStudy, TakenOverError

#: seconds between pieces of a learning curve: each costs a write that other processes wait for
_STORE_EVERY = 5.0
#: seconds that a cell must have taken for its memory to be worth a search
_LONG_CELL = 30.0


class StoppedError(Exception):
    """The process was asked to stop."""


class StopRequest:
    """
    Whether to stop: set by Ctrl-C and SIGTERM, or when the process that started this one is gone.

    The signal only sets a mark. Raised from where it arrives, it could leave the storage locked.
    """

    def __init__(self) -> None:
        self.reason = ""
        self._looked = 0.0

    def listen(self) -> dict[int, Any]:
        """:return: the handlers before, for :meth:`restore`"""
        return {number: signal.signal(number, self._receive) for number in (signal.SIGINT, signal.SIGTERM)}

    @staticmethod
    def restore(handlers: dict[int, Any]) -> None:
        """:param handlers: to be put back"""
        for number, handler in handlers.items():
            signal.signal(number, handler)

    def _receive(self, number: int, frame: FrameType | None) -> None:
        self.reason = f"stopped by {signal.Signals(number).name}"

    def is_set(self) -> bool:
        """:return: whether to stop now"""
        # Asked at every step of the environments; a look at the other process takes longer than some of them
        if not self.reason and time.monotonic() - self._looked > 1.0:
            self._looked = time.monotonic()
            parent = multiprocessing.parent_process()
            if parent is not None and not parent.is_alive():
                self.reason = "stopped since the command that started it is gone"
        return bool(self.reason)


def work(plan: Plan, stop: StopRequest, patience: Patience, on_claim: Callable[[], None] = lambda: None) -> None:
    """
    Run cells until none waits.

    :param plan: what to run
    :param stop: asked at every step
    :param patience: with a storage that does not answer
    :param on_claim: called before each cell
    :raises SweepError: if the storage cannot be used any more
    """
    n_threads = th.get_num_threads()
    th.set_num_threads(plan.options.threads)
    try:
        # The sweep has begun: that its storage does not answer may pass
        study = patience(lambda: SweepStudy(plan.name, plan.location, silent_after=plan.silent_after, patience=patience))
        while not stop.is_set() and (claim := study.claim(plan.cells)) is not None:
            on_claim()
            start = time.monotonic()
            run_claim(claim, plan.options, stop)
            if time.monotonic() - start > _LONG_CELL:
                return_freed_memory()
    finally:
        th.set_num_threads(n_threads)


def return_freed_memory() -> None:
    """
    Give the system what a cell has freed. glibc would keep it, in pieces that the next cell's batches do not fit into, so that
    a process grows by hundreds of MiB with each cell of a robot.
    """
    gc.collect()
    # Other C libraries have no such function, and Windows has no handle for the process
    with contextlib.suppress(AttributeError, OSError, TypeError):
        ctypes.CDLL(None).malloc_trim(0)


def work_as_process(plan: Plan, messages: Any, has_claimed: Any) -> None:
    """
    :func:`work` in a process of its own.

    :param plan: what to run
    :param messages: a queue for the one line to print if it cannot go on
    :param has_claimed: a shared number without a lock, which becomes 1 with the first cell
    :raises SystemExit: with status 2, once the line is in the queue
    """
    stop = StopRequest()
    stop.listen()

    def on_claim() -> None:
        has_claimed.value = 1

    try:
        import_packages(plan.options.gym_packages)
        work(plan, stop, Patience(patience_with(plan.silent_after), stop.is_set), on_claim)
    except SweepError as error:
        messages.put(str(error))
        raise SystemExit(2) from None


def run_claim(claim: Claim, options: Options, stop: StopRequest) -> None:
    """
    Run a cell, and store how it ended.

    :param claim: of the cell
    :param options: how it is run
    :param stop: asked at every step
    :raises SweepError: if the storage cannot be used any more
    """
    curve = _CurveWriter(claim, stop)
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("default")
            experiment = Experiment(claim.cell, options)
            claim.describe(settings=experiment.settings, provenance=provenance(), setup_seconds=round(experiment.seconds, 4))
            experiment.run(curve.add, curve.step)
        curve.flush()
        if caught:
            claim.describe(warnings=sorted({str(warning.message) for warning in caught})[:10])
        claim.complete(curve.last_return)
    except TakenOverError:
        return
    except (StoppedError, KeyboardInterrupt):
        _give_up(claim, curve, Outcome.STOPPED, stop.reason or "stopped")
    except SweepError:
        raise
    except (Exception, SystemExit) as error:
        # A task that asks for the end of the program ends its cell. The end of a traceback is the innermost, and a database
        # may have no room for more
        _give_up(
            claim, curve, Outcome.FAILED, _reason_of(error), traceback="".join(traceback.format_exception(error))[-20_000:]
        )


def _give_up(claim: Claim, curve: "_CurveWriter", outcome: Outcome, reason: str, **what: Any) -> None:
    try:
        curve.flush()
        claim.describe(**what)
        claim.give_up(outcome, f"{reason} (after iteration {curve.n_rows} of {claim.cell.iterations})")
    except TakenOverError:
        pass


def _reason_of(error: BaseException) -> str:
    last = traceback.extract_tb(error.__traceback__)[-1]
    what = in_one_line(error, longest=None)
    return f"{type(error).__name__}: {what} [{last.name}, {last.filename.rsplit('/', 1)[-1]}:{last.lineno}]"


class _CurveWriter:
    """
    Stores rows in pieces.

    :param claim: of the cell
    :param stop: asked at every step
    """

    def __init__(self, claim: Claim, stop: StopRequest):
        self.n_rows = 0
        self.last_return = -math.inf  # of a run in which no episode ended
        self._claim, self._stop = claim, stop
        self._rows: list[Row] = []
        self._stored = self._beaten = time.monotonic()

    def add(self, row: Row) -> None:
        self._rows.append(row)
        self.n_rows += 1
        if not math.isnan(row["mean_return"]):
            self.last_return = row["mean_return"]
        if time.monotonic() - self._stored > _STORE_EVERY:
            self.flush()

    def flush(self) -> None:
        self._claim.append(self._rows)
        self._rows = []
        self._stored = self._beaten = time.monotonic()

    def step(self) -> None:
        if self._stop.is_set():
            raise StoppedError
        if time.monotonic() - self._beaten > self._claim.beat_every:
            self._claim.beat()
            self._beaten = time.monotonic()
