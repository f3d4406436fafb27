"""A sweep in its storage: who may run a cell, and what becomes of those whose process is gone."""

import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from optuna.trial import TrialState
from sweep_cells import CELLS, statuses

from sb3_gae.sweep import Cell, SweepStudy
from sb3_gae.sweep.errors import UnreachableError
from sb3_gae.sweep.ledger import MAX_LOST, Outcome, Status
from sb3_gae.sweep.liveness import sign_of_life, why_dead
from sb3_gae.sweep.patience import Patience
from sb3_gae.sweep.study import Claim, TakenOverError

ROW = {"iteration": 1, "mean_return": 5.0}


@pytest.fixture(params=["journal", "sqlite"])
def location(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    return str(tmp_path / "sweep.journal") if request.param == "journal" else f"sqlite:///{tmp_path}/sweep.db"


@pytest.fixture
def journal(tmp_path: Path) -> str:
    return str(tmp_path / "sweep.journal")


def test_cells_are_asked_for_once_and_end_as_they_are_told(location: str) -> None:
    study = SweepStudy("s", location)
    for _ in range(2):
        study.enqueue(CELLS)
    assert len(study.trials()) == 3
    first, second = study.claim(CELLS), study.claim(CELLS)
    assert first is not None and second is not None
    assert (first.cell, second.cell) == (CELLS[0], CELLS[1])
    first.append([ROW])
    first.complete(5.0)
    second.give_up(Outcome.FAILED, "no luck")
    assert statuses(SweepStudy("s", location)) == [Status.DONE, Status.FAILED, Status.WAITING]
    assert study.standings()[CELLS[1].key].reason == "no luck"
    trial = study.trials()[0]
    assert (trial.value, trial.intermediate_values, trial.params["gamma"]) == (5.0, {1: 5.0}, 0.9)


def test_failed_cells_are_only_run_again_if_asked_for(journal: str) -> None:
    study = SweepStudy("s", journal)
    for outcome in (Outcome.FAILED, Outcome.STOPPED):
        study.enqueue(CELLS[:1])
        claim = study.claim(CELLS[:1])
        if claim is not None:
            claim.give_up(outcome, outcome)
        study.enqueue(CELLS[:1], retry_failed=outcome == Outcome.FAILED)
    # Asked for anew after it failed, run, stopped and asked for anew
    assert study.standings()[CELLS[0].key][::2] == (Status.WAITING, 2)


def test_two_machines_that_ask_at_the_same_moment_run_a_cell_once(location: str, monkeypatch: pytest.MonkeyPatch) -> None:
    here, there = SweepStudy("s", location), SweepStudy("s", location)
    here.enqueue(CELLS)
    with monkeypatch.context() as patch:
        patch.setattr(there, "standings", dict)  # it looked before the other one wrote
        patch.setattr("sb3_gae.sweep.study.duplicates", lambda trials: [])
        there.enqueue(CELLS)
    assert len(here.trials()) == 6
    claims = [study.claim(CELLS) for study in (here, there, here, there)]
    assert [claim and claim.cell for claim in claims] == [*CELLS, None]
    here.enqueue(CELLS)
    ended = [trial for trial in here.trials() if trial.state == TrialState.FAIL]
    assert [trial.user_attrs["outcome"] for trial in ended] == [Outcome.DUPLICATE] * 3


def test_many_workers_take_each_cell_once(location: str) -> None:
    cells = [Cell("CartPole-v1", "trust_region", 0.9, 0.5, seed, 3) for seed in range(24)]
    SweepStudy("s", location).enqueue(cells)
    studies = [SweepStudy("s", location) for _ in range(4)]
    taken: list[int] = []
    begin = threading.Barrier(len(studies))

    def work(study: SweepStudy) -> None:
        begin.wait()
        while (claim := study.claim(cells)) is not None:
            taken.append(claim.cell.seed)

    threads = [threading.Thread(target=work, args=(study,)) for study in studies]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(taken) == list(range(24))


def test_cells_of_a_dead_process_are_taken_over(journal: str) -> None:
    study = SweepStudy("s", journal)
    study.enqueue(CELLS[:1])
    claim = study.claim(CELLS[:1])
    assert claim is not None
    assert study.take_back() == []
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    claim.describe(sign_of_life=sign_of_life() | {"pid": dead.pid})
    again = SweepStudy("s", journal).claim(CELLS[:1])
    assert again is not None and again.cell == CELLS[0]
    assert study.trials()[0].user_attrs["reason"] == f"process {dead.pid} on {socket.gethostname()} ended without a word"
    with pytest.raises(TakenOverError):
        claim.append([ROW])


def test_a_cell_that_another_process_gave_up_is_asked_for_again(location: str) -> None:
    study = SweepStudy("s", location)
    study.enqueue(CELLS[:1])
    assert study.claim(CELLS[:1]) is not None
    # Whoever gave it up is gone before it asks again, or has a grid without this cell
    assert len(SweepStudy("s", location, silent_after=-1.0).take_back()) == 1
    again = study.claim(CELLS[:1])
    assert again is not None and again.cell == CELLS[0]


def test_a_cell_that_is_lost_at_once_is_left_alone(journal: str, monkeypatch: pytest.MonkeyPatch) -> None:
    study, other = SweepStudy("s", journal), SweepStudy("s", journal, silent_after=-1.0)
    study.enqueue(CELLS[:2])
    set_state = study.storage.set_trial_state_values

    def set_state_and_lose(trial_id: int, state: TrialState) -> bool:
        taken = set_state(trial_id, state)
        if trial_id == 0:
            other.take_back()
        return taken

    monkeypatch.setattr(study.storage, "set_trial_state_values", set_state_and_lose)
    claim = study.claim(CELLS[:2])
    assert claim is not None and claim.cell == CELLS[1]


@pytest.mark.parametrize("reaches", [True, False])
def test_a_cell_that_is_taken_while_the_connection_breaks_is_had_or_left_to_whoever_has_it(
    reaches: bool, location: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    study, other = SweepStudy("s", location, patience=Patience(60.0)), SweepStudy("s", location)
    study.enqueue(CELLS[:2])
    set_state = study.storage.set_trial_state_values
    others: list[Claim | None] = []
    broken: list[int] = []

    def set_state_and_break(trial_id: int, state: TrialState, *values: list[float]) -> bool:
        if broken:
            return set_state(trial_id, state, *values)
        broken.append(trial_id)
        if reaches:
            assert set_state(trial_id, state)
        else:
            others.append(other.claim(CELLS))
        raise UnreachableError("The connection is gone.")

    monkeypatch.setattr(study.storage, "set_trial_state_values", set_state_and_break)
    claim = study.claim(CELLS)
    assert claim is not None and claim.cell == CELLS[0 if reaches else 1]
    claim.complete(1.0)
    assert len(others) == (0 if reaches else 1)
    for theirs in others:
        assert theirs is not None
        theirs.complete(2.0)
    table = study.standings()
    assert [table[cell.key].status for cell in CELLS[:2]] == ([Status.DONE, Status.WAITING] if reaches else [Status.DONE] * 2)
    ended = [trial.user_attrs["outcome"] for trial in study.trials() if "outcome" in trial.user_attrs]
    assert ended == ([Outcome.STOPPED] if reaches else []), "nothing counts as lost with its process"


def test_a_cell_that_is_given_back_is_not_run_by_its_owner(location: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of two that are cut off one may have it, and has not said so yet."""
    study, other = SweepStudy("s", location, patience=Patience(60.0)), SweepStudy("s", location)
    study.enqueue(CELLS[:1])
    set_state = study.storage.set_trial_state_values
    broken: list[int] = []

    def set_state_and_break(trial_id: int, state: TrialState, *values: list[float]) -> bool:
        if broken:
            return set_state(trial_id, state, *values)
        broken.append(trial_id)
        assert other.storage.set_trial_state_values(trial_id, state)
        raise UnreachableError("The connection is gone.")

    monkeypatch.setattr(study.storage, "set_trial_state_values", set_state_and_break)
    assert study.claim(CELLS[:1]) is not None
    with pytest.raises(TakenOverError):
        Claim(other, CELLS[0], study.storage.get_trial_id_from_study_id_trial_number(study._study_id, 0))


@pytest.mark.parametrize(
    ("patience", "waits"), [(Patience(60.0, stop=lambda: True), False), (Patience(0.5), True), (Patience(), False)]
)
def test_patience_ends(patience: Patience, waits: bool, capsys: pytest.CaptureFixture[str]) -> None:
    tried = []

    def fail() -> None:
        tried.append(1)
        raise UnreachableError("It is gone.")

    with pytest.raises(UnreachableError, match=r"^It is gone\."):
        patience(fail)
    assert (len(tried) > 1) == waits
    assert capsys.readouterr().err.count("\n") == waits, "what is waited for is said once"


def test_a_cell_that_takes_its_process_along_counts_as_failed(journal: str) -> None:
    study = SweepStudy("s", journal, silent_after=-1.0)
    study.enqueue(CELLS[:1])
    for _ in range(MAX_LOST):
        assert study.standings()[CELLS[0].key].status == Status.WAITING
        assert study.claim(CELLS[:1]) is not None
        study.take_back()
        study.enqueue(CELLS[:1])
    assert study.standings()[CELLS[0].key].status == Status.FAILED


def test_signs_of_life() -> None:
    sign = sign_of_life()
    assert why_dead(sign, time.time()) is None
    assert why_dead(sign | {"host": "elsewhere", "pid": 1}, time.time()) is None
    assert "no sign of life for 1000 s" in str(why_dead(sign, sign["time"] + 1000.0))
    if Path("/proc/self/stat").exists():
        # The number belongs to another process by now
        assert why_dead(sign | {"started": sign["started"] - 1}, time.time()) is not None


@pytest.mark.skipif(not Path("/proc/self/ns/pid").exists(), reason="has no namespaces")
def test_processes_of_another_container_with_the_same_name_are_not_looked_for_here() -> None:
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    sign = sign_of_life() | {"pid": ended.pid}
    assert "ended without a word" in str(why_dead(sign, time.time()))
    there = sign | {"pid_namespace": sign["pid_namespace"] + 1}
    assert why_dead(there, time.time()) is None
    assert "no sign of life" in str(why_dead(there, sign["time"] + 1000.0))
    # As it was stored before namespaces were
    del sign["pid_namespace"]
    assert "ended without a word" in str(why_dead(sign, time.time()))
