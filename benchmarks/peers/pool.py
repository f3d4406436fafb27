"""Runs cells side by side, each in a process of its own."""

import os
import signal
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

from benchmarks.peers.algorithms import ALGORITHMS, MODULES
from benchmarks.peers.errors import PeersError
from benchmarks.peers.journal import BusyError, Journal, Record, State, journal_path, read_record
from benchmarks.peers.plan import Cell
from benchmarks.peers.worker import BUSY, command_of

#: seconds for runs that were asked to stop: ours end at their next iteration, with a checkpoint
_PATIENCE = 120.0
_LOOK_EVERY = 0.5


class Options(NamedTuple):
    """
    :param logs: folder of all runs
    :param jobs: runs side by side
    :param pin: whether each is kept to a core of its own
    :param pythons: interpreter of each library; those that are missing get this one
    """

    logs: Path
    jobs: int
    pin: bool
    pythons: dict[str, str]


def cores_for(options: Options) -> list[int | None]:
    """
    :param options: of the command
    :return: for each job the core that it is kept to, None if to none
    :raises PeersError: if there are more jobs than cores
    """
    if not options.pin or not hasattr(os, "sched_getaffinity"):
        return [None] * options.jobs
    cores = sorted(os.sched_getaffinity(0))
    if options.jobs > len(cores):
        raise PeersError(f"`jobs` must be at most {len(cores)}, the number of cores, got {options.jobs}; or add --no-pin.")
    return list(cores[: options.jobs])


def check_libraries(cells: Sequence[Cell], options: Options) -> None:
    """
    Say so at once where a peer is missing, rather than have all of its runs fail.

    :param cells: to run
    :param options: of the command
    :raises PeersError: if an interpreter lacks what it is to run
    """
    look = "import importlib.util, sys; sys.exit(importlib.util.find_spec(sys.argv[1]) is None)"
    for library in dict.fromkeys(ALGORITHMS[cell.algorithm].library for cell in cells):
        module, python = MODULES[library], options.pythons.get(library, sys.executable)
        if subprocess.run([python, "-c", look, module]).returncode != 0:
            others = " ".join(dict.fromkeys(cell.algorithm for cell in cells if ALGORITHMS[cell.algorithm].library != library))
            raise PeersError(
                f"{module} is not installed for {python}; install it (see docs/benchmarks.md)"
                + (f", or leave it out: --algorithms {others}" if others else ".")
            )


class Pool:
    """
    :param cells: to run, in this order
    :param options: of the command
    :param show: called again and again, to tell the user
    """

    def __init__(self, cells: Sequence[Cell], options: Options, show: Callable[[], None]):
        self._waiting, self._options, self._show = deque(cells), options, show
        self._free = cores_for(options)
        self._running: list[_Run] = []
        self._stop = ""

    def run(self) -> list[str]:
        """
        Run all, until done or asked to stop.

        :return: a line for each that failed
        """
        handlers = {number: signal.signal(number, self._receive) for number in (signal.SIGINT, signal.SIGTERM)}
        failures: list[str] = []
        try:
            while (self._waiting or self._running) and not self._stop:
                while self._waiting and self._free:
                    self._start(self._waiting.popleft())
                time.sleep(_LOOK_EVERY)
                # What the same signal has ended has not failed
                if not self._stop:
                    failures += self._look()
                self._show()
        finally:
            self._end()
            for number, handler in handlers.items():
                signal.signal(number, handler)
        return failures + ([f"{self._stop}; the same command goes on from here"] if self._stop else [])

    def _receive(self, number: int, frame: object) -> None:
        self._stop = f"stopped by {signal.Signals(number).name}"

    def _start(self, cell: Cell) -> None:
        core = self._free.pop(0)
        python = self._options.pythons.get(ALGORITHMS[cell.algorithm].library, sys.executable)
        # One thread a run: runs side by side would otherwise wait for each other's
        environment = {**os.environ, "OMP_NUM_THREADS": "1"}
        self._options.logs.mkdir(parents=True, exist_ok=True)
        path = journal_path(self._options.logs, cell)
        before = read_record(path)
        with path.with_suffix(".txt").open("w") as output:
            process = subprocess.Popen(
                command_of(cell, self._options.logs, core, python),
                env=environment,
                stdout=output,
                stderr=subprocess.STDOUT,
                # Ctrl-C is for this process, which passes it on once
                process_group=0,
            )
        self._running.append(_Run(cell, core, process, before))

    def _look(self) -> list[str]:
        """:return: a line for each run that has just failed"""
        ended = [run for run in self._running if run.process.poll() is not None]
        self._running = [run for run in self._running if run not in ended]
        self._free += [run.core for run in ended]
        return [f"{run.cell.name}: {reason}" for run in ended if (reason := self._reason_of(run))]

    def _reason_of(self, run: "_Run") -> str:
        path = journal_path(self._options.logs, run.cell)
        status = run.process.returncode
        if status == BUSY:
            return "another process has this run"
        record = read_record(path)
        has_begun = record != run.before
        if record.end is None or (status != 0 and not has_begun):
            reason = f"killed by {signal.Signals(-status).name}" if status < 0 else f"ended with status {status}"
            if record.end is not None:
                # Of the run before, which this one was to replace
                return reason
            try:
                journal = Journal(path)
            except BusyError:
                return reason
            journal.end(State.FAILED, f"{reason}, see {path.with_suffix('.txt').name}")
            journal.close()
            return reason
        return str(record.end["reason"])

    def _end(self) -> None:
        for run in self._running:
            run.process.terminate()
        until = time.monotonic() + _PATIENCE
        for run in self._running:
            try:
                run.process.wait(max(0.0, until - time.monotonic()))
            except subprocess.TimeoutExpired:
                run.process.kill()
                run.process.wait()


class _Run(NamedTuple):
    cell: Cell
    core: int | None
    process: subprocess.Popen[bytes]
    before: Record
