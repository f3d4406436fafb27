"""Environments stepped in a batch take the same steps, bit for bit, as one at a time."""

import math
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from batched_and_single import (
    EARLY_ENDS,
    assert_same_step,
    assert_same_trajectories,
    both,
    every_task,
    functions,
    random_actions,
)
from gymnasium.wrappers import TimeLimit
from hypothesis import given, settings
from hypothesis import strategies as st
from pendulum_task import pendulums
from stable_baselines3.common.monitor import Monitor

from sb3_gae import MujocoVecEnv
from sb3_gae.envs import TASKS


@every_task
@pytest.mark.parametrize(("n_envs", "n_threads"), [(1, 1), (2, 1), (3, 2), (5, 2), (8, 3)])
def test_trajectories_are_those_of_single_environments(task_id: str, n_envs: int, n_threads: int) -> None:
    batched, dummy = both(functions(task_id, n_envs), n_threads)
    assert "truncated" in assert_same_trajectories(batched, dummy, n_steps=40)
    if EARLY_ENDS[task_id]:
        batched, dummy = both(functions(task_id, n_envs, **EARLY_ENDS[task_id]), n_threads)
        assert "terminated" in assert_same_trajectories(batched, dummy, n_steps=40)


@settings(max_examples=10)
@given(
    task_id=st.sampled_from(list(TASKS)),
    n_envs=st.integers(1, 6),
    n_threads=st.sampled_from([None, 1, 2, 4, 9]),
    max_episode_steps=st.integers(1, 9),
    seed=st.integers(0, 2**32 - 1),
)
def test_trajectories_are_the_same_whatever_the_sizes(
    task_id: str, n_envs: int, n_threads: int | None, max_episode_steps: int, seed: int
) -> None:
    environments = both(functions(task_id, n_envs, max_episode_steps), n_threads)
    assert len(assert_same_trajectories(*environments, n_steps=10, seed=seed)) >= n_envs


@every_task
def test_the_number_of_threads_changes_nothing(task_id: str) -> None:
    env_fns = functions(task_id, 7)
    assert assert_same_trajectories(MujocoVecEnv(env_fns, 1), MujocoVecEnv(env_fns, 4), n_steps=30)


@every_task
def test_environments_without_wrappers_never_end_by_time(task_id: str) -> None:
    never = {"largest_angle": math.inf, "largest_position": math.inf} if task_id == "GaeCartPole-v0" else {}
    batched, dummy = both([lambda: gym.make(task_id, **never).unwrapped] * 2)
    assert_same_trajectories(batched, dummy, n_steps=30)


def test_the_shortest_of_several_time_limits_counts() -> None:
    for outer, inner in ((4, 9), (9, 4)):

        def make(outer: int = outer, inner: int = inner) -> gym.Env:
            return Monitor(TimeLimit(gym.make("GaeBiped-v0", max_episode_steps=inner), outer))

        assert assert_same_trajectories(*both([make] * 2), n_steps=20) == ["truncated"] * 10


@pytest.mark.parametrize("frame_skip", [1, 2, 5])
@pytest.mark.parametrize("n_threads", [1, 2])
def test_a_task_of_one_s_own_with_several_physics_steps_in_a_step(pendulum: Path, frame_skip: int, n_threads: int) -> None:
    batched, dummy = both(pendulums(pendulum, 4, frame_skip=frame_skip), n_threads)
    assert batched.get_attr("dt") == [pytest.approx(0.005 * frame_skip)] * 4
    assert set(assert_same_trajectories(batched, dummy, n_steps=40)) == {"terminated", "truncated"}


def test_what_was_returned_is_not_changed_by_later_steps(pendulum: Path) -> None:
    batched, dummy = both(pendulums(pendulum, 3))
    rng = np.random.default_rng(0)
    steps = []
    for env in (batched, dummy):
        env.seed(0)
        env.reset()
    for _ in range(15):
        actions = random_actions(dummy, rng)
        steps.append((batched.step(actions), dummy.step(actions)))
    assert any(expected[2].any() for _, expected in steps)
    # Only now are the infos made
    for found, expected in steps:
        assert_same_step(found, expected)


def test_actions_may_be_changed_between_the_halves_of_a_step() -> None:
    one, other = (MujocoVecEnv(functions("GaeBiped-v0", 2), 1) for _ in range(2))
    actions = np.full((2, 10), 0.5, np.float32)
    for env in (one, other):
        env.seed(0)
        env.reset()
    one.step_async(actions)
    actions[:] = -1.0
    np.testing.assert_array_equal(one.step_wait()[0], other.step(np.full((2, 10), 0.5, np.float32))[0])
