"""Environments stepped in a batch, and the same ones one at a time: what the tests of batches compare."""

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from sb3_gae import MujocoVecEnv
from sb3_gae.envs import TASKS

EnvFns = list[Callable[[], gym.Env]]

# Under these a few random steps end an episode, which only the time limit would cut else
EARLY_ENDS: dict[str, dict[str, float]] = {
    "GaeCartPole-v0": {"largest_angle": 0.1},
    "GaeBiped-v0": {"lowest_height": 1.395},
    "GaeQuadruped-v0": {"lowest_height": 0.563},
    "GaeBipedStandup-v0": {},
}

every_task = pytest.mark.parametrize("task_id", TASKS)


def functions(task_id: str, n_envs: int, max_episode_steps: int = 12, **kwargs: Any) -> EnvFns:
    """As ``make_vec_env`` has them."""
    return [lambda: Monitor(gym.make(task_id, max_episode_steps=max_episode_steps, **kwargs))] * n_envs


def both(env_fns: EnvFns, n_threads: int | None = 1) -> tuple[MujocoVecEnv, DummyVecEnv]:
    """The batched environments and SB3's."""
    return MujocoVecEnv(env_fns, n_threads), DummyVecEnv(env_fns)


def random_actions(env: VecEnv, rng: np.random.Generator) -> np.ndarray:
    """Of the whole space, and a little beyond."""
    if isinstance(env.action_space, spaces.Discrete):
        return rng.integers(env.action_space.n, size=env.num_envs)
    return rng.uniform(-1.3, 1.3, (env.num_envs, *env.action_space.shape)).astype(np.float32)


def assert_same_info(found: dict[str, Any], expected: dict[str, Any]) -> None:
    """But for the time of day."""
    assert found.keys() == expected.keys()
    for key, value in expected.items():
        if key == "episode":
            assert {**found[key], "t": 0} == {**value, "t": 0}
        elif key == "terminal_observation":
            np.testing.assert_array_equal(found[key], value)
        else:
            assert found[key] == value, key
            assert type(found[key]) is type(value), key


def assert_same_step(found: Any, expected: Any) -> None:
    """Bit for bit."""
    for batched, single in zip(found[:3], expected[:3], strict=True):
        assert batched.dtype == single.dtype
        np.testing.assert_array_equal(batched, single)
    for batched, single in zip(found[3], expected[3], strict=True):
        assert_same_info(batched, single)


def assert_same_trajectories(batched: VecEnv, dummy: VecEnv, n_steps: int, seed: int = 0) -> list[str]:
    """
    Step both with the same actions.

    :return: how episodes ended
    """
    rng, endings = np.random.default_rng(seed), []
    for env in (batched, dummy):
        env.seed(seed)
    np.testing.assert_array_equal(batched.reset(), dummy.reset())
    for _ in range(n_steps):
        actions = random_actions(dummy, rng)
        expected = dummy.step(actions)
        assert_same_step(batched.step(actions), expected)
        done = [info["TimeLimit.truncated"] for info, over in zip(expected[3], expected[2], strict=True) if over]
        endings += ["truncated" if truncated else "terminated" for truncated in done]
    return endings
