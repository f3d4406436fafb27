"""Physics whose numbers blow up in one environment of a batch."""

import warnings
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from batched_and_single import EnvFns, assert_same_step, assert_same_trajectories, both, random_actions
from gymnasium.wrappers import TimeLimit
from pendulum_task import PENDULUM, PendulumTask, pendulums
from stable_baselines3.common.monitor import Monitor

from sb3_gae import MujocoVecEnv
from sb3_gae.envs import TASKS, MujocoTaskEnv, PhysicsStates


@pytest.mark.filterwarnings("ignore:The physics of an environment")
def test_a_blow_up_leaves_the_other_environments_untouched(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its warnings to a file
    for task_id in TASKS:
        keyword = "alive_bonus" if task_id != "GaeBipedStandup-v0" else "torque_cost"
        env_fns: EnvFns = [
            lambda task_id=task_id, keyword=keyword: Monitor(gym.make(task_id), info_keywords=(keyword,))  # type: ignore[misc]
        ] * 4
        batched, dummy = both(env_fns, 2)
        untouched = MujocoVecEnv(env_fns, 1)
        for env in (batched, dummy, untouched):
            env.seed(0)
            env.reset()
        nq, nv = batched.task.model.nq, batched.task.model.nv
        for env in (batched, dummy):
            env.env_method("set_state", np.full(nq, 0.5), np.full(nv, 1e11), indices=2)
        rng, others = np.random.default_rng(0), [0, 1, 3]
        for step in range(4):
            actions = random_actions(dummy, rng)
            found, expected = batched.step(actions), untouched.step(actions)
            assert_same_step(found, dummy.step(actions))
            for i in range(3):
                np.testing.assert_array_equal(found[i][others], expected[i][others])
            if step == 0:
                observations, rewards, dones, infos = found
                assert (rewards[2], dones[2]) == (0.0, True)
                assert infos[2]["numerical_failure"] is True
                assert infos[2]["TimeLimit.truncated"] is True
                assert infos[2][keyword] == infos[2]["episode"][keyword] == 0.0
                assert np.isfinite(infos[2]["terminal_observation"]).all()
                assert not any("numerical_failure" in infos[env] for env in others)
                assert np.abs(observations[2]).max() < 10.0, "it begins anew"
        assert batched.numerical_failures == 1


def test_blow_ups_are_counted_and_warned_of_once(pendulum: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    env = MujocoVecEnv(pendulums(pendulum, 3, frame_skip=2, push=1e11), 1)
    env.reset()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for _ in range(5):
            _, rewards, dones, infos = env.step(np.zeros((3, 1)))
            assert dones.all()
            assert not rewards.any()
            assert [info["episode"]["l"] for info in infos] == [1] * 3
    assert env.numerical_failures == 15
    assert [str(warning.message).split(";")[0] for warning in caught] == [
        "The physics of an environment gave numbers that are not finite"
    ]


class SensingPendulumTask(PendulumTask):
    def observations(self, states: PhysicsStates) -> np.ndarray:
        return np.concatenate([states.sensors["angle"], states.qvel], axis=1)


@pytest.mark.filterwarnings("ignore:The physics of an environment")
@pytest.mark.parametrize("frame_skip", [1, 2, 3])
@pytest.mark.parametrize("gear", [3e7, 3e10, 3e13])
def test_a_blow_up_is_the_same_one_at_a_time(
    pendulum: Path, frame_skip: int, gear: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where only an acceleration is too large for MuJoCo, after which a batch takes no more physics steps."""
    monkeypatch.chdir(tmp_path)
    pendulum.write_text(PENDULUM.replace('joint="hinge" ctrl', f'joint="hinge" gear="{gear}" ctrl'))
    env_fns: EnvFns = [lambda: Monitor(TimeLimit(MujocoTaskEnv(SensingPendulumTask(pendulum, frame_skip)), 10))] * 3
    batched, dummy = both(env_fns)
    assert_same_trajectories(batched, dummy, n_steps=12)
    if gear > 1e10 and frame_skip > 1:
        assert batched.numerical_failures > 0
