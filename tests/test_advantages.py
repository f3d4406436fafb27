"""Advantage estimators against direct sums, and the identities that the paper derives them from."""

import copy

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from oracles import (
    Rollout,
    advantage_magnitudes,
    assert_equal_to_rounding,
    direct_advantages,
    discounted_sums,
    last_step,
    rollouts,
)

from sb3_gae.estimators.advantages import (
    advantage_grid,
    discounted_returns,
    effective_horizon,
    generalized_advantages,
    next_state_values,
    td_residuals,
)

factors = st.one_of(st.sampled_from([0.0, 1.0, 0.99]), st.floats(0.0, 1.0))
double_rollouts = rollouts(np.float64)


def advantages_of(rollout: Rollout, gamma: float, gae_lambda: float) -> np.ndarray:
    deltas = td_residuals(rollout.rewards, rollout.values, rollout.next_values, gamma)
    return generalized_advantages(deltas, rollout.dones, gamma, gae_lambda)


def k_step_advantage(rollout: Rollout, t: int, n: int, k: int, gamma: float) -> float:
    """Equation 11 ff. of the paper: rewards of k steps, the value of where they led to, less that of the start."""
    rewards = sum(gamma**step * rollout.rewards[t + step, n] for step in range(k))
    return rewards + gamma**k * rollout.next_values[t + k - 1, n] - rollout.values[t, n]


@given(st.sampled_from([np.float32, np.float64]).flatmap(rollouts), factors, factors)
def test_advantages_are_the_direct_sum_of_residuals_within_the_episode(
    rollout: Rollout, gamma: float, gae_lambda: float
) -> None:
    magnitudes = advantage_magnitudes(rollout, gamma, gae_lambda)
    assert_equal_to_rounding(
        advantages_of(rollout, gamma, gae_lambda), direct_advantages(rollout, gamma, gae_lambda), magnitudes
    )


@given(rollouts(), factors)
def test_lambda_zero_gives_the_residuals_themselves(rollout: Rollout, gamma: float) -> None:
    deltas = td_residuals(rollout.rewards, rollout.values, rollout.next_values, gamma)
    assert np.array_equal(generalized_advantages(deltas, rollout.dones, gamma, 0.0), deltas)


@given(double_rollouts, factors)
def test_lambda_one_telescopes_to_the_discounted_return_less_the_value(rollout: Rollout, gamma: float) -> None:
    expected = np.empty(rollout.rewards.shape)
    for t, n in np.ndindex(*expected.shape):
        expected[t, n] = k_step_advantage(rollout, t, n, last_step(rollout.dones, t, n) - t + 1, gamma)
    assert_equal_to_rounding(advantages_of(rollout, gamma, 1.0), expected, advantage_magnitudes(rollout, gamma, 1.0))


@given(double_rollouts, factors, factors)
def test_advantages_are_the_exponentially_weighted_average_of_k_step_estimates(
    rollout: Rollout, gamma: float, gae_lambda: float
) -> None:
    expected = np.empty(rollout.rewards.shape)
    for t, n in np.ndindex(*expected.shape):
        longest = last_step(rollout.dones, t, n) - t + 1
        estimates = [k_step_advantage(rollout, t, n, k, gamma) for k in range(1, longest + 1)]
        # Nothing follows the longest one, which takes all the weight that is left
        weights = [(1 - gae_lambda) * gae_lambda ** (k - 1) for k in range(1, longest)] + [gae_lambda ** (longest - 1)]
        expected[t, n] = np.dot(weights, estimates)
    # The estimates are no less rounded than the sum at lambda 1
    assert_equal_to_rounding(advantages_of(rollout, gamma, gae_lambda), expected, advantage_magnitudes(rollout, gamma, 1.0))


@given(double_rollouts, factors, factors)
def test_advantages_are_sums_of_shaped_rewards_under_the_steeper_discount(
    rollout: Rollout, gamma: float, gae_lambda: float
) -> None:
    shaped = rollout.rewards + gamma * rollout.next_values - rollout.values
    nothing = np.zeros_like(shaped)
    expected = discounted_returns(shaped, nothing, rollout.dones, gamma * gae_lambda)
    magnitudes = advantage_magnitudes(rollout, gamma, gae_lambda)
    assert_equal_to_rounding(advantages_of(rollout, gamma, gae_lambda), expected, magnitudes)


@given(double_rollouts, st.integers(0, 100), factors, factors)
def test_shaping_by_any_potential_leaves_advantages_if_the_values_are_shaped_too(
    rollout: Rollout, seed: int, gamma: float, gae_lambda: float
) -> None:
    generator = np.random.default_rng(seed)
    scale = max(float(np.abs(rollout.values).max()), float(np.abs(rollout.rewards).max()))
    potential = copy.deepcopy(rollout)
    for array in (potential.values, potential.last_values, potential.bootstrap_values):
        array[...] = scale * generator.uniform(-1.0, 1.0, array.shape)
    shaped = copy.deepcopy(rollout)
    shaped.rewards = rollout.rewards + gamma * potential.next_values - potential.values
    for name in ("values", "last_values", "bootstrap_values"):
        setattr(shaped, name, getattr(rollout, name) - getattr(potential, name))
    magnitudes = advantage_magnitudes(rollout, gamma, gae_lambda) + 3 * advantage_magnitudes(potential, gamma, gae_lambda)
    expected = direct_advantages(rollout, gamma, gae_lambda)
    assert_equal_to_rounding(advantages_of(shaped, gamma, gae_lambda), expected, magnitudes)


