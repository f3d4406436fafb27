"""A sweep in its storage: who may run a cell, and what becomes of those whose process is gone."""

import contextlib
import os
import socket
import sqlite3
import subprocess
import sys
import threading
import time
from pathlib import Path

import optuna
import pytest
from optuna.exceptions import StorageInternalError
from optuna.trial import TrialState
from sqlalchemy.exc import PendingRollbackError, SQLAlchemyError

from sb3_gae.sweep import Cell, SweepError, SweepStudy
from sb3_gae.sweep.errors import UnreachableError
from sb3_gae.sweep.ledger import MAX_LOST, Outcome, Status
from sb3_gae.sweep.liveness import sign_of_life, why_dead
from sb3_gae.sweep.patience import Patience
from sb3_gae.sweep.storage import holds, storage_errors
from sb3_gae.sweep.study import Claim, TakenOverError

CELLS = [Cell("CartPole-v1", "trust_region", 0.9, value, 0, 3) for value in (0.0, 0.5, 1.0)]
ROW = {"iteration": 1, "mean_return": 5.0}


@pytest.fixture(params=["journal", "sqlite"])
def location(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    return str(tmp_path / "sweep.journal") if request.param == "journal" else f"sqlite:///{tmp_path}/sweep.db"


@pytest.fixture
def journal(tmp_path: Path) -> str:
    return str(tmp_path / "sweep.journal")


def statuses(study: SweepStudy) -> list[Status]:
    table = study.standings()
    return [table[cell.key].status for cell in CELLS]


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


@pytest.mark.parametrize("torn", ['{"op_code":8,"worker_id":"x', "x" * 3_000_000], ids=["short", "long"])
def test_a_journal_survives_a_write_that_was_cut_off(journal: str, torn: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sb3_gae.sweep.storage._SETTLE_SECONDS", 0.05)
    study = SweepStudy("s", journal)
    study.enqueue(CELLS)
    with Path(journal).open("a") as file:
        file.write(torn)
    claim = SweepStudy("s", journal).claim(CELLS)
    assert claim is not None
    claim.complete(1.0)
    assert statuses(study) == [Status.DONE, Status.WAITING, Status.WAITING]
    assert torn not in Path(journal).read_text()


def test_a_line_that_somebody_still_writes_is_not_cut(journal: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sb3_gae.sweep.storage._SETTLE_SECONDS", 0.4)
    study = SweepStudy("s", journal)
    line = Path(journal).read_bytes().splitlines(keepends=True)[-1].replace(b'"sb3_gae_sweep_format"', b'"slow"')
    assert b'{"slow":1}' in line

    def write_slowly() -> None:
        for part in (line[20:40], line[40:]):
            time.sleep(0.1)
            with Path(journal).open("ab") as file:
                file.write(part)

    with Path(journal).open("ab") as file:
        file.write(line[:20])
    writer = threading.Thread(target=write_slowly)
    writer.start()
    study.enqueue(CELLS)
    writer.join()
    assert optuna.load_study(study_name="s", storage=storage_of(journal)).user_attrs["slow"] == 1
    assert len(SweepStudy("s", journal).trials()) == 3


@pytest.mark.parametrize(
    "content",
    [
        '{"results": [1, 2]}',
        '{"op_code": 1}\n',
        '{"op_code":0,"worker_id":"x","study',
        "Dear Sir",
        "Dear Sir\n",
        "\n",
        "[]\n",
        "\0\x01" * 5000,
    ],
)
@pytest.mark.parametrize("create", [True, False])
def test_a_file_that_is_no_journal_stays_as_it_is(content: str, create: bool, journal: str) -> None:
    Path(journal).write_text(content)
    with pytest.raises(SweepError, match=r"sweep\.journal") as error:
        SweepStudy("s", journal, create=create)
    assert "\n" not in str(error.value)
    assert Path(journal).read_text() == content
    assert [path.name for path in Path(journal).parent.iterdir()] == ["sweep.journal"]


def test_an_empty_file_becomes_a_journal(journal: str) -> None:
    Path(journal).touch()
    SweepStudy("s", journal).enqueue(CELLS)
    assert len(SweepStudy("s", journal, create=False).trials()) == 3


def test_a_lock_that_was_left_behind_does_not_stop_the_sweep_for_ever(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    study = SweepStudy("s", "folder/sweep.journal")
    lock = study.storage._backend._lock  # type: ignore[attr-defined]
    lock.grace_period = 0.2
    lock.acquire()
    # A dangling link would never be seen to grow old
    assert Path("folder/sweep.journal.lock").exists()
    study.enqueue(CELLS[:1])
    assert len(study.trials()) == 1


def test_other_settings_are_refused(journal: str) -> None:
    SweepStudy("s", journal).check_settings({"T": {"n_steps": 8, "n_envs": 2}})
    study = SweepStudy("s", journal)
    study.check_settings({"T": {"n_envs": 2, "n_steps": 8}, "U": {}})
    with pytest.raises(SweepError, match="n_steps 8 -> 16"):
        study.check_settings({"T": {"n_steps": 16, "n_envs": 2}})


def storage_of(location: str) -> optuna.storages.BaseStorage:
    return optuna.storages.JournalStorage(optuna.storages.journal.JournalFileBackend(location))


def test_other_formats_and_other_studies_are_refused(journal: str) -> None:
    study = optuna.create_study(storage=storage_of(journal), study_name="s")
    study.set_user_attr("sb3_gae_sweep_format", 99)
    optuna.create_study(storage=storage_of(journal), study_name="other").add_trial(optuna.trial.create_trial(value=1.0))
    before = Path(journal).read_bytes()
    with pytest.raises(SweepError, match=r"is of format 99, and this sb3-gae knows 1; use the sb3-gae that wrote it"):
        SweepStudy("s", journal)
    with pytest.raises(SweepError, match=r"is no sweep of sb3-gae; choose another --name"):
        SweepStudy("other", journal)
    assert Path(journal).read_bytes() == before


@pytest.mark.parametrize(
    ("location", "message"),
    [
        ("{tmp}/file/x.journal", "cannot be reached"),
        ("{tmp}", "cannot be reached"),
        ("{tmp}/file", "is not one of Optuna's, or it is damaged"),
        ("sqlite:///{tmp}/nowhere/x.db", "cannot be reached"),
        ("sqlite:///{tmp}/file", "cannot be reached"),
        ("nosuchbase://host/x", "cannot be reached"),
        ("nosuchbase://host/x?password=secret", "cannot be reached"),
        ("postgres://me:secret@host/x", "PostgreSQL's is postgresql+psycopg://"),
        ("postgresql+psycopg://me:top@secret@host/x", "inside a user or a password it is written %40"),
        ("postgresql+psycopg://me:top:secret@host:a/x", "the port is a number"),
        ("postgresql+asyncpg://me:secret@host/x", 'pip install "sb3-gae[postgresql]"'),
        ("mysql+pymysql://me:secret@localhost/x", "needs a driver that is not installed (pip install pymysql)"),
    ],
)
def test_storages_that_cannot_be_used(location: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("these are\nno results\n")
    with pytest.raises(SweepError) as error:
        SweepStudy("s", location.format(tmp=tmp_path))
    assert message in str(error.value)
    assert "\n" not in str(error.value) and "secret" not in str(error.value)
    assert (tmp_path / "file").read_text() == "these are\nno results\n"


@pytest.mark.parametrize("driver", ["psycopg2", "psycopg"])
def test_how_to_get_a_missing_driver_is_said(driver: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, driver, None)  # as if it were not installed
    with pytest.raises(SweepError) as error:
        SweepStudy("s", f"postgresql+{driver}://me:secret@localhost/x")
    assert 'needs a driver that is not installed (pip install "sb3-gae[postgresql]"' in str(error.value)


def test_a_locked_database(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    location = f"sqlite:///{tmp_path}/sweep.db"
    SweepStudy("s", location)
    monkeypatch.setattr("sb3_gae.sweep.storage._LOCK_SECONDS", 0.1)
    holder = sqlite3.connect(tmp_path / "sweep.db")
    holder.execute("BEGIN EXCLUSIVE")
    with pytest.raises(SweepError, match=r"is locked by another program; wait for it, or pass another --storage"):
        SweepStudy("s", location)
    holder.close()


def test_looking_makes_no_database(tmp_path: Path) -> None:
    location = f"sqlite:///{tmp_path}/sweep.db"
    assert not holds(location, "s")
    with pytest.raises(SweepError, match="There is no sweep at sqlite:"):
        SweepStudy("s", location, create=False)
    assert not list(tmp_path.iterdir())
    # Nor tables in somebody else's
    with contextlib.closing(sqlite3.connect(tmp_path / "sweep.db")) as database:
        database.execute("CREATE TABLE letters (text TEXT)")
    before = (tmp_path / "sweep.db").read_bytes()
    assert not holds(location, "s")
    with pytest.raises(SweepError, match="There is no sweep at sqlite:"):
        SweepStudy("s", location, create=False)
    assert (tmp_path / "sweep.db").read_bytes() == before
    SweepStudy("s", location)
    assert holds(location, "s") and not holds(location, "t")


def test_what_is_not_there_is_not_made(tmp_path: Path) -> None:
    with pytest.raises(SweepError, match="There is no sweep at"):
        SweepStudy("s", str(tmp_path / "sweep.journal"), create=False)
    assert not list(tmp_path.iterdir())
    SweepStudy("s", str(tmp_path / "sweep.journal"))
    with pytest.raises(SweepError, match=r"no sweep 'other' in .*: it holds s"):
        SweepStudy("other", str(tmp_path / "sweep.journal"), create=False)
    with pytest.raises(SweepError, match="without slashes"):
        SweepStudy(f"a{os.sep}b")


def test_asking_again_in_a_transaction_that_an_outage_ended_is_an_outage() -> None:
    with pytest.raises(UnreachableError, match="cannot be reached: Can't reconnect"), storage_errors("postgresql://host/base"):
        try:
            raise PendingRollbackError("Can't reconnect until invalid transaction is rolled back.")
        except SQLAlchemyError as error:
            raise StorageInternalError("An exception is raised during the commit.") from error
