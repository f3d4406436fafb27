"""What every environment must keep to, on every one of the paper's tasks."""

import math
import warnings
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env as check_gymnasium_env
from stable_baselines3.common.env_checker import check_env as check_sb3_env
from task_facts import (
    CONTINUOUS,
    FACTS,
    every_task,
    make,
    random_action,
    rollout,
)


@every_task
def test_checkers_find_nothing(task_id: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # Positions and velocities have no bounds
        warnings.filterwarnings("ignore", message=".*Box observation space (minimum|maximum) value is -?infinity")
        check_gymnasium_env(make(task_id), skip_render_check=True)
        check_sb3_env(make(task_id), warn=True, skip_render_check=True)


@every_task
@pytest.mark.parametrize("how", ["random", "lowest", "highest", "alternating"])
def test_observations_and_rewards_are_finite_whatever_is_done(task_id: str, how: str) -> None:
    env, rng = gym.make(task_id), np.random.default_rng(0)
    discrete = isinstance(env.action_space, spaces.Discrete)
    low, high = (0, 1) if discrete else (env.action_space.low, env.action_space.high)
    over = True
    for step in range(300):
        if over or step % 100 == 99:
            observation, _ = env.reset(seed=step)
            assert np.isfinite(observation).all()
        actions = {"random": random_action(env, rng), "lowest": low, "highest": high, "alternating": (low, high)[step % 2]}
        observation, reward, terminated, truncated, info = env.step(actions[how])
        assert env.observation_space.contains(observation)
        assert np.isfinite(observation).all()
        assert math.isfinite(reward)
        assert "numerical_failure" not in info
        over = terminated or truncated


@pytest.mark.parametrize("task_id", CONTINUOUS)
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_actions_beyond_the_bounds_are_cut_to_them(task_id: str, sign: float) -> None:
    results = []
    for size in (1.0, 1e6):
        env = make(task_id)
        env.reset(seed=0)
        results.append([env.step(np.full(env.action_space.shape, sign * size, np.float32))[:2] for _ in range(20)])
    for (bounded, bounded_reward), (huge, huge_reward) in zip(*results, strict=True):
        np.testing.assert_array_equal(bounded, huge)
        assert bounded_reward == huge_reward


@every_task
def test_actions_do_something(task_id: str) -> None:
    ends_at = []
    for action in (0, 1):
        env = make(task_id)
        env.reset(seed=0)
        discrete = isinstance(env.action_space, spaces.Discrete)
        for _ in range(5):
            observation, *_ = env.step(action if discrete else np.full(env.action_space.shape, action, np.float32))
        ends_at.append(observation)
    # The last velocities are those of the joints that have motors, or of cart and pole
    n_joints = len(FACTS[task_id].gears) or 2
    assert (np.abs(ends_at[0] - ends_at[1])[-n_joints:] > 1e-3).all()


@every_task
def test_a_seed_decides_the_trajectory(task_id: str) -> None:
    first = rollout(gym.make(task_id), seed=3)
    np.testing.assert_array_equal(first, rollout(gym.make(task_id), seed=3))
    env = gym.make(task_id)
    rollout(env, seed=8)
    np.testing.assert_array_equal(first, rollout(env, seed=3), "whatever was before it")


@every_task
def test_seeds_and_resets_differ(task_id: str) -> None:
    env = make(task_id)
    starts = [env.reset(seed=seed)[0] for seed in (0, 1, 2)] + [env.reset()[0] for _ in range(3)]
    assert len({start.tobytes() for start in starts}) == len(starts)


@every_task
def test_no_observation_is_constant(task_id: str) -> None:
    """Within one episode, so that random starts hide nothing."""
    env, rng = make(task_id), np.random.default_rng(0)
    rows = [env.reset(seed=0)[0], *[env.step(random_action(env, rng))[0] for _ in range(15)]]
    assert (np.ptp(rows, axis=0) > 1e-3).all()


@every_task
def test_what_was_returned_is_not_changed_by_the_next_step(task_id: str) -> None:
    env, rng = make(task_id), np.random.default_rng(0)
    first, _ = env.reset(seed=0)
    second, _, _, _, info = env.step(random_action(env, rng))
    kept = first.copy(), second.copy(), dict(info)
    env.step(random_action(env, rng))
    np.testing.assert_array_equal(first, kept[0])
    np.testing.assert_array_equal(second, kept[1])
    assert info == kept[2]


@every_task
def test_numbers_that_blow_up_cut_the_episode(task_id: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its warnings to a file
    env, rng = make(task_id), np.random.default_rng(0)
    env.reset(seed=0)
    terms = set(env.step(random_action(env, rng))[4])
    huge = np.full(env.model.nv, 1e11)
    env.set_state(env.data.qpos.copy(), huge)
    observation, reward, terminated, truncated, info = env.step(random_action(env, rng))
    assert (reward, terminated, truncated) == (0.0, False, True)
    assert info == dict.fromkeys(terms, 0.0) | {"numerical_failure": True}
    assert np.isfinite(observation).all()
    np.testing.assert_array_equal(observation[env.model.nq :], huge, "the state before is the last one")

    env.reset(seed=0)
    fresh = make(task_id)
    fresh.reset(seed=0)
    action = random_action(env, rng)
    for found, expected in zip(env.step(action), fresh.step(action), strict=True):
        np.testing.assert_array_equal(found, expected, "nothing is left of it")


@pytest.mark.parametrize("task_id", CONTINUOUS)
def test_an_action_that_is_not_a_number_does_not_reach_the_state(
    task_id: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    env = make(task_id)
    env.reset(seed=0)
    observation, *_ = env.step(np.full(env.action_space.shape, np.nan, np.float32))
    assert np.isfinite(observation).all()
