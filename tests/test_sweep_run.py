"""Running a sweep: what a cell means, and what happens when something goes wrong."""

import contextlib
import functools
import json
import os
import resource
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import rl_zoo3.train
import torch as th
from envs_for_tests import AnySpacesEnv, Endless, small_model
from gymnasium.wrappers import TimeLimit
from local_crew import LocalCrew
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_gae import TRPOGAE, MujocoVecEnv
from sb3_gae.sweep import CONDITIONS, Cell, SweepError, SweepStudy, results_of, run_sweep
from sb3_gae.sweep.experiment import Experiment
from sb3_gae.sweep.ledger import Outcome, Status
from sb3_gae.sweep.plan import Options
from sb3_gae.sweep.recorder import COLUMNS, Recorder, Row
from sb3_gae.sweep.worker import return_freed_memory

HERE = Path(__file__).parent
TINY = {"n_envs": 1, "n_steps": 32, "policy_kwargs": {"net_arch": [4]}}
GRID: dict[str, Any] = dict(
    env="SweepTask-v0", gammas=[0.9], lambdas=[0.5], iterations=2, gym_packages=["sweep_task"], hyperparams=TINY, name="s"
)
# The same on the command line
COMMAND = """
    -m sb3_gae.sweep run --env SweepTask-v0 --gammas .9 --lambdas .5 --iterations 2 --gym-packages sweep_task --name s
    --no-progress -params n_envs:1 n_steps:32 policy_kwargs:dict(net_arch=[4]) --seeds"""

