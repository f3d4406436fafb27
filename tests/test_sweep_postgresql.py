"""A sweep over several machines, with PostgreSQL as its storage: machines that are lost, and a server that is gone."""

import itertools
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from optuna.trial import FrozenTrial
from postgresql_server import PASSWORD, PostgresqlServer, postgresql_server

from sb3_gae.sweep import Cell, SweepError, SweepStudy, read_results, results_of, run_sweep
from sb3_gae.sweep.cli import main
from sb3_gae.sweep.ledger import Outcome, Standing, Status
from sb3_gae.sweep.recorder import COLUMNS as ROW_COLUMNS

HERE = Path(__file__).parent
TINY = {"n_envs": 1, "n_steps": 32, "policy_kwargs": {"net_arch": [4]}}
GRID: dict[str, Any] = dict(
    env="SweepTask-v0", gammas=[0.9], lambdas=[0.5], iterations=5, gym_packages=["sweep_task"], hyperparams=TINY, name="s"
)
# The same on the command line
COMMAND = """
    -m sb3_gae.sweep run --env SweepTask-v0 --gammas .9 --lambdas .5 --iterations 5 --gym-packages sweep_task --name s
    --no-progress -params n_envs:1 n_steps:32 policy_kwargs:dict(net_arch=[4])"""
ROW = dict.fromkeys(ROW_COLUMNS, 1.0)

_databases = (f"sweeps{number}" for number in itertools.count())


@pytest.fixture(scope="module")
def running_server() -> Iterator[PostgresqlServer]:
    with postgresql_server() as server:
        yield server


@pytest.fixture
def server(running_server: PostgresqlServer) -> PostgresqlServer:
    running_server.start()
    return running_server


@pytest.fixture
def url(server: PostgresqlServer, monkeypatch: pytest.MonkeyPatch) -> str:
    """Of an empty database; the password is in the environment."""
    monkeypatch.setenv("PGPASSWORD", PASSWORD)
    name = next(_databases)
    server.create_database(name)
    return server.url(name)


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


class Machine:
    """
    A runner that takes itself for another machine.

    :param name: of the machine
    :param arguments: of ``run``
    """

    def __init__(self, name: str, *arguments: str):
        self._said = Path(f"{name}.txt")
        paths = [str(HERE), str(HERE.parent), *filter(None, [os.environ.get("PYTHONPATH")])]
        with self._said.open("wb") as output:
            self.process = subprocess.Popen(
                [sys.executable, *COMMAND.split(), *arguments],
                env=os.environ | {"PYTHONPATH": os.pathsep.join(paths), "OMP_NUM_THREADS": "1", "SWEEP_HOST": name},
                stdout=output,
                stderr=subprocess.STDOUT,
            )

    @property
    def said(self) -> str:
        return self._said.read_text()

    def finish(self, code: int = 0) -> str:
        self.process.wait(120.0)
        assert self.process.returncode == code, self.said
        return self.said


@pytest.fixture
def machine() -> Iterator[Callable[..., Machine]]:
    machines: list[Machine] = []

    def begin(name: str, *arguments: str) -> Machine:
        machines.append(Machine(name, *arguments))
        return machines[-1]

    yield begin
    for one in machines:
        one.process.kill()
        one.process.wait()


def wait_until(happens: Callable[[], bool], *machines: Machine) -> None:
    until = time.monotonic() + 120.0
    while not happens():
        said = "\n".join(machine.said for machine in machines)
        assert time.monotonic() < until and all(machine.process.poll() is None for machine in machines), said
        time.sleep(0.05)


def runs() -> list[int]:
    """Seeds of all runs that were begun."""
    return [int(line) for line in Path("runs.txt").read_text().split()] if Path("runs.txt").exists() else []


def by_seed(study: SweepStudy) -> dict[int, Standing]:
    return {Cell.from_key(key).seed: standing for key, standing in study.standings().items()}


def trial_of(standing: Standing) -> FrozenTrial:
    assert standing.trial is not None
    return standing.trial


def outcomes(study: SweepStudy) -> list[tuple[int, str]]:
    """Seed and outcome of the trials that were begun and did not complete."""
    attributes = [trial.user_attrs for trial in study.trials()]
    found = [(stored["cell"]["seed"], stored["outcome"]) for stored in attributes if "outcome" in stored]
    return sorted((seed, outcome) for seed, outcome in found if outcome != Outcome.DUPLICATE)


def curves(table: pd.DataFrame) -> pd.DataFrame:
    """What is the same for the same cells, wherever they run."""
    columns = ["seed", *(name for name in ROW_COLUMNS if name != "seconds"), "settings"]
    return table[columns].sort_values(["seed", "iteration"], ignore_index=True)


