"""
A PostgreSQL server for tests; whoever imports this is skipped, with the reason, where Debian's or the driver is not there.
"""

import contextlib
import os
import pwd
import shutil
import signal
import socket
import subprocess
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import sqlalchemy

pytest.importorskip("psycopg", reason="psycopg is needed: pip install -e '.[postgresql]'", exc_type=ImportError)

USER, PASSWORD = "sweeper", "not-to-be-shown"


def _find_binaries() -> Path:
    found = sorted(Path("/usr/lib/postgresql").glob("*/bin/initdb"), key=lambda path: float(path.parts[-3]))
    on_path = shutil.which("initdb")
    if not found and on_path is None:
        pytest.skip("a PostgreSQL server is needed: apt install postgresql", allow_module_level=True)
    return found[-1].parent if found else Path(str(on_path)).parent


BINARIES = _find_binaries()


class PostgresqlServer:
    """
    A server of its own on 127.0.0.1, whose user is :data:`USER` with :data:`PASSWORD`.

    :param folder: for its files, of the user that runs it
    """

    def __init__(self, folder: Path):
        self._folder = folder
        self._data = folder / "data"
        self._server: subprocess.Popen[bytes] | None = None
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        password = folder / "password"
        password.write_text(PASSWORD)
        password.chmod(0o644)
        command = [BINARIES / "initdb", "-D", self._data, "-U", USER, "--auth=scram-sha-256", f"--pwfile={password}"]
        command += ["--no-sync", "--no-locale", "--encoding=UTF8"]
        made = subprocess.run(command, **self._how(), stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
        assert made.returncode == 0, made.stdout.decode()

    def _how(self) -> dict[str, Any]:
        how: dict[str, Any] = {"cwd": self._folder}
        if os.getuid() == 0:
            # PostgreSQL refuses to be run by root
            owner = pwd.getpwuid(self._folder.stat().st_uid)
            how |= {"user": owner.pw_uid, "group": owner.pw_gid, "extra_groups": []}
        return how

    def url(self, database: str = "postgres", password: str | None = None) -> str:
        """Without a password that of the environment is used, or there is none."""
        user = USER if password is None else f"{USER}:{password}"
        return f"postgresql+psycopg://{user}@127.0.0.1:{self.port}/{database}"

    def create_database(self, name: str) -> None:
        engine = sqlalchemy.create_engine(self.url(password=PASSWORD), isolation_level="AUTOCOMMIT")
        with engine.connect() as connection:
            connection.exec_driver_sql(f'CREATE DATABASE "{name}"')
        engine.dispose()

    def start(self) -> None:
        if self._server is not None:
            return
        options = ("listen_addresses=127.0.0.1", f"port={self.port}", "unix_socket_directories=", "fsync=off")
        command = [BINARIES / "postgres", "-D", self._data, *(word for option in options for word in ("-c", option))]
        with (self._folder / "log").open("ab") as log:
            self._server = subprocess.Popen(command, **self._how(), stdout=log, stderr=log)
        self._wait_until_it_answers()

    def _wait_until_it_answers(self) -> None:
        assert self._server is not None
        engine = sqlalchemy.create_engine(self.url(password=PASSWORD), poolclass=sqlalchemy.NullPool)
        until = time.monotonic() + 60.0
        while True:
            try:
                engine.connect().close()
                return
            except sqlalchemy.exc.OperationalError:
                log = (self._folder / "log").read_text()
                assert self._server.poll() is None and time.monotonic() < until, log
                time.sleep(0.05)

    def stop(self) -> None:
        """Ends it, and every connection with it."""
        if self._server is not None:
            # Its "fast" shutdown
            self._server.send_signal(signal.SIGINT)
            self._server.wait(60.0)
            self._server = None


@contextlib.contextmanager
def postgresql_server() -> Iterator[PostgresqlServer]:
    """A running server, in a folder that goes away with it."""
    # Not pytest's: no other user may enter that
    with tempfile.TemporaryDirectory(prefix="postgresql-") as name:
        if os.getuid() == 0:
            shutil.chown(name, _unprivileged_user())
        server = PostgresqlServer(Path(name))
        try:
            server.start()
            yield server
        finally:
            server.stop()


def _unprivileged_user() -> str:
    names = {entry.pw_name for entry in pwd.getpwall()}
    return "postgres" if "postgres" in names else "nobody"
