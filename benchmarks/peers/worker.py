"""
The process of one run.

    python -m benchmarks.peers.worker --cell '["CartPole-v1", "trpo_gae", "", 0, 2000]' --logs logs/peers
"""

import argparse
import contextlib
import json
import os
import shutil
import sys
import time
import traceback
from pathlib import Path
from typing import Any

from benchmarks.peers.algorithms import ALGORITHMS
from benchmarks.peers.checkpoint import Checkpoint
from benchmarks.peers.journal import BusyError, Journal, Line, Record, State, described_in, journal_path, read_record
from benchmarks.peers.plan import Cell
from benchmarks.peers.settings import described, settings_of

#: exit status where another process has the run
BUSY = 3
# Between the commits of a run that was gone on with after another one
_THEN = ", then "


def main(arguments: list[str] | None = None) -> int:
    """
    :param arguments: of the command line
    :return: exit status
    """
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cell", type=json.loads, required=True)
    parser.add_argument("--logs", type=Path, required=True)
    parser.add_argument("--core", type=int, help="that the run is kept to")
    args = parser.parse_args(arguments)
    if args.core is not None and hasattr(os, "sched_setaffinity"):
        # Before any library counts the cores
        os.sched_setaffinity(0, {args.core})
    try:
        journal = Journal(journal_path(args.logs, cell := Cell(*args.cell)))
    except BusyError as error:
        print(error, file=sys.stderr)
        return BUSY
    with contextlib.closing(journal):
        try:
            _run(cell, args.logs, journal)
        except Exception as error:
            traceback.print_exc()
            journal.end(State.FAILED, in_one_line(error))
            return 1
    return 0


def _run(cell: Cell, logs: Path, journal: Journal) -> None:
    # Here, since a peer that is not installed is a failure of its own runs alone
    import torch as th

    from benchmarks.peers.clock import TrainingClock
    from benchmarks.peers.evaluation import Evaluator
    from benchmarks.peers.protocol import evaluation_interval
    from benchmarks.peers.provenance import origin
    from benchmarks.peers.recorder import Recorder

    th.set_num_threads(1)
    settings, folder = settings_of(cell), logs / cell.name
    start = {
        "cell": list(cell),
        # With defaults, which may change later
        "settings": json.loads(described(cell.algorithm, settings)),
        "origin": origin(),
        "time": round(time.time()),
    }
    clock = TrainingClock()
    evaluator = Evaluator(cell.task)
    recorder = Recorder(evaluator, clock, evaluation_interval(cell.steps), journal.evaluated)
    with contextlib.closing(evaluator):
        if ALGORITHMS[cell.algorithm].library == "tianshou":
            from benchmarks.peers.tianshou_run import run_in_tianshou

            journal.begin(start)
            steps = run_in_tianshou(cell, settings, folder, clock, recorder)
        else:
            from benchmarks.peers.zoo_run import checkpoint_in, run_in_zoo

            checkpoint = checkpoint_in(folder, cell)
            start, known = continued(read_record(journal_path(logs, cell)), start, checkpoint)
            if known is None:
                checkpoint = None
                shutil.rmtree(folder, ignore_errors=True)
            journal.begin(start, known or ())
            steps = run_in_zoo(cell, settings, folder, clock, recorder, checkpoint)
    if steps < cell.steps:
        raise RuntimeError(f"the training ended after {steps} of {cell.steps} steps")
    journal.end(State.DONE)
    shutil.rmtree(folder, ignore_errors=True)


def continued(before: Record, start: Line, checkpoint: Checkpoint | None) -> tuple[Line, list[Line] | None]:
    """
    :param before: what the run's file says
    :param start: the line of the beginning as of now
    :param checkpoint: from where the run could go on
    :return: the line of the beginning, which names all commits, and the evaluations until the checkpoint; None for these if
        the run has to begin anew, as when settings, packages or the machine are no longer the same
    """
    if checkpoint is None or before.start is None or _sameness(before.start) != _sameness(start):
        return start, None
    commits = before.start["origin"]["commit"].split(_THEN)
    if start["origin"]["commit"] not in commits:
        commits.append(start["origin"]["commit"])
    origin = start["origin"] | {"commit": _THEN.join(commits)}
    return start | {"origin": origin}, [line for line in before.evaluations if line["steps"] <= checkpoint.steps]


def _sameness(start: Line) -> Line:
    # Not the commit: documents and tests change, too, while runs of days go on
    origin = {name: value for name, value in start["origin"].items() if name != "commit"}
    return {"cell": start["cell"], "settings": described_in(start), "origin": origin}


def in_one_line(error: BaseException) -> str:
    """
    :param error: that ended a run
    :return: what and where
    """
    last = traceback.extract_tb(error.__traceback__)[-1]
    return f"{type(error).__name__}: {' '.join(str(error).split())[:300]} [{Path(last.filename).name}:{last.lineno}]"


def command_of(cell: Cell, logs: Path, core: int | None, python: str) -> list[str]:
    """
    :param cell: to run
    :param logs: folder of all runs
    :param core: to keep it to
    :param python: interpreter of its library
    :return: a command line
    """
    pinned = [] if core is None else ["--core", str(core)]
    arguments: list[Any] = ["--cell", json.dumps(list(cell)), "--logs", str(logs), *pinned]
    return [python, "-m", "benchmarks.peers.worker", *arguments]


if __name__ == "__main__":
    raise SystemExit(main())
