"""Where a sweep is kept: journals that a write was cut off in, databases that are locked, and what is none of ours."""

import contextlib
import os
import sqlite3
import sys
import threading
import time
from pathlib import Path

import optuna
import pytest
from optuna.exceptions import StorageInternalError
from sqlalchemy.exc import PendingRollbackError, SQLAlchemyError
from sweep_cells import CELLS, statuses

from sb3_gae.sweep import SweepError, SweepStudy
from sb3_gae.sweep.errors import UnreachableError
from sb3_gae.sweep.ledger import Status
from sb3_gae.sweep.storage import holds, storage_errors


@pytest.fixture
def journal(tmp_path: Path) -> str:
    return str(tmp_path / "sweep.journal")


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
    optuna.create_study(storage=storage_of(journal), study_name="somebody's")
    before = Path(journal).read_bytes()
    SweepStudy("somebody's", journal, create=False)
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


def test_a_database_of_another_optuna_is_told_in_one_line(tmp_path: Path) -> None:
    location = f"sqlite:///{tmp_path}/old.db"
    optuna.create_study(storage=location, study_name="s")
    with contextlib.closing(sqlite3.connect(tmp_path / "old.db")) as database:
        database.execute("update version_info set schema_version = 11")
        database.execute("update alembic_version set version_num = 'v2.6.0.a'")
        database.commit()
    with pytest.raises(SweepError, match="schema"):
        SweepStudy("s", location, create=False)


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
