"""Optuna's storages: opened by path or URL, safe for many processes, and with errors of one line."""

import contextlib
import json
import random
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import optuna
import sqlalchemy
from optuna.storages.journal import JournalFileBackend, JournalFileSymlinkLock
from sqlalchemy.exc import (
    DBAPIError,
    IntegrityError,
    InterfaceError,
    NoSuchModuleError,
    OperationalError,
    PendingRollbackError,
    ProgrammingError,
    SQLAlchemyError,
)

from sb3_gae.sweep.errors import SweepError, UnreachableError, in_one_line
from sb3_gae.sweep.location import is_server, is_url, parse_url, without_password

#: seconds that a process waits for another one's write
_LOCK_SECONDS = 60
#: times that a database is opened while others make its tables
_ATTEMPTS = 5
#: of libpq, in seconds: a server that is cut off says nothing, and would be waited for by the hour
_POSTGRESQL = {
    "connect_timeout": 10,
    "keepalives_idle": 30,
    "keepalives_interval": 10,
    "keepalives_count": 3,
    "tcp_user_timeout": 60_000,  # milliseconds
}
#: of drivers whose packages have other names
_PACKAGES_OF_DRIVERS = {"mysqldb": "mysqlclient"}
#: of a journal
_BEGINNING = b'{"op_code":'
#: seconds without growth after which a line that has no end counts as torn
_SETTLE_SECONDS = 3.0


class _TidyLock(JournalFileSymlinkLock):
    """
    Optuna's lock, whose holder finds a journal of whole lines.

    A process that is killed, or a disk that fills up, in the middle of a line leaves a torn one. Optuna would append to
    it and could not read the file any more. Here it is taken away first: whoever began it was not told that it is stored.

    :param path: of the journal
    """

    def __init__(self, path: Path):
        super().__init__(str(path))
        self._path = path

    def acquire(self) -> bool:
        acquired = super().acquire()
        try:
            while (whole := _size_of_whole_lines(self._path)) is not None:
                _remove_torn_line(self._path, whole)
        except BaseException:
            self.release()
            raise
        return acquired


def _size_of_whole_lines(path: Path) -> int | None:
    """:return: bytes until the end of the last whole line, None if nothing comes after it"""
    with path.open("rb") as file:
        size = start = file.seek(0, 2)
        file.seek(max(0, size - 1))
        if file.read(1) in (b"", b"\n"):
            return None
        while start > 0:
            start = max(0, start - 2**20)
            file.seek(start)
            found = file.read(size - start).rfind(b"\n")
            if found >= 0:
                return start + found + 1
    # Nothing of it is stored, but it may as well be somebody's file
    raise ValueError("it has no whole line; remove it if it was to be a sweep")


def _remove_torn_line(path: Path, whole: int) -> None:
    """
    Cut what comes after the whole lines, unless somebody still writes it.

    Optuna takes the lock from a process that has held it for 30 s, dead or not. A line that is cut while its process writes
    would be lost, and its rest would damage the journal. Each line is written by one call of the system, which does not
    pause: one that has not grown for seconds has lost its writer.
    """
    before = path.stat().st_size
    time.sleep(_SETTLE_SECONDS)
    with path.open("rb+") as file:
        if file.seek(0, 2) == before:
            file.truncate(whole)


def _check_is_journal(path: Path) -> None:
    """:raises ValueError: if the file holds something else; an empty one may become a journal"""
    if not path.exists():
        return
    with path.open("rb") as file:
        first = file.readline(2**20)
    if not first.endswith(b"\n") and _BEGINNING.startswith(first[: len(_BEGINNING)]):
        return  # another process may be writing it
    try:
        entry = json.loads(first)
    except ValueError:
        entry = None
    if not isinstance(entry, dict) or not {"op_code", "worker_id"} <= entry.keys():
        raise ValueError("its first line is no entry of a journal")


