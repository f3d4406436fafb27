"""A sweep as an Optuna study: cells are trials, shared by every process that opens the same storage."""

import datetime
import json
import math
import time
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict
from typing import Any, TypeVar

import optuna
from optuna.distributions import BaseDistribution, FloatDistribution, IntDistribution
from optuna.exceptions import UpdateFinishedTrialError
from optuna.trial import FrozenTrial, TrialState

from sb3_gae.sweep.agreement import Made, changes, check_made_with
from sb3_gae.sweep.errors import SweepError
from sb3_gae.sweep.grid import LARGEST_SEED, Cell
from sb3_gae.sweep.ledger import Outcome, Standing, Status, duplicates, standings
from sb3_gae.sweep.liveness import SILENT_AFTER, beat_every, sign_of_life, why_dead
from sb3_gae.sweep.location import without_password
from sb3_gae.sweep.patience import Patience
from sb3_gae.sweep.storage import open_storage, storage_errors

_T = TypeVar("_T")

#: of what is stored; another one is refused
FORMAT = 1
_FORMAT_ATTRIBUTE = "sb3_gae_sweep_format"

_DISTRIBUTIONS: dict[str, BaseDistribution] = {
    "gamma": FloatDistribution(0.0, 1.0),
    "gae_lambda": FloatDistribution(0.0, 1.0),
    "seed": IntDistribution(0, LARGEST_SEED),
}


class TakenOverError(RuntimeError):
    """Another process has taken the cell over, or finished it; what is computed here is not wanted any more."""


