"""Runs a grid: here, or in several processes."""

import contextlib
import multiprocessing
import queue
import signal
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from sb3_gae.sweep.errors import SweepError
from sb3_gae.sweep.ledger import Standing, Status
from sb3_gae.sweep.liveness import patience_with
from sb3_gae.sweep.machine import check_jobs, check_options
from sb3_gae.sweep.patience import Patience
from sb3_gae.sweep.plan import Plan
from sb3_gae.sweep.progress import Progress
from sb3_gae.sweep.settings import check_overrides, check_tasks, import_packages, shipped_settings
from sb3_gae.sweep.study import SweepStudy
from sb3_gae.sweep.worker import StopRequest, work, work_as_process

#: seconds between looks at the storage for the progress bar
_LOOK_EVERY = 2.0
#: seconds for processes that were asked to stop
_PATIENCE = 60.0
#: processes that may be killed one after another before they have a cell
_MAX_KILLED = 3


def check_plan(plan: Plan) -> dict[str, dict[str, Any]]:
    """
    :param plan: what a command asks for
    :return: the settings of each task, without overrides
    :raises SweepError: if something in it cannot be run
    """
    check_options(plan.options)
    import_packages(plan.options.gym_packages)
    tasks = list(dict.fromkeys(cell.task for cell in plan.cells))
    check_tasks(tasks)
    check_overrides(plan.cells)
    return {task: shipped_settings(task, plan.options.conf_file) for task in tasks}


def run_plan(
    plan: Plan, jobs: int = 1, *, retry_failed: bool = False, progress: bool = True, wait: bool = False
) -> dict[str, Standing]:
    """
    Run what is not done, until nothing is left that this machine could run.

    :param plan: what to run
    :param jobs: processes; with 1 the cells run in this one
    :param retry_failed: whether cells that failed are run again
    :param progress: whether to show a bar
    :param wait: whether to stay while other processes run cells of the plan, for those that they lose
    :return: where each cell of the plan stands, by its key
    :raises SweepError: if something in the plan cannot be run, or the storage cannot be used
    """
    check_jobs(jobs)
    if not plan.silent_after > 0.0:
        raise SweepError(f"`silent_after` must be a number of seconds above 0, got {plan.silent_after:g}.")
    settings = check_plan(plan)
    stop = StopRequest()
    patience = Patience(patience_with(plan.silent_after), stop.is_set)
    study = SweepStudy(plan.name, plan.location, silent_after=plan.silent_after, patience=patience)
    study.check_settings(settings)
    study.take_back()
    study.enqueue(plan.cells, retry_failed=retry_failed)
    # Only the main thread may
    handlers = stop.listen() if threading.current_thread() is threading.main_thread() else {}
    try:
        with Progress(study, plan.cells, show=progress) as bar:
            is_left = True
            while is_left:
                if jobs == 1:
                    _run_here(plan, stop, bar, patience)
                else:
                    _Pool(plan, jobs).run(stop, bar)
                is_left = wait and _wait_for_others(study, plan, stop, bar)
    finally:
        stop.restore(handlers)
    if stop.reason and progress:
        print(f"{stop.reason}: unfinished cells begin anew when the command is run again")
    return standings_of(study, plan)


def standings_of(study: SweepStudy | None, plan: Plan) -> dict[str, Standing]:
    """
    :param study: of the sweep; None if it has not begun
    :param plan: whose cells matter
    :return: where each cell of the plan stands, by its key
    """
    table = {} if study is None else study.standings()
    return {cell.key: table.get(cell.key, Standing(Status.MISSING, None, 0)) for cell in plan.cells}


def _wait_for_others(study: SweepStudy, plan: Plan, stop: StopRequest, bar: Progress) -> bool:
    """:return: whether a cell is to be had again; False once all have ended, or if asked to stop"""
    while not stop.is_set():
        table = study.renew(plan.cells)
        statuses = {table[cell.key].status for cell in plan.cells if cell.key in table}
        if Status.WAITING in statuses or Status.RUNNING not in statuses:
            return Status.WAITING in statuses
        bar.show()
        time.sleep(_LOOK_EVERY)
    return False


