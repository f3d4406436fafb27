"""Workers on Ray itself: the same training wherever they run, and what happens when they, or Ray, are killed."""

import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from envs_for_tests import SMALL, AnySpacesEnv, SlowEnv
from local_crew import LocalCrew
from resuming import differences, everything
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_gae import TRPOGAE, RayVecEnv, ResumableCheckpointCallback, WorkersLostError

ray = pytest.importorskip("ray", reason='Ray is not installed: pip install "sb3-gae[ray]"')

STEPS = 2 * 16


def start_ray(attempts: int = 4) -> None:
    """Ray gives its processes half a minute to start, which a busy machine may not have."""
    try:
        ray.init(num_cpus=4, include_dashboard=False, _node_ip_address="127.0.0.1", object_store_memory=80 * 2**20)
    except Exception as error:
        ray.shutdown()
        if attempts == 1 or "timed out during startup" not in str(error):
            raise
        start_ray(attempts - 1)


@pytest.fixture(scope="module", autouse=True)
def cluster() -> Iterator[None]:
    """Ray's processes take the folders of modules from the environment."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        patch.setenv("PYTHONPATH", str(Path(__file__).parent), prepend=os.pathsep)
        # Left by a document's code, without that folder
        ray.shutdown()
        start_ray()
        yield
        ray.shutdown()


@pytest.fixture(scope="module")
def workers(cluster: None) -> Iterator[VecEnv]:
    """Two, for all tests, since each takes seconds to start."""
    env = make_vec_env(SlowEnv, 2, vec_env_cls=RayVecEnv, vec_env_kwargs={"n_workers": 2})  # type: ignore[type-var]
    yield env
    env.close()


def make_model(env: VecEnv, **kwargs: Any) -> TRPOGAE:
    return TRPOGAE("MlpPolicy", VecNormalize(env), **({"n_steps": 16, "policy_kwargs": SMALL, "seed": 3} | kwargs))


def trained(env: VecEnv, callback: BaseCallback | None = None) -> dict[str, Any]:
    return everything(make_model(env).learn(3 * STEPS, callback=callback))


@pytest.fixture(scope="module")
def expected(workers: VecEnv) -> dict[str, Any]:
    return trained(workers)


class KillDuring(BaseCallback):
    """
    Kills a worker a moment after the second batch has begun.

    :param env: on workers
    :param worker: its number
    """

    def __init__(self, env: Any, worker: int):
        super().__init__()
        self.env, self.worker = env, worker

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        if self.num_timesteps == STEPS:
            threading.Timer(0.08, ray.kill, [self.env._crew._actors[self.worker]]).start()


def test_two_runs_are_the_same_and_those_of_workers_anywhere_else(
    workers: VecEnv, expected: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert differences(expected, trained(workers)) == []
    monkeypatch.setattr("sb3_gae.workers.ray_vec_env.Crew", LocalCrew)
    elsewhere = make_vec_env(SlowEnv, 2, vec_env_cls=RayVecEnv, vec_env_kwargs={"n_workers": 2})  # type: ignore[type-var]
    assert differences(expected, trained(elsewhere)) == []


def test_a_worker_killed_in_the_middle_of_its_share_changes_nothing(workers: VecEnv, expected: dict[str, Any]) -> None:
    with pytest.warns(UserWarning, match=r"Worker 1 was lost .* another collects its share again"):
        found = trained(workers, KillDuring(workers, 1))
    assert differences(expected, found) == []


def test_a_new_worker_that_is_lost_in_its_turn_changes_nothing(
    workers: Any, expected: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    go_on, lost = workers._go_on_where_it_stood, []

    def lose_once_and_go_on(worker: int) -> None:
        if not lost:
            lost.append(worker)
            ray.kill(workers._crew._actors[worker])
        go_on(worker)

    monkeypatch.setattr(workers, "_go_on_where_it_stood", lose_once_and_go_on)
    with pytest.warns(UserWarning, match="Worker 1 was lost") as warned:
        found = trained(workers, KillDuring(workers, 1))
    assert lost == [1]
    assert len([warning for warning in warned if "was lost" in str(warning.message)]) == 2
    assert differences(expected, found) == []


def test_what_the_last_batch_took_is_known(workers: Any, expected: dict[str, Any]) -> None:
    record = workers.last_collection
    assert 16 * 0.01 <= record.worker_seconds <= record.seconds
    n_weights = sum(
        np.asarray(value).size for name, value in expected.items() if name.startswith(("mlp_extractor", "action", "value"))
    )
    assert record.weights_bytes >= 4 * n_weights
    # Observations, actions and rewards in single precision, two flags
    assert record.shares_bytes == STEPS * (3 * 4 + 2 * 4 + 4 + 2) + 2 * 3 * 4
    assert record.states_bytes > 0


def test_environments_that_end_their_process_end_the_training_at_last(tmp_path: Path) -> None:
    class Crashing(AnySpacesEnv):
        def step(self, action: Any) -> Any:
            os._exit(1)

    env = make_vec_env(Crashing, 1, vec_env_cls=RayVecEnv, vec_env_kwargs={"n_workers": 1})  # type: ignore[type-var]
    checkpoints = ResumableCheckpointCallback(10**6, tmp_path)
    with (
        pytest.warns(UserWarning, match="Worker 0 was lost"),
        pytest.raises(WorkersLostError, match=r"lost 3 times with the same share .* continue with TRPOGAE\.resume"),
    ):
        make_model(env).learn(STEPS, callback=checkpoints)
    env.close()


@pytest.mark.parametrize("way", ["shut down", "killed"])
def test_without_ray_the_training_ends_with_a_checkpoint_that_can_be_continued(
    way: str, tmp_path: Path, expected: dict[str, Any]
) -> None:
    """Last, as nothing of the module's Ray is left."""

    class End(BaseCallback):
        def _on_step(self) -> bool:
            return True

        def _on_rollout_end(self) -> None:
            if self.num_timesteps == 2 * STEPS and way == "shut down":
                ray.shutdown()

        def _on_rollout_start(self) -> None:
            if self.num_timesteps == 2 * STEPS and way == "killed":
                threading.Timer(0.08, kill_all).start()

    def kill_all() -> None:
        # As if by `ray stop` or the end of the head's machine
        for processes in ray._private.worker._global_node.all_processes.values():
            for process in processes:
                process.process.kill()

    if not ray.is_initialized():
        start_ray()
    make_env = lambda: make_vec_env(SlowEnv, 2, vec_env_cls=RayVecEnv, vec_env_kwargs={"n_workers": 2})  # type: ignore[type-var]  # noqa: E731
    model = make_model(make_env())
    message = "Ray has been shut down" if way == "shut down" else "Ray at .* is gone"
    with pytest.raises(WorkersLostError, match=rf"{message}.*continue with TRPOGAE\.resume\('.*rl_model_64_steps\.zip'"):
        model.learn(3 * STEPS, callback=[ResumableCheckpointCallback(10**6, tmp_path), End()])
    start_ray()
    model = TRPOGAE.resume(tmp_path, VecNormalize(make_env()))
    model.learn(model.remaining_timesteps, reset_num_timesteps=False)
    assert differences(expected, everything(model)) == []


