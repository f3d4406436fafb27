"""Statistics merged from parts are those of the whole."""

import numpy as np
import pytest
from envs_for_tests import AnySpacesEnv
from hypothesis import given
from hypothesis import strategies as st
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_gae.workers import moments
from sb3_gae.workers.moments import Moments, RunningMoments
from sb3_gae.workers.wrappers import running_returns


@given(st.lists(st.integers(1, 40), min_size=1, max_size=6), st.integers(0, 2**31), st.sampled_from([0.0, 1e3, -1e6]))
def test_merging_parts_gives_the_statistics_of_the_whole(sizes: list[int], seed: int, offset: float) -> None:
    rng = np.random.default_rng(seed)
    parts = [offset + rng.normal(rng.normal(), 1.0, (size, 3)) for size in sizes]
    whole = np.concatenate(parts)
    merged = Moments.of(parts[0])
    for part in parts[1:]:
        merged = merged.merged(Moments.of(part))
    exact = whole.astype(np.longdouble)
    assert merged.n_rows == len(whole)
    np.testing.assert_allclose(merged.mean, exact.mean(axis=0).astype(float), rtol=1e-14, atol=1e-14)
    np.testing.assert_allclose(merged.squares / merged.n_rows, exact.var(axis=0).astype(float), rtol=1e-9, atol=1e-12)


def test_rows_that_come_a_few_at_a_time_are_all_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(moments, "_BLOCK", 10)
    rows = np.random.default_rng(0).normal(size=(47, 2)).astype(np.float32)
    running = RunningMoments()
    for start in range(0, 47, 4):
        running.add(rows[start : start + 4])
    whole = Moments.of(rows)
    assert running.total().n_rows == 47
    np.testing.assert_allclose(running.total().mean, whole.mean, rtol=1e-13)
    np.testing.assert_allclose(running.total().squares, whole.squares, rtol=1e-13)


def test_statistics_of_vec_normalize_take_a_batch_at_once() -> None:
    rows = np.random.default_rng(1).normal(3.0, 2.0, (50, 4))
    at_once, one_by_one = RunningMeanStd(shape=(4,)), RunningMeanStd(shape=(4,))
    Moments.of(rows[:20]).merged(Moments.of(rows[20:])).add_to(at_once)
    for row in rows:
        one_by_one.update(row[None])
    np.testing.assert_allclose(at_once.mean, one_by_one.mean, rtol=1e-12)
    np.testing.assert_allclose(at_once.var, one_by_one.var, rtol=1e-12)
    assert at_once.count == pytest.approx(one_by_one.count)


def test_running_returns_are_those_of_vec_normalize() -> None:
    env = VecNormalize(DummyVecEnv([AnySpacesEnv] * 2), gamma=0.9)
    env.reset()
    rewards, starts, expected = [], [np.ones(2, dtype=bool)], []
    update = env._update_reward
    env._update_reward = lambda reward: (update(reward), expected.append(env.returns.copy()))  # type: ignore[assignment]
    for _ in range(12):
        *_, dones, _ = env.step(np.zeros((2, 2), dtype=np.float32))
        rewards.append(env.get_original_reward())
        starts.append(dones)
    found = running_returns(np.stack(rewards), np.stack(starts[:-1]), np.zeros(2), 0.9)
    np.testing.assert_array_equal(found, np.stack(expected))
