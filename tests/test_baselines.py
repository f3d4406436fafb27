"""What the paper compares with: a baseline of time alone, and the value fit before the policy step."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from envs_for_tests import differing, small_model, state_of, train_once, vec_env
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_gae import TRPOGAE, GAERolloutBuffer
from sb3_gae.rollout.time_baseline import TimeBaseline, timesteps

BOX = spaces.Box(-1.0, 1.0, (1,))


class Recorded:
    """A stream of steps in some environments, cut into rollouts."""

    def __init__(self, rng: np.random.Generator, n_steps: int, n_envs: int, end_probability: float):
        self.rewards = rng.normal(size=(n_steps, n_envs))
        self.dones = rng.random((n_steps, n_envs)) < end_probability
        self.truncated = self.dones & (rng.random((n_steps, n_envs)) < 0.5)
        self.starts = np.concatenate([np.ones((1, n_envs), dtype=bool), self.dones[:-1]])

    def rollout(self, start: int, end: int) -> GAERolloutBuffer:
        buffer = GAERolloutBuffer(end - start, BOX, BOX, "cpu", gae_lambda=1.0, gamma=0.9, n_envs=self.rewards.shape[1])
        zeros = np.zeros((buffer.n_envs, 1), dtype=np.float32)
        for t in range(start, end):
            buffer.add_step(zeros, zeros, self.rewards[t], self.starts[t], self.dones[t], self.truncated[t])
        return buffer


def elapsed_at(recorded: Recorded, t: int, env: int) -> int:
    steps = 0
    while not recorded.starts[t - steps, env]:
        steps += 1
    return steps


def expected_returns(recorded: Recorded, start: int, end: int, before: dict[int, float]) -> np.ndarray:
    """By definition: each reward to the end of the episode or the rollout, then the former mean for what was cut."""
    returns = np.zeros((end - start, recorded.rewards.shape[1]))
    for env in range(returns.shape[1]):
        for t in range(start, end):
            total, discount, step = 0.0, 1.0, t
            while True:
                total += discount * recorded.rewards[step, env]
                discount *= 0.9
                is_cut = recorded.truncated[step, env] or (step == end - 1 and not recorded.dones[step, env])
                if is_cut:
                    total += discount * before.get(elapsed_at(recorded, step, env) + 1, 0.0)
                if is_cut or recorded.dones[step, env]:
                    break
                step += 1
            returns[t - start, env] = total
    return returns


@settings(deadline=None, max_examples=40)
@given(
    seed=st.integers(0, 2**32 - 1),
    n_steps=st.integers(1, 9),
    n_envs=st.integers(1, 4),
    end_probability=st.sampled_from([0.0, 0.3, 1.0]),
)
def test_the_baseline_is_the_mean_return_at_each_timestep(
    seed: int, n_steps: int, n_envs: int, end_probability: float
) -> None:
    """Over three rollouts, so that episodes go on from one into the next."""
    recorded = Recorded(np.random.default_rng(seed), 3 * n_steps, n_envs, end_probability)
    baseline, before = TimeBaseline(), dict[int, float]()
    for start in range(0, 3 * n_steps, n_steps):
        end = start + n_steps
        buffer = recorded.rollout(start, end)
        last_values = baseline.fill(buffer, recorded.dones[end - 1], gamma=0.9)
        returns = expected_returns(recorded, start, end, before)
        steps = np.array([[elapsed_at(recorded, t, env) for env in range(n_envs)] for t in range(start, end)])
        means = {step: float(returns[steps == step].mean()) for step in np.unique(steps).tolist()}
        expected = np.vectorize(means.get)(steps)
        np.testing.assert_allclose(buffer.values, expected, rtol=1e-4, atol=1e-5)
        buffer.compute_returns_and_advantage(th.as_tensor(last_values), recorded.dones[end - 1])
        np.testing.assert_allclose(buffer.advantages, returns - expected, rtol=1e-4, atol=1e-5)
        before = means


def test_timesteps_go_on_over_the_seam_of_two_rollouts() -> None:
    starts = np.array([[False, True], [False, False], [True, False]])
    assert timesteps(starts, np.array([5, 7])).tolist() == [[5, 0], [6, 1], [0, 2]]


def test_steps_outside_the_batch_are_left_out() -> None:
    recorded = Recorded(np.random.default_rng(0), 6, 3, 0.5)
    whole, masked = recorded.rollout(0, 6), recorded.rollout(0, 6)
    masked.mask[:, 2] = False
    two = Recorded(np.random.default_rng(0), 6, 3, 0.5)
    for name in ("rewards", "dones", "truncated", "starts"):
        setattr(two, name, getattr(two, name)[:, :2])
    expected = two.rollout(0, 6)
    TimeBaseline().fill(expected, two.dones[-1], 0.9)
    for buffer in (whole, masked):
        TimeBaseline().fill(buffer, recorded.dones[-1], 0.9)
    np.testing.assert_array_equal(masked.values[:, :2], expected.values)
    assert not np.array_equal(whole.values[:, :2], expected.values)


# In training


def test_without_a_value_function_none_is_fitted() -> None:
    model = small_model(vec_env(), baseline="time")
    before = state_of(model.policy)
    log = train_once(model)
    moved = differing(before, state_of(model.policy))
    assert moved
    assert not [name for name in moved if "value" in name]
    assert "train/vf_steps" not in log
    assert log["train/explained_variance"] == log["train/explained_variance_after"]


@pytest.mark.parametrize("setting", ["gae_lambda", "value_lambda"])
def test_lambda_has_no_part_in_the_baseline_of_time(setting: str) -> None:
    states = []
    for value in (0.0, 0.9):
        model = small_model(vec_env(), baseline="time", **{setting: value})
        train_once(model)
        states.append(state_of(model.policy))
    assert differing(*states) == []


def test_advantages_of_whole_episodes_have_mean_0_at_each_timestep() -> None:
    model = small_model(vec_env(n_envs=4), n_steps=600, n_episodes=2, baseline="time")
    train_once(model)
    buffer = model.rollout_buffer
    steps = timesteps(buffer.episode_starts, np.zeros(4, dtype=int))
    for step in range(steps[buffer.mask].max() + 1):
        assert abs(buffer.advantages[buffer.mask & (steps == step)].mean()) < 1e-4


def test_a_value_function_fitted_first_is_the_one_behind_the_advantages() -> None:
    logs, spread = [], []
    for first in (False, True):
        settings_ = {"vf_steps": 30, "vf_cg_damping": 0.01, "gae_lambda": 1.0, "policy_kwargs": {"net_arch": [128]}}
        model = small_model(vec_env(n_envs=4), n_steps=64, value_fit_first=first, **settings_)
        logs.append(train_once(model))
        buffer = model.rollout_buffer
        values = model.policy.predict_values(buffer.batch().observations).detach().numpy().reshape(buffer.values.shape)
        assert np.allclose(buffer.values, values, atol=1e-4) is first
        spread.append(buffer.advantages.std())
    # The paper's warning: a value function that has seen the batch takes the advantages towards zero
    assert spread[1] < 0.95 * spread[0]
    assert logs[1]["train/explained_variance"] == pytest.approx(logs[0]["train/explained_variance"])


@pytest.mark.parametrize(("name", "value"), [("baseline", "none"), ("value_fit_first", 2), ("value_fit_first", "yes")])
def test_bad_choices_are_refused(name: str, value: Any) -> None:
    with pytest.raises(ValueError, match=f"`{name}` must be one of"):
        small_model(vec_env(), **{name: value})


@pytest.mark.parametrize("other", [{"value_fit_first": True}, {"gae_lambda": "auto"}, {"gae_lambda": lambda progress: 0.9}])
def test_what_a_baseline_of_time_has_no_part_for_is_refused(other: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="`baseline` = 'time' has neither"):
        small_model(vec_env(), baseline="time", **other)


def test_the_baseline_goes_on_after_saving_and_loading(tmp_path: Path) -> None:
    model = small_model(vec_env(), baseline="time")
    train_once(model)
    model.save(tmp_path / "model")
    loaded = TRPOGAE.load(tmp_path / "model", env=vec_env())
    assert loaded.baseline == "time"
    assert loaded._time_baseline._means.tolist() == model._time_baseline._means.tolist()
    assert train_once(loaded)["train/is_line_search_success"] == 1.0
