"""The file of one run: a line for its beginning, for each evaluation, and for its end."""

import fcntl
import json
import os
from collections.abc import Iterable
from enum import StrEnum
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks.peers.plan import Cell
from benchmarks.peers.settings import described

Line = dict[str, Any]


class State(StrEnum):
    """Where a run stands."""

    NEW = "new"
    UNFINISHED = "unfinished"
    DONE = "done"
    FAILED = "failed"
    STALE = "stale"  # done, but with settings that are not today's
    COMMITTED = "committed"  # not here, but its results are in the committed files, with today's settings


def described_in(start: Line) -> str:
    """
    :param start: the line of a run's beginning
    :return: its settings, see :func:`~benchmarks.peers.settings.described`
    """
    return described(Cell(*start["cell"]).algorithm, start["settings"])


class Record(NamedTuple):
    """
    What the file of a run says.

    :param start: the line of its beginning, None if there is none
    :param evaluations: in the order of their steps
    :param end: the line of its end, None if it has not come
    """

    start: Line | None
    evaluations: list[Line]
    end: Line | None

    @property
    def steps(self) -> int:
        """Of training, as far as is known."""
        return int(self.evaluations[-1]["steps"]) if self.evaluations else 0

    def state(self, settings: str) -> State:
        """
        :param settings: today's, as :func:`~benchmarks.peers.settings.described` has them
        :return: where the run stands
        """
        if self.start is None:
            return State.NEW
        if self.end is None:
            return State.UNFINISHED
        if self.end["status"] == State.FAILED:
            return State.FAILED
        return State.DONE if described_in(self.start) == settings else State.STALE


def journal_path(logs: Path, cell: Cell) -> Path:
    """
    :param logs: folder of all runs
    :param cell: of one
    :return: of its file
    """
    return logs / f"{cell.name}.jsonl"


def read_record(path: Path) -> Record:
    """
    :param path: of a run's file
    :return: what it says; a last line that was cut off when the machine went down does not count
    """
    lines = _whole_lines(path.read_text()) if path.exists() else []
    kinds: dict[str, list[Line]] = {"start": [], "evaluation": [], "end": []}
    for line in lines:
        kinds[line["kind"]].append(line)
    return Record(
        kinds["start"][-1] if kinds["start"] else None,
        kinds["evaluation"],
        kinds["end"][-1] if kinds["end"] else None,
    )


def _whole_lines(text: str) -> list[Line]:
    return [json.loads(line) for line in text.splitlines(keepends=True) if line.endswith("\n")]


def _cut_torn_line(path: Path) -> None:
    """What is added after a line that was cut off would be read as a part of it."""
    content = path.read_bytes()
    whole = content.rfind(b"\n") + 1
    if whole < len(content):
        os.truncate(path, whole)


class BusyError(Exception):
    """Another process writes the file."""


class Journal:
    """
    A run's file, held by one process at a time.

    :param path: of the file
    :raises BusyError: if another process holds it
    """

    def __init__(self, path: Path):
        path.parent.mkdir(parents=True, exist_ok=True)
        self._file = path.open("a")
        try:
            # Let go by the system, however the process ends
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self._file.close()
            raise BusyError(f"{path} is being written by another process.") from None
        _cut_torn_line(path)

    def begin(self, start: Line, evaluations: Iterable[Line] = ()) -> None:
        """
        Begin anew.

        :param start: what is known before the first step
        :param evaluations: of the part of the training that is gone on from
        """
        self._file.truncate(0)
        self._add({"kind": "start", **start}, *evaluations)

    def evaluated(self, evaluation: Line) -> None:
        """:param evaluation: to be added"""
        self._add({"kind": "evaluation", **evaluation})

    def end(self, status: State, reason: str = "") -> None:
        """
        :param status: done or failed
        :param reason: why it failed
        """
        self._add({"kind": "end", "status": str(status), "reason": reason})

    def close(self) -> None:
        """Let others have the file."""
        self._file.close()

    def _add(self, *lines: Line) -> None:
        self._file.write("".join(json.dumps(line) + "\n" for line in lines))
        self._file.flush()
        os.fsync(self._file.fileno())
