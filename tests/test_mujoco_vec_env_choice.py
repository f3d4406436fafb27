"""Which environments can be stepped in a batch, and the refusal of those that cannot."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from batched_and_single import functions
from gymnasium.wrappers import ClipAction
from pendulum_task import PENDULUM, PendulumTask, pendulums
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_gae import MujocoVecEnv
from sb3_gae.envs import MujocoTaskEnv
from sb3_gae.envs.cart_pole import GaeCartPoleEnv
from sb3_gae.vec_env.choice import batched_vec_env
from sb3_gae.vec_env.mujoco_vec_env import can_batch


def test_an_environment_of_another_kind_is_refused() -> None:
    with pytest.raises(ValueError, match=r"MujocoTask, got .*CartPole.*; use DummyVecEnv"):
        MujocoVecEnv([lambda: gym.make("CartPole-v1")])


def test_a_wrapper_that_would_have_to_see_each_step_is_refused() -> None:
    with pytest.raises(ValueError, match="wrapper ClipAction; use DummyVecEnv, or leave it out"):
        MujocoVecEnv([lambda: Monitor(ClipAction(gym.make("GaeBiped-v0")))])


@pytest.mark.parametrize("other", [("GaeQuadruped-v0", {}), ("GaeBiped-v0", {"alive_bonus": 1.0}), ("GaeBipedStandup-v0", {})])
def test_environments_that_differ_are_refused(other: tuple[str, dict[str, float]]) -> None:
    with pytest.raises(ValueError, match="one task with the same arguments"):
        MujocoVecEnv([lambda: gym.make("GaeBiped-v0"), lambda: gym.make(other[0], **other[1])])


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ((1.0,), (2.0,)),
        ([1.0, 2.0], [1.0]),
        (np.array([1.0]), np.array([2.0])),
        (np.float32(1.0), np.float32(2.0)),
        ({"a": 1}, {"a": 2}),
        ({"a": 1}, {"b": 1}),
        (1, 1.5),
        (None, 0),
    ],
)
def test_settings_of_any_kind_are_compared(pendulum: Path, one: Any, other: Any) -> None:
    same = [lambda: MujocoTaskEnv(PendulumTask(pendulum, goal=one))] * 2
    MujocoVecEnv(same)
    different = [*same, lambda: MujocoTaskEnv(PendulumTask(pendulum, goal=other))]
    with pytest.raises(ValueError, match="one task with the same arguments"):
        MujocoVecEnv(different)
    assert type(batched_vec_env(same)) is MujocoVecEnv
    assert type(batched_vec_env(different)) is DummyVecEnv


class MoreReward(GaeCartPoleEnv):
    def step(self, action: Any) -> Any:
        observation, reward, *others = super().step(action)
        return observation, reward + 100.0, *others


class GenerousMonitor(Monitor):
    def step(self, action: Any) -> Any:
        observation, reward, *others = super().step(action)
        return observation, reward + 100.0, *others


class NamedMonitor(Monitor):
    """With steps of its base."""


@pytest.mark.parametrize(
    ("make", "batched"),
    [
        (MoreReward, False),
        (lambda: GenerousMonitor(gym.make("GaeCartPole-v0")), False),
        (lambda: NamedMonitor(gym.make("GaeCartPole-v0")), True),
    ],
)
def test_steps_of_one_s_own_are_not_passed_by(make: Callable[[], gym.Env], batched: bool) -> None:
    env = batched_vec_env([make] * 2)
    assert type(env) is (MujocoVecEnv if batched else DummyVecEnv)
    env.reset()
    assert env.step(np.zeros(2, dtype=int))[1].tolist() == [1.0 if batched else 101.0] * 2
    if not batched:
        with pytest.raises(ValueError, match="use DummyVecEnv"):
            MujocoVecEnv([make])


def test_models_that_differ_are_refused(pendulum: Path) -> None:
    heavier = pendulum.with_name("heavier.xml")
    heavier.write_text(PENDULUM.replace('mass="1"', 'mass="2"'))
    with pytest.raises(ValueError, match="one task with the same arguments"):
        MujocoVecEnv(pendulums(pendulum, 1) + pendulums(heavier, 1))


def test_one_environment_given_twice_is_refused() -> None:
    env = gym.make("GaeBiped-v0")
    for env_fns in ([], [lambda: env] * 2):
        with pytest.raises(ValueError, match="`env_fns` must make at least one environment, and a new one each"):
            MujocoVecEnv(env_fns)


def test_no_environment_at_all_is_refused() -> None:
    with pytest.raises(ValueError, match="`env_fns` must make at least one environment"):
        batched_vec_env([])


@pytest.mark.parametrize("n_threads", [0, -1, 1.5])
def test_a_number_of_threads_that_is_none_is_refused(n_threads: Any) -> None:
    with pytest.raises(ValueError, match=f"`n_threads` must be a whole number of at least 1, got {n_threads}"):
        MujocoVecEnv(functions("GaeBiped-v0", 2), n_threads)


CHOICES: dict[str, tuple[Callable[[], gym.Env], bool]] = {
    "task": (lambda: gym.make("GaeBiped-v0"), True),
    "monitored task": (lambda: Monitor(gym.make("GaeBiped-v0")), True),
    "bare task": (lambda: gym.make("GaeBiped-v0").unwrapped, True),
    "wrapped task": (lambda: ClipAction(gym.make("GaeBiped-v0")), False),
    "other environment": (lambda: gym.make("CartPole-v1"), False),
}


@pytest.mark.parametrize("what", CHOICES)
def test_environments_are_stepped_in_batches_where_that_is_possible(what: str) -> None:
    make, batched = CHOICES[what]
    assert can_batch(make()) is batched
    env = batched_vec_env([make] * 2)
    assert type(env) is (MujocoVecEnv if batched else DummyVecEnv)
    env.reset()
    env.step(np.stack([env.action_space.sample() for _ in range(2)]))
