"""What the trials of a study say about each cell. Pure: the same trials give the same answer on every machine."""

import json
from collections.abc import Iterable, Mapping
from enum import StrEnum
from typing import Any, NamedTuple

from optuna.trial import FrozenTrial, TrialState

#: runs of a cell that may be lost with their process before it counts as failed
MAX_LOST = 3


class Outcome(StrEnum):
    """Why a trial that Optuna calls failed did not complete."""

    FAILED = "failed"  # the training raised an error
    STOPPED = "stopped"  # whoever ran it was asked to stop
    LOST = "lost"  # its process is gone
    DUPLICATE = "duplicate"  # two machines asked for it at the same moment


class Status(StrEnum):
    """Where a cell stands."""

    DONE = "done"
    RUNNING = "running"
    WAITING = "waiting"
    FAILED = "failed"
    MISSING = "missing"  # to be asked for, perhaps again


class Standing(NamedTuple):
    """
    :param status: of the cell
    :param trial: that decides it; None if there is none
    :param attempt: of that trial, from 0
    """

    status: Status
    trial: FrozenTrial | None
    attempt: int

    @property
    def reason(self) -> str:
        """Why it failed or was taken up again, empty if it was not."""
        return "" if self.trial is None else str(self.trial.user_attrs.get("reason", ""))

    @property
    def traceback(self) -> str:
        """Where it failed, empty if it did not."""
        return "" if self.trial is None else str(self.trial.user_attrs.get("traceback", ""))


def key_of(cell: Mapping[str, Any]) -> str:
    """
    :param cell: as stored with a trial
    :return: as :attr:`~sb3_gae.sweep.grid.Cell.key`
    """
    return json.dumps(dict(cell), sort_keys=True)


def standings(trials: Iterable[FrozenTrial]) -> dict[str, Standing]:
    """
    :param trials: of a study
    :return: where each cell stands, by its key
    """
    by_key: dict[str, list[FrozenTrial]] = {}
    for trial in sorted(trials, key=lambda trial: trial.number):
        if "cell" in trial.user_attrs:
            by_key.setdefault(key_of(trial.user_attrs["cell"]), []).append(trial)
    return {key: _standing(own) for key, own in by_key.items()}


def _standing(trials: list[FrozenTrial]) -> Standing:
    """:param trials: of one cell, in the order of their numbers"""
    for trial in trials:
        if trial.state == TrialState.COMPLETE:
            return Standing(Status.DONE, trial, attempt_of(trial))
    # Of several that were asked for at the same moment the first counts, on every machine
    latest = max(attempt_of(trial) for trial in trials)
    current = next(trial for trial in trials if attempt_of(trial) == latest)
    if current.state == TrialState.RUNNING:
        status = Status.RUNNING
    elif current.state == TrialState.WAITING:
        status = Status.WAITING
    else:
        status = Status.FAILED if _has_failed(current, trials) else Status.MISSING
    return Standing(status, current, latest)


def _has_failed(current: FrozenTrial, trials: list[FrozenTrial]) -> bool:
    outcome = current.user_attrs.get("outcome", Outcome.FAILED)
    n_lost = sum(trial.user_attrs.get("outcome") == Outcome.LOST for trial in trials)
    return outcome == Outcome.FAILED or (outcome == Outcome.LOST and n_lost >= MAX_LOST)


def duplicates(trials: Iterable[FrozenTrial]) -> list[FrozenTrial]:
    """
    :param trials: of a study
    :return: those that wait but will never be run, since another one of the same cell counts
    """
    trials = list(trials)
    counting = {standing.trial.number for standing in standings(trials).values() if standing.trial is not None}
    waiting = (trial for trial in trials if trial.state == TrialState.WAITING and "cell" in trial.user_attrs)
    return [trial for trial in waiting if trial.number not in counting]


def attempt_of(trial: FrozenTrial) -> int:
    """
    :param trial: of a cell
    :return: how often the cell had been given up before it
    """
    return int(trial.user_attrs.get("attempt", 0))
