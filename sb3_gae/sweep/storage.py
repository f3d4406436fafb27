"""Optuna's storages: opened by path or URL, safe for many processes, and with errors of one line."""

import contextlib
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
    ProgrammingError,
    SQLAlchemyError,
)

from sb3_gae.sweep.errors import SweepError, UnreachableError
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
            _remove_torn_line(self._path)
        except BaseException:
            self.release()
            raise
        return acquired


def _remove_torn_line(path: Path) -> None:
    with path.open("rb+") as file:
        size = file.seek(0, 2)
        if size == 0:
            return
        file.seek(size - 1)
        if file.read(1) == b"\n":
            return
        start = max(0, size - 2**20)
        while True:
            file.seek(start)
            found = file.read(size - start).rfind(b"\n")
            if found >= 0 or start == 0:
                file.truncate(start + found + 1)
                return
            start = max(0, start - 2**20)


def open_storage(location: str, *, create: bool) -> optuna.storages.BaseStorage:
    """
    :param location: URL of a database that Optuna knows, or path of a journal file
    :param create: whether to make what is not there
    :return: the storage
    :raises SweepError: if it cannot be reached, is locked, or is something else
    """
    with storage_errors(location):
        if is_url(location):
            return _open_database(location)
        # Absolute: the lock is a symbolic link to the file, and a dangling one is never seen to grow old
        path = Path(location).absolute()
        if not create and not path.exists():
            raise SweepError(f"There is no sweep at {location}; run one first, or name its --storage.")
        path.parent.mkdir(parents=True, exist_ok=True)
        return optuna.storages.JournalStorage(JournalFileBackend(str(path), lock_obj=_TidyLock(path)))


def _open_database(url: str) -> optuna.storages.BaseStorage:
    parsed = parse_url(url)
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
    except (ValueError, KeyError, TypeError, AssertionError) as error:
        # What reading a journal that is none ends in
        raise SweepError(_explain(location, error)) from error


def _is_outage(error: Exception) -> bool:
    return isinstance(_cause_of(error), OperationalError | InterfaceError)


def _cause_of(error: BaseException) -> BaseException:
    """What the database said, which Optuna wraps in a guess of its own."""
    inner: BaseException | None = error
    while inner is not None and not isinstance(inner, DBAPIError):
        inner = inner.__cause__
    return error if inner is None else inner


def _explain(location: str, error: Exception) -> str:
    where, cause = without_password(location), _cause_of(error)
    said = cause.orig if isinstance(cause, DBAPIError) and cause.orig is not None else cause
    what = (" ".join(str(said).split()) or type(said).__name__)[:200].rstrip(".?")
    if "locked" in what and not is_server(location):
        return f"The storage {where} is locked by another program; wait for it, or pass another --storage. ({what})"
    if isinstance(error, ImportError):
        return f"The storage {where} needs a driver that is not installed{_driver_of(location)}: {what}"
    if isinstance(cause, OSError | SQLAlchemyError):
        return f"The storage {where} cannot be reached: {what}. {_advice(location, cause)}"
    return f"The storage {where} is not one of Optuna's, or it is damaged ({what}); pass another --storage."


def _driver_of(location: str) -> str:
    if not location.startswith("postgresql"):
        return ""
    return ' (pip install "sb3-gae[postgresql]", and a URL that begins with postgresql+psycopg://)'


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
        return study in optuna.get_all_study_names(open_storage(location, create=False))