_WITHOUT_PARENT = """
import os, sys, time
from sb3_gae.workers.crew import import_ray

while os.getppid() == int(sys.argv[1]):
    time.sleep(0.01)
ray = import_ray()
ray.init(num_cpus=1, include_dashboard=False, _node_ip_address="127.0.0.1", object_store_memory=80 * 2**20)
for processes in ray._private.worker._global_node.all_processes.values():
    for process in processes:
        process.process.kill()
        process.process.wait()
ray.shutdown()
print("still here", flush=True)
"""


def test_a_process_whose_parent_has_ended_outlives_ray(tmp_path: Path) -> None:
    """Ray's own rule, by which it would end, is of workers; trainings of a container and after `nohup` begin that way."""
    script, output = tmp_path / "script.py", tmp_path / "output.txt"
    script.write_text(_WITHOUT_PARENT)
    output.touch()
    # A shell that starts it and ends
    shell = f'"{sys.executable}" "{script}" $$ > "{output}" 2>&1 &'
    env = {name: value for name, value in os.environ.items() if name != "RAY_RAYLET_PID"}
    subprocess.run(["sh", "-c", shell], check=True, env=env)
    deadline = time.monotonic() + 120.0
    while "still here" not in output.read_text() and time.monotonic() < deadline:
        time.sleep(0.2)
    assert "still here" in output.read_text(), output.read_text()
