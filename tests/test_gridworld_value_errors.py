"""Exact errors of value functions against every trajectory of small MDPs, and against rollouts."""

import numpy as np
import pytest
from tabular_oracles import all_trajectories, cyclic_mdp, layered_mdp, random_policy

from sb3_gae.estimators.measures import value_errors
from sb3_gae.gridworld import exact_value_errors, gridworld, sample_episodes

GAMMA = 0.9


@pytest.mark.parametrize("seed", range(3))
def test_equals_the_sum_over_all_trajectories(seed: int) -> None:
    policy = random_policy(layered_mdp(seed), seed)
    values = np.random.default_rng(seed).normal(size=5)
    truth = policy.values(GAMMA)
    weights, returns, deltas, states = [], [], [], []
    for trajectory in all_trajectories(policy):
        returns += trajectory.advantages(policy.mdp, np.zeros(5), GAMMA, 1.0)
        deltas += trajectory.advantages(policy.mdp, values, GAMMA, 0.0)
        states += trajectory.states[:-1]
        weights += [trajectory.probability] * len(trajectory.actions)

    def mean(terms: np.ndarray) -> float:
        return float(np.average(terms, weights=weights))

    def variance(terms: np.ndarray) -> float:
        return mean(np.square(terms - mean(terms)))

    visited = np.array(states)
    expected_delta = np.array([np.average(np.array(deltas)[visited == s], weights=np.array(weights)[visited == s])
                               if (visited == s).any() else 0.0 for s in range(5)])  # fmt: skip
    residuals = np.array(returns) - values[visited]
    actual = exact_value_errors(policy, values, GAMMA)
    np.testing.assert_allclose(actual.return_variance, variance(np.array(returns)))
    np.testing.assert_allclose(actual.explained_variance, 1.0 - variance(residuals) / variance(np.array(returns)))
    np.testing.assert_allclose(actual.monte_carlo_error, mean(np.square(residuals)))
    np.testing.assert_allclose(actual.td_error, mean(np.square(deltas)))
    np.testing.assert_allclose(actual.bellman_error, mean(np.square(expected_delta[visited])))
    np.testing.assert_allclose(actual.value_error, mean(np.square((values - truth)[visited])))


def test_is_what_many_rollouts_show() -> None:
    policy = random_policy(gridworld(), 3)
    values = policy.values(GAMMA) + 0.2 * np.random.default_rng(0).normal(size=25)
    values[policy.mdp.terminal] = 0.0
    episodes = sample_episodes(policy, 20_000, np.random.default_rng(1))
    found = value_errors(
        episodes.rewards, values[episodes.states], values[episodes.next_states], episodes.dones, GAMMA, episodes.mask
    )
    exact = exact_value_errors(policy, values, GAMMA)
    for name in found._fields:
        np.testing.assert_allclose(getattr(found, name), getattr(exact, name), rtol=0.03, atol=0.01)


def test_the_exact_values_have_no_error_but_noise() -> None:
    policy = random_policy(cyclic_mdp(0), 0)
    errors = exact_value_errors(policy, policy.values(GAMMA), GAMMA)
    assert errors.value_error == pytest.approx(0.0, abs=1e-20)
    assert errors.bellman_error == pytest.approx(0.0, abs=1e-20)
    assert errors.td_error > 0.01
    # What is left of the returns' variance is their noise given the state
    assert errors.monte_carlo_error == pytest.approx((1.0 - errors.explained_variance) * errors.return_variance)


def test_noise_is_what_the_measures_of_a_rollout_have_beside_the_error() -> None:
    policy = random_policy(cyclic_mdp(0), 0)
    exact, wrong = policy.values(GAMMA), policy.values(GAMMA) + np.array([1.0, -1.0, 0.5, 0.0, 0.0])
    perfect, errors = exact_value_errors(policy, exact, GAMMA), exact_value_errors(policy, wrong, GAMMA)
    assert errors.monte_carlo_error == pytest.approx(perfect.monte_carlo_error + errors.value_error)


def test_values_of_terminal_states_count_as_zero_and_bad_arguments_are_refused() -> None:
    policy = random_policy(layered_mdp(0), 0)
    values = np.ones(5)
    known = np.where(policy.mdp.terminal, 0.0, values)
    assert exact_value_errors(policy, values, GAMMA) == exact_value_errors(policy, known, GAMMA)
    with pytest.raises(ValueError, match="`gamma` must be a number"):
        exact_value_errors(policy, values, 1.5)
    with pytest.raises(ValueError, match=r"`values` must have the shape \(5,\)"):
        exact_value_errors(policy, values[:3], GAMMA)