def open_storage(location: str, *, create: bool) -> optuna.storages.BaseStorage:
    """
    :param location: URL of a database that Optuna knows, or path of a journal file
    :param create: whether to make what is not there
    :return: the storage
    :raises SweepError: if it cannot be reached, is locked, or is something else
    """
    with storage_errors(location):
        if is_url(location):
            return _open_database(location, create)
        # Absolute: the lock is a symbolic link to the file, and a dangling one is never seen to grow old
        path = Path(location).absolute()
        if not create and not path.exists():
            raise SweepError(f"There is no sweep at {location}; run one first, or name its --storage.")
        _check_is_journal(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        return optuna.storages.JournalStorage(JournalFileBackend(str(path), lock_obj=_TidyLock(path)))


def _open_database(url: str, create: bool) -> optuna.storages.BaseStorage:
    parsed = parse_url(url)
    if not create and not _is_begun(parsed):
        raise SweepError(f"There is no sweep at {without_password(url)}; run one first, or name its --storage.")
    for attempt in range(_ATTEMPTS):
        try:
            storage = optuna.storages.RDBStorage(url, engine_kwargs=_engine_arguments(parsed))
            break
        except SQLAlchemyError as error:
            # Machines that begin at the same moment all make the tables, and the database lets one of them
            if attempt + 1 == _ATTEMPTS or not _may_be_made_already(error):
                raise
            time.sleep(random.uniform(0.05, 0.2))
    if parsed.get_backend_name() == "sqlite":
        _begin_with_a_lock(storage.engine)
    return storage


def _may_be_made_already(error: SQLAlchemyError) -> bool:
    return isinstance(error, IntegrityError | ProgrammingError) or "already exists" in str(error)


def _engine_arguments(url: sqlalchemy.URL) -> dict[str, Any]:
    if url.get_backend_name() == "sqlite":
        return {"connect_args": {"timeout": _LOCK_SECONDS}}
    arguments: dict[str, Any] = {"pool_pre_ping": True}  # a connection that the server closed in the meantime is no error
    if url.drivername in ("postgresql", "postgresql+psycopg", "postgresql+psycopg2"):
        arguments["connect_args"] = {name: value for name, value in _POSTGRESQL.items() if name not in url.query}
    return arguments


def _is_begun(url: sqlalchemy.URL) -> bool:
    """Whether a database has Optuna's tables: to look, Optuna would make them, and SQLite its file."""
    is_file = url.get_backend_name() == "sqlite" and url.database and not url.database.startswith((":memory:", "file:"))
    if is_file and not Path(str(url.database)).exists():
        return False
    engine = sqlalchemy.create_engine(url, **_engine_arguments(url))
    try:
        return sqlalchemy.inspect(engine).has_table("studies")
    finally:
        engine.dispose()


def _begin_with_a_lock(engine: sqlalchemy.Engine) -> None:
    """
    Let SQLite lock when a transaction begins and not when it first writes.

    Otherwise two processes may both read that a cell waits and then both take it: SQLite has no rows to lock.
    """

    @sqlalchemy.event.listens_for(engine, "connect")
    def leave_transactions_to_us(connection: Any, _: Any) -> None:
        connection.isolation_level = None

    @sqlalchemy.event.listens_for(engine, "begin")
    def begin(connection: sqlalchemy.Connection) -> None:
        connection.exec_driver_sql("BEGIN IMMEDIATE")

    # Connections that were made before
    engine.dispose()


@contextlib.contextmanager
def storage_errors(location: str) -> Iterator[None]:
    """
    Say in one line what is wrong with a storage.

    :param location: its URL or path, for the message
    :raises UnreachableError: in place of what a database raises whose server does not answer
    :raises SweepError: in place of what else Optuna, SQLAlchemy or the file system raise
    """
    try:
        yield
    except (SweepError, optuna.exceptions.UpdateFinishedTrialError):
        raise
    except (OSError, SQLAlchemyError, ImportError, optuna.exceptions.OptunaError) as error:
        kind = UnreachableError if is_server(location) and _is_outage(error) else SweepError
        raise kind(_explain(location, error)) from error
    except (ValueError, KeyError, TypeError, AssertionError, RuntimeError) as error:
        if isinstance(error, RuntimeError) and type(error) is not RuntimeError:
            raise
        # What reading a journal that is none ends in, or a database that another version of Optuna has made
        raise SweepError(_explain(location, error)) from error


def _is_outage(error: Exception) -> bool:
    # The last one comes where Optuna asks again in the transaction that the outage has ended
    return isinstance(_cause_of(error), OperationalError | InterfaceError | PendingRollbackError)


def _cause_of(error: BaseException) -> BaseException:
    """What the database said, which Optuna wraps in a guess of its own."""
    inner: BaseException | None = error
    while inner is not None and not isinstance(inner, DBAPIError | PendingRollbackError):
        inner = inner.__cause__
    return error if inner is None else inner


def _explain(location: str, error: Exception) -> str:
    where, cause = without_password(location), _cause_of(error)
    said = cause.orig if isinstance(cause, DBAPIError) and cause.orig is not None else cause
    what = (in_one_line(said) or type(said).__name__).rstrip(".?")
    if "locked" in what and not is_server(location):
        return f"The storage {where} is locked by another program; wait for it, or pass another --storage. ({what})"
    if isinstance(error, ImportError):
        return f"The storage {where} needs a driver that is not installed{_driver_of(location)}: {what}"
    if isinstance(cause, OSError | SQLAlchemyError):
        return f"The storage {where} cannot be reached: {what}. {_advice(location, cause)}"
    return f"The storage {where} is not one of Optuna's, or it is damaged ({what}); pass another --storage."


def _driver_of(location: str) -> str:
    """How to get it, empty if the location does not tell."""
    if location.startswith("postgresql"):
        return ' (pip install "sb3-gae[postgresql]", and a URL that begins with postgresql+psycopg://)'
    try:
        name = sqlalchemy.make_url(location).get_driver_name()
    except SQLAlchemyError:
        return ""
    return f" (pip install {_PACKAGES_OF_DRIVERS.get(name, name)})"


def _advice(location: str, cause: BaseException) -> str:
    if isinstance(cause, NoSuchModuleError):
        return "Check how the URL begins: PostgreSQL's is postgresql+psycopg://."
    if is_server(location):
        return "Check that the server runs, the URL's host, port, user and database, and the password."
    return "Check the path or the URL, and that it can be written."


def holds(location: str, study: str) -> bool:
    """
    Look without making anything.

    :param location: URL or path of a storage
    :param study: name
    :return: whether the storage is there and has the study
    :raises SweepError: if it cannot be reached
    """
    if not is_url(location) and not Path(location).exists():
        return False
    with storage_errors(location):
        if is_url(location) and not _is_begun(parse_url(location)):
            return False
        return study in optuna.get_all_study_names(open_storage(location, create=False))