class SweepStudy:
    """
    The trials of a sweep. Every method raises :class:`~sb3_gae.sweep.errors.SweepError` if the storage cannot be used any
    more.

    :param name: of the sweep
    :param location: path or URL of the storage; None for ``logs/sweeps/<name>.journal``
    :param create: whether to begin a sweep that is not there
    :param silent_after: seconds without a sign of life after which another machine's cell is taken over
    :param patience: with a storage that does not answer any more, once it is open; None for none
    :raises SweepError: if the storage cannot be used, or holds something else
    """

    def __init__(
        self,
        name: str,
        location: str | None = None,
        *,
        create: bool = True,
        silent_after: float = SILENT_AFTER,
        patience: Patience | None = None,
    ):
        self.name = name
        self.location = location or default_location(name)
        self.silent_after = silent_after
        self._patience = Patience() if patience is None else patience
        # Optuna announces studies, and warns of what is only experimental
        optuna.logging.set_verbosity(optuna.logging.WARNING)
        self.storage = open_storage(self.location, create=create)
        with storage_errors(self.location):
            self._study = self._open(create)
            self._study_id = self.storage.get_study_id_from_name(name)

    def ask(self, operation: Callable[..., _T], *arguments: Any) -> _T:
        """
        Use the storage, with patience.

        :param operation: of the storage; one that may be done twice
        :param arguments: of it
        :return: its result
        :raises SweepError: in one line, if the storage cannot be used any more
        """

        def once() -> _T:
            with storage_errors(self.location):
                return operation(*arguments)

        return self._patience(once)

    def _open(self, create: bool) -> optuna.Study:
        names = optuna.get_all_study_names(self.storage)
        if self.name not in names:
            if not create:
                held = f"it holds {', '.join(sorted(names))}" if names else "it is empty"
                raise SweepError(f"There is no sweep {self.name!r} in {without_password(self.location)}: {held}.")
            study = optuna.create_study(study_name=self.name, storage=self.storage, direction="maximize", load_if_exists=True)
            # Whoever comes second writes the same
            study.set_user_attr(_FORMAT_ATTRIBUTE, FORMAT)
            return study
        study = optuna.load_study(study_name=self.name, storage=self.storage)
        self._check_format(study, create)
        return study

    def _check_format(self, study: optuna.Study, create: bool) -> None:
        # In this order: whoever begins the sweep at this moment writes the format first
        is_empty = not study.get_trials(deepcopy=False)
        found = study.user_attrs.get(_FORMAT_ATTRIBUTE)
        if found is None and is_empty:
            if create:
                study.set_user_attr(_FORMAT_ATTRIBUTE, FORMAT)  # begun by a process that did not get this far
        elif found != FORMAT:
            what = "is no sweep of sb3-gae" if found is None else f"is of format {found}, and this sb3-gae knows {FORMAT}"
            advice = "choose another --name" if found is None else "use the sb3-gae that wrote it, or another --name"
            raise SweepError(f"The study {self.name!r} in {without_password(self.location)} {what}; {advice}.")

    def trials(self) -> list[FrozenTrial]:
        """:return: all of the study, not to be changed"""
        return self.ask(self._study.get_trials, False)

    def standings(self) -> dict[str, Standing]:
        """:return: where each cell stands, by its key"""
        return standings(self.trials())

    def check_settings(self, settings: Mapping[str, Mapping[str, Any]]) -> None:
        """
        Refuse to mix runs of different settings; remember those of tasks that are new.

        :param settings: of each task, as the settings file has them
        :raises SweepError: if they are not those that the sweep began with
        """
        stored = self.ask(lambda: self._study.user_attrs)
        for task, now in settings.items():
            before = stored.get(f"settings:{task}")
            if before is None:
                # Runs may have been imported
                check_made_with(self.made(), {task: now}, "choose another --name, or go back to theirs with --conf-file")
                self.ask(self._study.set_user_attr, f"settings:{task}", dict(now))
                continue
            if what := changes(before, now):
                raise SweepError(
                    f"The settings of {task} have changed since the sweep {self.name!r} began ({what}); "
                    "choose another --name, or go back to them with --conf-file."
                )

    def task_settings(self) -> dict[str, Mapping[str, Any]]:
        """:return: what :meth:`check_settings` remembers"""
        stored = self.ask(lambda: self._study.user_attrs)
        return {name.removeprefix("settings:"): stored[name] for name in stored if name.startswith("settings:")}

    def made(self) -> list[Made]:
        """:return: how each finished cell was made"""
        done = [standing.trial for standing in self.standings().values() if standing.status == Status.DONE]
        return [
            Made(cell["task"], cell["condition"], cell["overrides"], json.dumps(trial.user_attrs.get("settings", {})))
            for trial in done
            if trial is not None and (cell := trial.user_attrs["cell"])
        ]

    def enqueue(self, cells: Iterable[Cell], *, retry_failed: bool = False) -> None:
        """
        Ask for cells that are neither done nor asked for.

        :param cells: of the grid
        :param retry_failed: ask again for those that failed
        """
        table = self.standings()
        for cell in cells:
            standing = table.get(cell.key)
            again = standing is not None and (
                standing.status == Status.MISSING or (retry_failed and standing.status == Status.FAILED)
            )
            if standing is None or again:
                attempt = 0 if standing is None else standing.attempt + 1
                self.ask(self.storage.create_new_trial, self._study_id, _template(cell, attempt))
        for trial in duplicates(self.trials()):
            self._end(trial, Outcome.DUPLICATE, "another trial of the same cell counts")

    def add_finished(self, cell: Cell, rows: Sequence[Mapping[str, float]], **what: Any) -> bool:
        """
        Take in a cell that was run elsewhere.

        :param cell: that is done
        :param rows: see :meth:`~sb3_gae.sweep.study.Claim.append`
        :param what: see :meth:`~sb3_gae.sweep.study.Claim.describe`
        :return: False if the cell was done here already, which stays as it is
        """
        standing = self.standings().get(cell.key)
        if standing is not None and standing.status == Status.DONE:
            return False
        returns = {int(row["iteration"]): float(row["mean_return"]) for row in rows}
        trial = _template(cell, 0 if standing is None else standing.attempt)
        trial.state, trial.value, trial.intermediate_values = TrialState.COMPLETE, _last_return(returns.values()), returns
        trial.datetime_start = trial.datetime_complete = datetime.datetime.now()
        trial.user_attrs |= what | {_rows_name(0): _columns(rows)}
        self.ask(self.storage.create_new_trial, self._study_id, trial)
        return True

    def claim(self, cells: Iterable[Cell]) -> "Claim | None":
        """
        Take a cell that waits, which nobody else can take then; first see to those that were given up.

        :param cells: to choose from, in this order
        :return: the first that could be had, None if there is none
        """
        cells = list(cells)
        table = self.renew(cells)
        for cell in cells:
            standing = table.get(cell.key)
            if standing is None or standing.status != Status.WAITING or standing.trial is None:
                continue
            if (claim := self._take(cell, standing.trial)) is not None:
                return claim
        return None

    def _take(self, cell: Cell, trial: FrozenTrial) -> "Claim | None":
        """
        :param cell: that waits
        :param trial: of it
        :return: None if another process was first
        """
        trial_id, n_attempts = self._id_of(trial), 0

        def take() -> bool:
            nonlocal n_attempts
            n_attempts += 1
            return self.storage.set_trial_state_values(trial_id, TrialState.RUNNING)

        try:
            if self.ask(take):
                return Claim(self, cell, trial_id)
        except (UpdateFinishedTrialError, TakenOverError):
            return None
        # An attempt that was cut off may have taken it without a word, and then nobody would run it
        if n_attempts == 1 or not self._is_taken_without_a_sign(trial_id):
            return None
        # Given back, not kept: if it is another's, who has not signed yet, that one is told so before it begins
        self._end(trial, Outcome.STOPPED, "the storage was cut off while it was taken")
        return self.claim([cell])

    def _is_taken_without_a_sign(self, trial_id: int) -> bool:
        trial = self.ask(self.storage.get_trial, trial_id)
        return trial.state == TrialState.RUNNING and "sign_of_life" not in trial.user_attrs

    def renew(self, cells: Iterable[Cell]) -> dict[str, Standing]:
        """
        Ask again for cells that were given up, by this process or by another: whoever gave one up may be gone by now.

        :param cells: of the grid
        :return: where each cell of the study stands then, by its key
        """
        cells = list(cells)
        self.take_back()
        table = self.standings()
        given_up = [cell for cell in cells if cell.key in table and table[cell.key].status == Status.MISSING]
        if not given_up:
            return table
        self.enqueue(given_up)
        return self.standings()

    def take_back(self) -> list[Standing]:
        """
        Give up running trials whose process is gone, so that their cells can be asked for again.

        :return: their standings before
        """
        lost = []
        for standing in self.standings().values():
            if standing.status == Status.RUNNING and standing.trial is not None:
                reason = why_dead(_last_sign(standing.trial), time.time(), self.silent_after)
                if reason and self._end(standing.trial, Outcome.LOST, reason):
                    lost.append(standing)
        return lost

    def _end(self, trial: FrozenTrial, outcome: Outcome, reason: str) -> bool:
        """:return: whether it had not ended before"""
        trial_id = self._id_of(trial)
        try:
            self.ask(self.storage.set_trial_user_attr, trial_id, "outcome", outcome)
            self.ask(self.storage.set_trial_user_attr, trial_id, "reason", reason)
            return self.ask(self.storage.set_trial_state_values, trial_id, TrialState.FAIL)
        except UpdateFinishedTrialError:
            return False

    def _id_of(self, trial: FrozenTrial) -> int:
        return self.ask(self.storage.get_trial_id_from_study_id_trial_number, self._study_id, trial.number)