def _run_here(plan: Plan, stop: StopRequest, bar: Progress, patience: Patience) -> None:
    over = threading.Event()

    def show() -> None:
        # What is wrong with the storage is said by the thread that trains
        with contextlib.suppress(SweepError):
            while not over.wait(_LOOK_EVERY):
                bar.show()

    # The bar moves while this thread trains
    shower = threading.Thread(target=show, daemon=True)
    shower.start()
    try:
        work(plan, stop, patience)
    finally:
        over.set()
        shower.join()


@contextlib.contextmanager
def _without_interrupts() -> Iterator[None]:
    """
    Processes that are started here never hear of Ctrl-C, which comes to all at a terminal; they are asked to stop.

    They would be interrupted while they still import. This process hears of it afterwards.
    """
    if not hasattr(signal, "pthread_sigmask"):  # on Windows
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@dataclass(frozen=True, eq=False)
class _Worker:
    """
    :param process: runs cells
    :param has_claimed: a number that it shares, 1 once it has had a cell
    :param n_killed: processes in its place, one after another, that were killed before they had one
    """

    process: Any
    has_claimed: Any
    n_killed: int


class _Pool:
    """
    Processes that each run one cell after another.

    :param plan: what to run
    :param jobs: number of processes
    """

    def __init__(self, plan: Plan, jobs: int):
        self._plan = plan
        # Spawned: a forked process would inherit locks and threads of PyTorch
        self._context = multiprocessing.get_context("spawn")
        self._messages = self._context.Queue()
        self._workers = [self._start() for _ in range(min(jobs, len(plan.cells)))]

    def _start(self, n_killed: int = 0) -> _Worker:
        # Without a lock, which a process that is killed could keep
        has_claimed = self._context.RawValue("b", 0)
        process = self._context.Process(target=work_as_process, args=(self._plan, self._messages, has_claimed), daemon=True)
        with _without_interrupts():
            process.start()
        return _Worker(process, has_claimed, n_killed)

    def run(self, stop: StopRequest, bar: Progress) -> None:
        try:
            while self._workers and not stop.is_set():
                time.sleep(0.2)
                for worker in list(self._workers):
                    self._look_after(worker)
                bar.show_now_and_then(_LOOK_EVERY)
        finally:
            self._end()

    def _look_after(self, worker: _Worker) -> None:
        """Take out a worker that has ended, and put another in the place of one that was killed."""
        if worker.process.is_alive():
            return
        worker.process.join()
        self._workers.remove(worker)
        status = worker.process.exitcode
        if status == 0:
            return
        if status < 0:
            # Its cell is given up and asked for again, but not for ever, when the next one claims
            n_killed = 0 if worker.has_claimed.value else worker.n_killed + 1
            if n_killed == _MAX_KILLED:
                raise SweepError(
                    f"`jobs`: {n_killed} processes in a row were killed by signal {-status} before they had a cell. "
                    "If memory is short, use fewer. What is done is kept: the same command goes on from there."
                )
            self._workers.append(self._start(n_killed))
            return
        raise SweepError(self._message() or "A process of the sweep ended with an error, which is printed above.")

    def _message(self) -> str:
        try:
            return self._messages.get(timeout=1.0)
        except queue.Empty:
            return ""

    def _end(self) -> None:
        """Ask all that are left to stop, and wait until they have stored how far they were."""
        processes = [worker.process for worker in self._workers]
        for process in processes:
            if process.is_alive():
                process.terminate()
        until = time.monotonic() + _PATIENCE
        for process in processes:
            process.join(max(0.0, until - time.monotonic()))
            if process.is_alive():
                process.kill()
                process.join()
