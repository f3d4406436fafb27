"""A whole node of Ray lost, with its workers, in the middle of a batch: several nodes on this machine, one of them killed."""

import os
import signal
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from envs_for_tests import SMALL, SlowEnv
from resuming import differences, everything
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_gae import TRPOGAE, RayVecEnv

ray = pytest.importorskip("ray", reason='Ray is not installed: pip install "sb3-gae[ray]"')
# Ray brings a copy, which is found from then on
import psutil  # noqa: E402
from ray.cluster_utils import Cluster, cluster_not_supported  # noqa: E402

pytestmark = pytest.mark.skipif(cluster_not_supported, reason="Ray has no clusters on this system")

STEPS = 2 * 32
# Of a node, with a place for one worker
NODE: dict[str, Any] = {"num_cpus": 1, "node_ip_address": "127.0.0.1", "object_store_memory": 80 * 2**20}
# Ray gives a node up that does not answer for longer than the test lasts: nothing may wait for that
PATIENT = {"health_check_failure_threshold": 1000}


@pytest.fixture
def cluster() -> Iterator[Any]:
    """Two nodes, one of which has this process."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        patch.setenv("PYTHONPATH", str(Path(__file__).parent), prepend=os.pathsep)
        # Ray would look for the nodes at the address of a network card, where they do not listen
        patch.setattr("ray._private.services.resolve_ip_for_localhost", lambda host: host)
        # Left by other tests
        ray.shutdown()
        nodes = start_cluster()
        yield nodes
        ray.shutdown()
        nodes.shutdown()


def start_cluster(attempts: int = 4) -> Any:
    """Ray gives its processes half a minute to start, which a busy machine may not have."""
    nodes = Cluster()
    try:
        nodes.add_node(**NODE, include_dashboard=False, _system_config=PATIENT)
        nodes.add_node(**NODE)
        ray.init(address=nodes.address, _node_ip_address=NODE["node_ip_address"])
    except Exception as error:
        ray.shutdown()
        nodes.shutdown()
        if attempts == 1 or "timed out" not in str(error).lower():
            raise
        return start_cluster(attempts - 1)
    return nodes


class KillDuring(BaseCallback):
    """
    Kills a node a moment after the second batch has begun.

    :param node: all its processes at once
    """

    def __init__(self, node: Any):
        super().__init__()
        self.pids = pids_of(node)

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        if self.num_timesteps == STEPS:
            threading.Timer(0.1, kill, [self.pids]).start()


def pids_of(node: Any) -> list[int]:
    """Workers are children of the node's main process."""
    parents = [psutil.Process(info.process.pid) for infos in node.all_processes.values() for info in infos]
    processes = parents + [child for parent in parents for child in parent.children(recursive=True)]
    assert any("RolloutWorker" in process.cmdline()[0] for process in processes), "no worker is on this node"
    return [process.pid for process in processes]


def kill(pids: list[int]) -> None:
    for pid in pids:
        os.kill(pid, signal.SIGKILL)


def trained(env: VecEnv, callback: BaseCallback | None = None) -> dict[str, Any]:
    model = TRPOGAE("MlpPolicy", VecNormalize(env), n_steps=STEPS // 2, policy_kwargs=SMALL, seed=3)
    return everything(model.learn(3 * STEPS, callback=callback))


def test_a_node_killed_in_the_middle_of_a_batch_changes_nothing(cluster: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    env = make_vec_env(SlowEnv, 2, vec_env_cls=RayVecEnv, vec_env_kwargs={"n_workers": 2})  # type: ignore[type-var]
    expected = trained(env)
    (to_lose,) = cluster.worker_nodes
    # Where the new worker has a place
    cluster.add_node(**NODE)
    put, weights = ray.put, []
    monkeypatch.setattr(ray, "put", lambda value: weights.append(value) or put(value))
    with pytest.warns(UserWarning, match=r"Worker . was lost .* another collects its share again"):
        found = trained(env, KillDuring(to_lose))
    assert differences(expected, found) == []
    # Once a batch and once more after the loss: Ray may have the new node ask the lost one for its copy of what both are sent
    assert len(weights) == 3 + 1
    env.close()