def test_cells_of_machines_that_are_lost_are_taken_over(
    url: str, machine: Callable[..., Machine], capsys: pytest.CaptureFixture[str]
) -> None:
    Path("slow-0").touch()
    Path("slow-1").touch()
    machines = {
        name: machine(name, "--seeds", "5", "--storage", url, "--silent-after", "5", "--wait") for name in ("a", "b", "c")
    }
    wait_until(lambda: {2, 3, 4} <= set(runs()), *machines.values())
    study = SweepStudy("s", url, create=False)

    def are_in_the_middle() -> bool:
        table = by_seed(study)
        return all(len(trial_of(table[seed]).intermediate_values) > 0 for seed in (0, 1)) and all(
            table[seed].status == Status.DONE for seed in (2, 3, 4)
        )

    wait_until(are_in_the_middle, *machines.values())
    assert outcomes(study) == [], "machines that live keep their cells"
    killed, frozen = (machines.pop(trial_of(by_seed(study)[seed]).user_attrs["sign_of_life"]["host"]) for seed in (0, 1))
    (survivor,) = machines.values()
    killed.process.kill()
    frozen.process.send_signal(signal.SIGSTOP)
    Path("slow-0").unlink()
    Path("slow-1").unlink()
    assert "5 cells, 5 done, 0 left" in survivor.finish()
    # It wakes up, in the middle of a cell that is another's by now
    frozen.process.send_signal(signal.SIGCONT)
    assert "5 cells, 5 done, 0 left" in frozen.finish()
    assert sorted(runs()) == [0, 0, 1, 1, 2, 3, 4]
    assert outcomes(study) == [(0, Outcome.LOST), (1, Outcome.LOST)]
    lost = [trial for trial in study.trials() if trial.user_attrs.get("outcome") == Outcome.LOST]
    assert all("gave no sign of life for" in trial.user_attrs["reason"] for trial in lost)

    capsys.readouterr()
    where = ["--name", "s", "--storage", url]
    assert main(["status", *where]) == 0 and main(["export", *where, "-o", "shared.csv"]) == 0
    said = capsys.readouterr().out
    assert "5 cells, 5 done, 0 left" in said and "25 rows, 5 cells" in said
    shared = read_results("shared.csv")
    assert not shared.duplicated(["seed", "iteration"]).any()
    pd.testing.assert_frame_equal(curves(shared), curves(run_sweep(seeds=5, **GRID, progress=False)))


def test_machines_may_begin_at_the_same_moment(url: str) -> None:
    cells = [Cell("CartPole-v1", "trust_region", 0.9, 0.5, seed, 1) for seed in range(12)]
    begin = threading.Barrier(4)
    taken: list[int] = []
    errors: list[Exception] = []

    def work() -> None:
        begin.wait()
        try:
            study = SweepStudy("s", url)
            study.check_settings({"CartPole-v1": {"n_steps": 8}})
            study.enqueue(cells)
            while (claim := study.claim(cells)) is not None:
                taken.append(claim.cell.seed)
                # In a short run no episode may have ended
                claim.append([ROW | {"mean_return": float("nan")}])
                claim.complete(float("-inf"))
        except Exception as error:
            errors.append(error)

    threads = [threading.Thread(target=work) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert errors == [] and sorted(taken) == list(range(12))
    table = results_of(SweepStudy("s", url, create=False))
    assert sorted(table["seed"]) == list(range(12)) and table["mean_return"].isna().all()


def test_a_server_that_comes_back_is_waited_for(server: PostgresqlServer, url: str, machine: Callable[..., Machine]) -> None:
    Path("hold-1").touch()
    runner = machine("runner", "--seeds", "4", "--storage", url, "--jobs", "2", "--silent-after", "90")
    wait_until(lambda: {1, 2} <= set(runs()), runner)
    server.stop()
    Path("hold-1").unlink()
    wait_until(lambda: "Waiting for it, 60 s at most." in runner.said, runner)
    server.start()
    said = runner.finish()
    assert "The storage answers again." in said and "4 cells, 4 done, 0 left" in said
    assert sorted(runs()) == [0, 1, 2, 3] and outcomes(SweepStudy("s", url, create=False)) == []
    pd.testing.assert_frame_equal(
        curves(results_of(SweepStudy("s", url, create=False))), curves(run_sweep(seeds=4, **GRID, progress=False))
    )


def test_a_server_that_stays_away_ends_the_run_and_the_same_command_goes_on(server: PostgresqlServer, url: str) -> None:
    Path("hold-1").touch()
    ends: list[BaseException] = []

    def run() -> None:
        try:
            run_sweep(seeds=3, **GRID, storage=url, silent_after=0.9, progress=False)
        except BaseException as error:
            ends.append(error)

    sweep = threading.Thread(target=run)
    sweep.start()
    wait_until(lambda: runs() == [0, 1])
    server.stop()
    Path("hold-1").unlink()
    sweep.join()
    (end,) = ends
    assert isinstance(end, SweepError) and "\n" not in str(end)
    assert "cannot be reached: " in str(end) and str(end).endswith("the same command goes on when the storage is back.")

    server.start()
    # This process lives, but does not run the cell any more
    table = run_sweep(seeds=3, **GRID, storage=url, silent_after=0.9, wait=True, progress=False)
    assert runs() == [0, 1, 1, 2], "what was done is not run again"
    pd.testing.assert_frame_equal(curves(table), curves(run_sweep(seeds=3, **GRID, progress=False)))


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ("port", "failed: Connection refused"),
        ("database", 'database "nowhere" does not exist'),
        ("password", "password authentication failed"),
    ],
)
def test_servers_that_cannot_be_used(
    wrong: str, message: str, server: PostgresqlServer, capsys: pytest.CaptureFixture[str]
) -> None:
    password = f"{PASSWORD}-at-all" if wrong == "password" else PASSWORD
    location = server.url("nowhere" if wrong == "database" else "postgres", password)
    if wrong == "port":
        # Where nobody listens
        location = location.replace(str(server.port), "9")
    for command in ([*COMMAND.split()[2:], "--seeds", "1"], ["status", "--name", "s"], ["export", "--name", "s"]):
        assert main([*command, "--storage", location]) == 2
        said = capsys.readouterr()
        assert message in said.err and "Check that the server runs, the URL's host, port, user and database" in said.err
        assert said.err.startswith("sb3_gae.sweep: The storage ") and said.err.count("\n") == 1 and said.out == ""
        assert PASSWORD not in said.err
    assert not runs()