class Claim:
    """
    A cell that this process runs. Every method raises :class:`TakenOverError` if it has lost the cell, and
    :class:`~sb3_gae.sweep.errors.SweepError` if the storage cannot be used any more.

    :param sweep: the cell is of
    :param cell: to be run
    :param trial_id: of the storage
    """

    def __init__(self, sweep: SweepStudy, cell: Cell, trial_id: int):
        self.cell = cell
        #: seconds between signs of life
        self.beat_every = beat_every(sweep.silent_after)
        self._sweep, self._trial_id, self._n_chunks = sweep, trial_id, 0
        self.beat()

    def beat(self) -> None:
        """Give a sign of life."""
        self._set("sign_of_life", sign_of_life())

    def describe(self, **what: Any) -> None:
        """:param what: to be stored with the cell, as JSON"""
        for name, value in what.items():
            self._set(name, value)

    def append(self, rows: Sequence[Mapping[str, float]]) -> None:
        """
        Store a piece of the learning curve.

        :param rows: one for each iteration, with the columns of ``sb3_gae.sweep.recorder.COLUMNS``
        """
        if not rows:
            return
        self._set(_rows_name(self._n_chunks), _columns(rows))
        self._n_chunks += 1
        for row in rows:
            self._ask(self._sweep.storage.set_trial_intermediate_value, int(row["iteration"]), row["mean_return"])
        self.beat()

    def complete(self, value: float) -> None:
        """:param value: mean return of the last iteration that has one"""
        self._ask(self._sweep.storage.set_trial_state_values, TrialState.COMPLETE, [value])

    def give_up(self, outcome: Outcome, reason: str) -> None:
        """
        :param outcome: why it did not complete
        :param reason: the same in words
        """
        self.describe(outcome=outcome, reason=reason)
        self._ask(self._sweep.storage.set_trial_state_values, TrialState.FAIL)

    def _set(self, name: str, value: Any) -> None:
        self._ask(self._sweep.storage.set_trial_user_attr, name, value)

    def _ask(self, operation: Callable[..., Any], *arguments: Any) -> None:
        """Use the storage; a trial that has ended means that the cell is lost."""
        try:
            self._sweep.ask(operation, self._trial_id, *arguments)
        except UpdateFinishedTrialError as error:
            raise TakenOverError(str(error)) from error


def _rows_name(chunk: int) -> str:
    return f"rows:{chunk:05d}"


def _columns(rows: Sequence[Mapping[str, float]]) -> dict[str, list[float]]:
    return {name: [row[name] for row in rows] for name in rows[0]}


def _last_return(returns: Iterable[float]) -> float:
    """The last one that is a number; minus infinity if in no iteration an episode ended."""
    known = [value for value in returns if not math.isnan(value)]
    return known[-1] if known else -math.inf


def default_location(name: str) -> str:
    """
    :param name: of a sweep
    :return: where it is stored unless the user says otherwise
    :raises SweepError: if it is no name for a file
    """
    if not name or name in (".", "..") or any(character in name for character in "/\\:\0"):
        raise SweepError(f"`name` must be a name without slashes and colons, got {name!r}.")
    return f"logs/sweeps/{name}.journal"


def _template(cell: Cell, attempt: int) -> FrozenTrial:
    params = {"gamma": cell.gamma, "seed": cell.seed}
    if cell.gae_lambda is not None:
        params["gae_lambda"] = cell.gae_lambda
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        return optuna.trial.create_trial(
            state=TrialState.WAITING,
            params=params,
            distributions={name: _DISTRIBUTIONS[name] for name in params},
            user_attrs={"cell": asdict(cell), "attempt": attempt},
        )


def _last_sign(trial: FrozenTrial) -> Mapping[str, Any]:
    sign = trial.user_attrs.get("sign_of_life")
    if sign is not None:
        return sign
    # Taken, and gone before it could say by whom
    taken = trial.datetime_start.timestamp() if trial.datetime_start is not None else 0.0
    return {"host": "(unknown)", "pid": "(unknown)", "time": taken}