@given(double_rollouts, factors)
def test_returns_at_lambda_one_do_not_depend_on_the_values_of_finished_episodes(rollout: Rollout, gamma: float) -> None:
    rollout.terminated[-1] = True
    other = copy.deepcopy(rollout)
    other.values = rollout.values[::-1] * 0.5 - np.abs(rollout.rewards)
    magnitudes = advantage_magnitudes(rollout, gamma, 1.0) + advantage_magnitudes(other, gamma, 1.0)
    returns, other_returns = (advantages_of(each, gamma, 1.0) + each.values for each in (rollout, other))
    assert_equal_to_rounding(other_returns, returns, magnitudes + np.abs(rollout.values) + np.abs(other.values))


@given(double_rollouts, factors, factors)
def test_exact_values_make_every_lambda_agree(rollout: Rollout, gamma: float, gae_lambda: float) -> None:
    # Deterministic and terminated: the true value is the return itself, and every residual vanishes
    rollout.terminated[-1] = True
    rollout.truncated[...] = False
    rollout.values = discounted_sums(rollout.rewards, rollout.dones, gamma)
    nothing = np.zeros(rollout.rewards.shape)
    assert_equal_to_rounding(
        advantages_of(rollout, gamma, gae_lambda), nothing, advantage_magnitudes(rollout, gamma, gae_lambda)
    )


@given(rollouts(scales=[1.0]), factors, factors, st.integers(-60, 60))
def test_advantages_scale_exactly_with_rewards_and_values(
    rollout: Rollout, gamma: float, gae_lambda: float, exponent: int
) -> None:
    scaled = copy.deepcopy(rollout)
    for name in ("rewards", "values", "last_values", "bootstrap_values"):
        # Entries that are neither zero nor subnormal after scaling
        array = np.round(getattr(rollout, name) * 64) / 64
        setattr(rollout, name, array.astype(np.float32))
        setattr(scaled, name, np.ldexp(array, exponent).astype(np.float32))
    gamma, gae_lambda = round(gamma * 8) / 8, round(gae_lambda * 8) / 8
    expected = np.ldexp(advantages_of(rollout, gamma, gae_lambda), exponent)
    assert np.array_equal(advantages_of(scaled, gamma, gae_lambda), expected)


@given(rollouts(), factors, factors)
def test_environments_do_not_see_each_other(rollout: Rollout, gamma: float, gae_lambda: float) -> None:
    together = advantages_of(rollout, gamma, gae_lambda)
    deltas = td_residuals(rollout.rewards, rollout.values, rollout.next_values, gamma)
    for n in range(deltas.shape[1]):
        alone = generalized_advantages(deltas[:, n : n + 1], rollout.dones[:, n : n + 1], gamma, gae_lambda)
        assert np.array_equal(together[:, n], alone[:, 0])


@given(rollouts(), factors, factors, st.data())
def test_nothing_is_propagated_back_across_the_end_of_an_episode(
    rollout: Rollout, gamma: float, gae_lambda: float, data: st.DataObject
) -> None:
    n_steps = len(rollout.rewards)
    last = data.draw(st.integers(0, n_steps - 1))
    rollout.terminated[last] = True
    before = advantages_of(rollout, gamma, gae_lambda)[: last + 1]
    rollout.rewards[last + 1 :] = rollout.values[last + 1 :] = np.nan
    assert np.array_equal(advantages_of(rollout, gamma, gae_lambda)[: last + 1], before)


@given(rollouts(np.float64), st.lists(factors, min_size=1, max_size=3), st.lists(factors, min_size=1, max_size=3))
def test_grid_equals_a_direct_sum_for_each_pair(rollout: Rollout, gammas: list[float], lambdas: list[float]) -> None:
    grid = advantage_grid(rollout.rewards, rollout.values, rollout.next_values, rollout.dones, gammas, lambdas)
    assert grid.shape == (len(gammas), len(lambdas), *rollout.rewards.shape)
    for g, gamma in enumerate(gammas):
        for k, gae_lambda in enumerate(lambdas):
            expected = direct_advantages(rollout, gamma, gae_lambda)
            assert_equal_to_rounding(grid[g, k], expected, advantage_magnitudes(rollout, gamma, gae_lambda))


@given(rollouts(), st.lists(factors, min_size=1, max_size=3), st.lists(factors, min_size=1, max_size=3))
def test_grid_equals_single_passes(rollout: Rollout, gammas: list[float], lambdas: list[float]) -> None:
    grid = advantage_grid(rollout.rewards, rollout.values, rollout.next_values, rollout.dones, gammas, lambdas)
    assert grid.dtype == np.float32
    for g, gamma in enumerate(gammas):
        for k, gae_lambda in enumerate(lambdas):
            expected = advantages_of(rollout, gamma, gae_lambda)
            assert_equal_to_rounding(grid[g, k], expected, advantage_magnitudes(rollout, gamma, gae_lambda))