# A module that kills those processes of a sweep that import it first, one for each character of a file
DEADLY = """
import multiprocessing, os, pathlib, signal
left = pathlib.Path("to-kill").read_text()
if left and multiprocessing.parent_process() is not None:
    pathlib.Path("to-kill").write_text(left[1:])
    os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def start(seeds: int, *arguments: str, own_group: bool = False) -> "subprocess.Popen[str]":
    paths = [str(HERE), str(HERE.parent), *filter(None, [os.environ.get("PYTHONPATH")])]
    return subprocess.Popen(
        [sys.executable, *COMMAND.split(), str(seeds), *arguments],
        env=os.environ | {"PYTHONPATH": os.pathsep.join(paths), "OMP_NUM_THREADS": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=own_group,
    )


def runs() -> list[int]:
    """Seeds of all runs that were begun."""
    return [int(line) for line in Path("runs.txt").read_text().split()] if Path("runs.txt").exists() else []


def wait_for_runs(count: int, process: "subprocess.Popen[str]") -> None:
    until = time.monotonic() + 60.0
    while len(runs()) < count:
        assert process.poll() is None, process.communicate()[0]
        assert time.monotonic() < until, "the sweep does not begin"
        time.sleep(0.02)


def finish(process: "subprocess.Popen[str]", code: int = 0) -> str:
    output = process.communicate(timeout=60)[0]
    assert process.returncode == code, output
    return output


def outcomes() -> list[tuple[int, str, str]]:
    """Seed, outcome and reason of the trials that did not complete."""
    attributes = [trial.user_attrs for trial in SweepStudy("s", create=False).trials()]
    return [(a["cell"]["seed"], a["outcome"], a["reason"]) for a in attributes if "outcome" in a]


def test_a_cell_is_what_the_zoo_trains(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    params = ["gamma:0.9", "gae_lambda:0.5", "n_envs:2", "n_steps:64", "vf_optimizer:'adam'"]
    command = "train.py --algo trpo_gae --env CartPole-v1 --seed 3 -n 384 --eval-freq 100 --verbose 0 -f logs -params"
    monkeypatch.setattr(sys, "argv", [*command.split(), *params])
    rl_zoo3.train.train()
    expected = TRPOGAE.load("logs/trpo_gae/CartPole-v1_1/CartPole-v1.zip").policy.state_dict()
    before = set(tmp_path.rglob("*"))

    cell = Cell("CartPole-v1", "adam", 0.9, 0.5, 3, 3, '{"n_envs": 2, "n_steps": 64}')
    experiment = Experiment(cell, Options())
    rows: list[Row] = []
    experiment.run(rows.append)
    assert set(tmp_path.rglob("*")) == before, "a cell leaves no files"
    assert [row["timesteps"] for row in rows] == [128, 256, 384]
    for name, tensor in experiment.model.policy.state_dict().items():
        assert th.equal(tensor, expected[name]), name
    assert experiment.settings["n_steps"] == 64


def test_rows_of_whole_episodes_are_those_of_the_batch() -> None:
    cell = Cell("GaeCartPole-v0", "trust_region", 0.9, 0.5, 0, 2, '{"n_envs": 3}')
    experiment = Experiment(cell, Options())
    rows: list[Row] = []
    returns: list[float] = []

    assert isinstance(experiment.model.env, MujocoVecEnv) and experiment.model.env.n_threads == 1
    update = experiment.model.train

    def train() -> None:
        buffer = experiment.model.rollout_buffer
        returns.append(float(buffer.rewards[buffer.mask].sum()) / 3)
        update()

    experiment.model.train = train  # type: ignore[method-assign]
    experiment.run(rows.append)
    assert all(list(row) == list(COLUMNS) for row in rows)
    assert [row["iteration"] for row in rows] == [1, 2]
    assert [row["episodes"] for row in rows] == [3, 3]
    # Other episodes end in the meantime, but their steps are not used
    assert [row["mean_return"] for row in rows] == pytest.approx(returns)
    assert experiment.model.num_timesteps - rows[-1]["timesteps"] <= 3, "it ends at the first step of the next batch"
    assert all(np.isfinite(row["explained_variance_after"]) and row["vf_steps"] >= 1 for row in rows)


def test_every_condition_runs() -> None:
    table = run_sweep(seeds=1, **GRID | {"conditions": list(CONDITIONS)}, progress=False)
    assert set(table["condition"]) == set(CONDITIONS)
    without = table[table["condition"] == "no_vf"]
    assert without["gae_lambda"].isna().all() and (without["lambda_used"] == 1.0).all()
    assert (table[table["condition"] == "trust_region"]["lambda_used"] == 0.5).all()


class CrewOfSize(LocalCrew):
    """Knows for how many CPUs it was asked."""

    def __init__(self, makers: Any, cpus_per_worker: int):
        self.cpus_per_worker = cpus_per_worker
        super().__init__(makers, cpus_per_worker)


@pytest.mark.parametrize(("batched", "of_worker"), [(True, MujocoVecEnv), (False, DummyVecEnv)])
def test_workers_of_a_cell_have_the_threads_that_it_may_use(
    batched: bool, of_worker: type, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sb3_gae.workers.ray_vec_env.Crew", CrewOfSize)
    overrides = {"n_envs": 4, "n_steps": 16, "n_episodes": None, "rollout_workers": 2, "batched_envs": batched}
    cell = Cell("GaeCartPole-v0", "trust_region", 0.9, 0.5, 0, 2, json.dumps(overrides))
    experiment = Experiment(cell, Options(threads=2))
    assert experiment.model.env is not None
    crew: Any = experiment.model.env.unwrapped._crew  # type: ignore[attr-defined]
    assert [type(worker._env) for worker in crew._workers] == [of_worker] * 2
    assert crew.cpus_per_worker == 2
    rows: list[Row] = []
    experiment.run(rows.append)
    assert [row["timesteps"] for row in rows] == [64, 128]


def test_a_failing_cell_is_recorded_and_the_others_go_on() -> None:
    Path("fail-1").touch()
    with pytest.warns(UserWarning, match="seed 1, 2 iterations failed: RuntimeError: the motor is broken"):
        table = run_sweep(seeds=3, **GRID, progress=False)
    assert sorted(table["seed"].unique()) == [0, 2]
    ((seed, outcome, reason),) = outcomes()
    assert (seed, outcome) == (1, Outcome.FAILED)
    assert reason.startswith("RuntimeError: the motor is broken [reset, sweep_task.py:") and "\n" not in reason
    with pytest.warns(UserWarning, match="failed"):
        run_sweep(seeds=3, **GRID, progress=False)
    assert runs() == [0, 1, 2], "neither what is done nor what failed is run again"
    Path("fail-1").unlink()
    table = run_sweep(seeds=3, **GRID, progress=False, retry_failed=True)
    assert sorted(table["seed"].unique()) == [0, 1, 2]
    assert runs() == [0, 1, 2, 1]


def test_a_task_that_ends_the_program_ends_its_cell() -> None:
    Path("exit-0").touch()
    with pytest.warns(UserWarning, match="seed 0, 2 iterations failed: SystemExit: no licence"):
        table = run_sweep(seeds=2, **GRID, progress=False)
    assert table["seed"].unique().tolist() == [1]


@pytest.mark.parametrize(("wrapper", "episodes"), [(Endless, 9), (functools.partial(TimeLimit, max_episode_steps=3), 0)])
def test_ends_that_a_wrapper_hides_or_makes(wrapper: Any, episodes: int) -> None:
    """`Monitor`, which is further inside, reports what has ended by its own count."""
    env = make_vec_env(AnySpacesEnv, 3, wrapper_class=wrapper)
    rows: list[Row] = []
    small_model(env, n_steps=16).learn(48, callback=Recorder(1, rows.append))
    assert [row["episodes"] for row in rows] == [episodes]


def test_results_carry_where_they_come_from() -> None:
    table = run_sweep(seeds=1, **GRID, progress=False)
    assert table["iteration"].tolist() == [1, 2]
    # Builds of torch differ in whether the package's version names the processor
    (torch_version,) = set(table["torch"])
    assert th.__version__.startswith(torch_version)
    assert json.loads(table["settings"][0]) | {"n_steps": 32, "gamma": 0.9, "batched_envs": True} == json.loads(
        table["settings"][0]
    )
    larger = run_sweep(seeds=2, **GRID, progress=False)
    assert len(larger) == 4 and runs() == [0, 1]
    pd.testing.assert_frame_equal(run_sweep(seeds=1, **GRID, progress=False), table)


@pytest.mark.parametrize(("number", "outcome"), [(signal.SIGKILL, Outcome.LOST), (signal.SIGTERM, Outcome.STOPPED)])
def test_a_sweep_that_was_ended_resumes(number: signal.Signals, outcome: Outcome) -> None:
    Path("hold-1").touch()
    process = start(3)
    wait_for_runs(2, process)
    process.send_signal(number)
    if number == signal.SIGKILL:
        finish(process, -signal.SIGKILL)
        Path("hold-1").unlink()
    else:
        Path("hold-1").unlink()
        assert "1 done" in finish(process, 130)
    table = run_sweep(seeds=3, **GRID, progress=False)
    assert runs() == [0, 1, 1, 2], "what was done is not run again, what was not begins anew"
    assert sorted(table["seed"]) == [0, 0, 1, 1, 2, 2]
    assert [(seed, found) for seed, found, _ in outcomes()] == [(1, outcome)]


def test_a_worker_that_is_killed_is_replaced() -> None:
    Path("hold-1").touch()
    sweep = threading.Thread(target=run_sweep, kwargs=dict(seeds=3, **GRID, jobs=2, progress=False))
    sweep.start()
    while 1 not in runs():
        assert sweep.is_alive()
        time.sleep(0.02)
    trials = SweepStudy("s", create=False).trials()
    (held,) = [trial for trial in trials if trial.user_attrs["cell"]["seed"] == 1]
    os.kill(held.user_attrs["sign_of_life"]["pid"], signal.SIGKILL)
    Path("hold-1").unlink()
    sweep.join()
    assert sorted(runs()) == [0, 1, 1, 2]
    assert [(seed, outcome) for seed, outcome, _ in outcomes()] == [(1, Outcome.LOST)]
    assert [standing.status for standing in SweepStudy("s").standings().values()] == [Status.DONE] * 3


@pytest.mark.parametrize(("n_killed", "ends"), [(2, False), (4, True)])
def test_processes_that_are_killed_before_they_have_a_cell_end_the_sweep_at_last(
    n_killed: int, ends: bool, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (folder / "deadly.py").write_text(DEADLY)
    Path("to-kill").write_text("x" * n_killed)
    # So that spawned processes find it
    monkeypatch.syspath_prepend(str(folder))
    grid = GRID | {"gym_packages": ["sweep_task", "deadly"]}
    with (
        pytest.raises(SweepError, match="3 processes in a row were killed by signal 9 before")
        if ends
        else contextlib.nullcontext()
    ):
        run_sweep(seeds=1, **grid, jobs=2, progress=False)
    assert runs() == ([] if ends else [0])
    assert len(Path("to-kill").read_text()) == n_killed - (3 if ends else 2)


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_ctrl_c_while_processes_start_prints_no_tracebacks() -> None:
    process = start(4, "--jobs", "2", own_group=True)
    until = time.monotonic() + 60.0
    while sum(map(is_worker_that_can_be_interrupted, children_of(process.pid))) < 2:
        assert process.poll() is None and time.monotonic() < until
        time.sleep(0.01)
    os.killpg(process.pid, signal.SIGINT)
    output = finish(process, 130)
    assert "Traceback" not in output and "KeyboardInterrupt" not in output
    assert runs() == []


def children_of(pid: int) -> list[int]:
    threads = Path(f"/proc/{pid}/task").glob("*/children")
    return [int(child) for thread in threads for child in thread.read_text().split()]


def is_worker_that_can_be_interrupted(pid: int) -> bool:
    """Python has begun, and imports."""
    try:
        command, status = (Path(f"/proc/{pid}/{name}").read_text() for name in ("cmdline", "status"))
    except OSError:
        return False
    if "spawn_main" not in command:
        return False
    caught = int(status.partition("SigCgt:")[2].split()[0], base=16)
    return bool(caught & 1 << (signal.SIGINT - 1))


def test_two_commands_share_a_grid() -> None:
    processes = [start(8), start(8)]
    outputs = [finish(process) for process in processes]
    assert sorted(runs()) == list(range(8)), "each cell is run once"
    table = SweepStudy("s", create=False).standings()
    assert [standing.status for standing in table.values()] == [Status.DONE] * 8
    assert any("8 done" in output for output in outputs)
    assert len(results_of(SweepStudy("s", create=False))) == 16


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"env": "SweepTsk-v0"}, "did you mean 'SweepTask-v0'?"),
        ({"gym_packages": ["no_such_module"]}, "no_such_module cannot be imported"),
        ({"silent_after": 0.0}, "`silent_after` must be a number of seconds above 0"),
        ({"jobs": 0}, "`jobs` must be a whole number of at least 1, got 0"),
        ({"threads": 0}, "`threads` must be a whole number of at least 1, got 0"),
        ({"device": "foo"}, "`device`: PyTorch cannot use 'foo' here"),
        ({"conf_file": "nowhere.yml"}, "no settings of SweepTask-v0 in nowhere.yml"),
        ({"hyperparams": {"n_step": 8}}, "did you mean 'n_steps'?"),
    ],
)
def test_what_cannot_be_run_is_refused_before_anything_is_stored(changes: dict[str, Any], message: str) -> None:
    import sweep_task  # noqa: F401

    with pytest.raises(SweepError) as error:
        run_sweep(seeds=1, **GRID | changes, progress=False)
    assert message in str(error.value) and "\n" not in str(error.value)
    assert not Path("logs").exists()


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_memory_that_a_cell_has_freed_goes_back_to_the_system() -> None:
    def resident_mib() -> float:
        return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize() / 2**20

    # Small enough for the heap, and every second one is kept, so that glibc gives nothing back by itself
    blocks = [bytearray(b"x" * 100_000) for _ in range(2_000)]
    del blocks[::2]
    before = resident_mib()
    return_freed_memory()
    assert resident_mib() < before - 50.0
