"""Value errors and delayed signals against sums step by step, and beside the exact gridworld."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from oracles import Rollout, direct_advantages, rollouts
from tabular_oracles import random_policy

from sb3_gae.estimators.measures import explained_variance, value_errors
from sb3_gae.estimators.response import lagged_signal, tabular_response
from sb3_gae.estimators.trajectory_groups import trajectory_indices
from sb3_gae.gridworld import episode_deltas, gridworld, response_function, sample_episodes

factors = st.one_of(st.sampled_from([0.0, 1.0, 0.99]), st.floats(0.0, 1.0))


@given(rollouts(scales=[1.0]), factors, st.booleans())
def test_value_errors_are_their_definitions(rollout: Rollout, gamma: float, masked: bool) -> None:
    mask = np.ones_like(rollout.dones)
    if masked:
        mask[-1, 0] = len(mask) == 1
    residuals = direct_advantages(rollout, gamma, 1.0)[mask]
    errors = value_errors(rollout.rewards, rollout.values, rollout.next_values, rollout.dones, gamma, mask)
    values = rollout.values.astype(np.float64)
    assert errors.monte_carlo_error == pytest.approx(np.mean(residuals**2), rel=1e-9, abs=1e-12)
    assert errors.td_error == pytest.approx(np.mean(direct_advantages(rollout, gamma, 0.0)[mask] ** 2), rel=1e-9, abs=1e-12)
    np.testing.assert_allclose(
        errors.explained_variance, explained_variance(values[mask], values[mask] + residuals), rtol=1e-6, atol=1e-6
    )


@pytest.mark.parametrize("gamma", [0.9, 1.0])
def test_value_errors_of_the_gridworld_are_the_exact_ones_on_average(gamma: float) -> None:
    policy = random_policy(gridworld(), 2)
    values = np.where(policy.mdp.terminal, 0.0, np.random.default_rng(0).normal(size=25))
    actual = []
    for seed in range(40):
        episodes = sample_episodes(policy, 100, np.random.default_rng(seed))
        arrays = episodes.rewards, values[episodes.states], values[episodes.next_states], episodes.dones
        actual.append(value_errors(*arrays, gamma, episodes.mask)[1:])
    # Squared residuals, and returns less values, are squared advantages at the ends of lambda
    exact = []
    for gae_lambda in (1.0, 0.0):
        moments = policy.gradient_moments(values, gamma, gae_lambda)
        squares = policy.over_actions(moments.advantage_variance + np.square(moments.advantage_mean))
        exact.append(policy.visits @ squares / policy.mean_length)
    # A ratio of sums over random lengths is biased a little
    limits = 4.0 * np.std(actual, axis=0) / np.sqrt(len(actual)) + 0.01 * np.array(exact)
    assert (np.abs(np.mean(actual, axis=0) - exact) < limits).all()


@given(st.integers(0, 1000), st.integers(1, 8), st.integers(1, 3), st.integers(1, 10), st.booleans())
def test_lagged_signals_step_by_step(seed: int, n_steps: int, n_envs: int, n_lags: int, whole: bool) -> None:
    generator = np.random.default_rng(seed)
    signal, dones = generator.normal(size=(n_steps, n_envs)), generator.uniform(size=(n_steps, n_envs)) < 0.4
    if whole:
        dones[-1] = True
    lagged, known = lagged_signal(signal, dones, n_lags)
    trajectories, is_cut = trajectory_indices(dones), not dones[-1].all()
    for lag, t, n in np.ndindex(*lagged.shape):
        assert known[lag, t, n] == (not is_cut or t + lag < n_steps)
        inside = t + lag < n_steps and trajectories[t + lag, n] == trajectories[t, n]
        assert lagged[lag, t, n] == (signal[t + lag, n] if inside and known[lag, t, n] else 0.0)


def test_lags_do_not_reach_into_what_does_not_belong_to_the_batch() -> None:
    signal, dones = np.ones((5, 2)), np.zeros((5, 2), dtype=bool)
    dones[2, 0] = dones[4, 1] = dones[0, 1] = True
    mask = np.ones_like(dones)
    mask[3:, 0] = False
    lagged, known = lagged_signal(signal, dones, 3, mask)
    assert lagged[:, :, 0].tolist() == [[1, 1, 1, 0, 0], [1, 1, 0, 0, 0], [1, 0, 0, 0, 0]]
    assert lagged[:, :, 1].tolist() == [[1, 1, 1, 1, 1], [0, 1, 1, 1, 0], [0, 1, 1, 0, 0]]
    np.testing.assert_array_equal(known, np.repeat(mask[None], 3, axis=0))


@pytest.mark.parametrize("shaped", [False, True])
def test_response_of_the_gridworld_approaches_the_exact_one(shaped: bool) -> None:
    policy, gamma = random_policy(gridworld(), 2), 0.95
    values = np.random.default_rng(0).normal(size=25)
    episodes = sample_episodes(policy, 4000, np.random.default_rng(1))
    signal = episode_deltas(policy, episodes, values, gamma) if shaped else episodes.rewards
    lagged, known = lagged_signal(signal, episodes.dones, 6, episodes.mask)
    estimate = tabular_response(lagged, known, episodes.states, episodes.actions)
    exact = response_function(policy, 6, values, gamma) if shaped else response_function(policy, 6)
    visits = np.zeros((25, 4))
    np.add.at(visits, (episodes.states[episodes.mask], episodes.actions[episodes.mask]), 1)
    seen = visits[: estimate.shape[1]] > 300
    assert seen.sum() > 40
    # A mean over n visits is off by about the signal's deviation over the root of n
    limits = 5.0 * (signal[episodes.mask].std() + 0.3) / np.sqrt(visits[: estimate.shape[1]][seen])
    assert (np.abs(estimate - exact[:, : estimate.shape[1]])[:, seen] < limits).all()
    assert np.isnan(tabular_response(lagged[:, :1], known[:, :1], episodes.states[:1], episodes.actions[:1])).any()


def test_refuses_no_lags() -> None:
    with pytest.raises(ValueError, match="`n_lags` must be a whole number of at least 1, got 0"):
        lagged_signal(np.ones((2, 1)), np.ones((2, 1), dtype=bool), 0)