@given(rollouts())
def test_next_values_are_told_by_how_each_step_ended(rollout: Rollout) -> None:
    actual = next_state_values(
        rollout.values, rollout.last_values, rollout.terminated, rollout.truncated, rollout.bootstrap_values
    )
    assert np.array_equal(actual, rollout.next_values)


def test_next_values_of_a_rollout_with_every_ending() -> None:
    values = np.array([[1.0], [2.0], [3.0], [4.0]], dtype=np.float32)
    terminated, truncated = np.array([[0], [1], [0], [1]], dtype=bool), np.array([[0], [0], [1], [1]], dtype=bool)
    bootstrap_values = np.array([[10.0], [20.0], [30.0], [40.0]], dtype=np.float32)
    actual = next_state_values(values, [50.0], terminated, truncated, bootstrap_values)
    assert actual.tolist() == [[2.0], [0.0], [30.0], [0.0]]
    unfinished = next_state_values(values, [50.0], ~terminated & terminated, truncated & ~truncated, bootstrap_values)
    assert unfinished.tolist() == [[2.0], [3.0], [4.0], [50.0]]


@given(double_rollouts, factors)
def test_returns_are_the_direct_sum_of_rewards_and_of_the_value_where_it_was_cut(rollout: Rollout, gamma: float) -> None:
    expected, magnitudes = np.empty(rollout.rewards.shape), np.empty(rollout.rewards.shape)
    rewards = discounted_sums(rollout.rewards, rollout.dones, gamma)
    sizes = discounted_sums(np.abs(rollout.rewards), rollout.dones, gamma)
    for t, n in np.ndindex(*expected.shape):
        last = last_step(rollout.dones, t, n)
        tail = gamma ** (last - t + 1) * rollout.next_values[last, n]
        expected[t, n], magnitudes[t, n] = rewards[t, n] + tail, sizes[t, n] + abs(tail)
    actual = discounted_returns(rollout.rewards, rollout.next_values, rollout.dones, gamma)
    assert_equal_to_rounding(actual, expected, magnitudes)


def test_effective_horizon() -> None:
    assert effective_horizon(0.5, 1.0) == 2.0
    assert effective_horizon(0.99, 0.0) == 1.0
    assert effective_horizon(1.0, 1.0) == np.inf
    np.testing.assert_allclose(effective_horizon(0.99, [0.9, 0.96]), [1 / (1 - 0.99 * 0.9), 1 / (1 - 0.99 * 0.96)])
    # The mean number of steps ahead, weighted as the estimator weights them, and one
    weights = (0.99 * 0.96) ** np.arange(2000)
    assert effective_horizon(0.99, 0.96) == pytest.approx(1 + weights @ np.arange(2000) / weights.sum())


@pytest.mark.parametrize("number", [float, np.float64, np.float32])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_results_have_the_precision_of_the_data_whatever_kind_of_number_the_factors_are(dtype: type, number: type) -> None:
    ones, nowhere = np.ones((3, 2), dtype=dtype), np.zeros((3, 2), dtype=bool)
    rollout = Rollout(ones, ones, ones[0], nowhere, nowhere, ones)
    rewards, values, dones = rollout.rewards, rollout.values, rollout.dones
    gamma, gae_lambda = number(0.5), number(0.25)
    deltas = td_residuals(rewards, values, rollout.next_values, gamma)
    assert deltas.dtype == dtype
    assert generalized_advantages(deltas, dones, gamma, gae_lambda).dtype == dtype
    assert discounted_returns(rewards, rollout.next_values, dones, gamma).dtype == dtype
    grid = advantage_grid(rewards, values, rollout.next_values, dones, np.array([gamma]), np.array([gae_lambda]))
    assert grid.dtype == dtype


@given(rollouts(), factors, factors)
def test_inputs_are_not_modified(rollout: Rollout, gamma: float, gae_lambda: float) -> None:
    before = copy.deepcopy(rollout)
    next_values = next_state_values(
        rollout.values, rollout.last_values, rollout.terminated, rollout.truncated, rollout.bootstrap_values
    )
    deltas = td_residuals(rollout.rewards, rollout.values, next_values, gamma)
    next_values_before, deltas_before, dones = next_values.copy(), deltas.copy(), rollout.dones
    advantages = generalized_advantages(deltas, dones, gamma, gae_lambda)
    advantage_grid(rollout.rewards, rollout.values, next_values, dones, [gamma], [gae_lambda])
    discounted_returns(rollout.rewards, next_values, dones, gamma)
    advantages[...] = np.nan  # shares no memory with what it came from
    assert np.array_equal(next_values, next_values_before)
    assert np.array_equal(deltas, deltas_before)
    assert np.array_equal(dones, before.dones)
    for name, array in vars(before).items():
        assert np.array_equal(getattr(rollout, name), array)
