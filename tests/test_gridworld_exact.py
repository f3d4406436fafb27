"""Exact moments against enumeration of all trajectories, power series, differences and sampling."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from tabular_oracles import Trajectory, all_trajectories, cyclic_mdp, layered_mdp, random_policy, trajectories_from

from sb3_gae.gridworld import (
    TabularPolicy,
    angle,
    episode_advantages,
    episode_gradients,
    gridworld,
    lagged_gradients,
    response_function,
    sample_episodes,
)

seeds = st.integers(0, 10**6)
factors = st.one_of(st.sampled_from([0.0, 1.0, 0.99]), st.floats(0.0, 1.0))


def random_values(policy: TabularPolicy, seed: int) -> np.ndarray:
    """Terminal states among them: what a value function says there must not matter."""
    return np.random.default_rng(seed + 1).normal(size=policy.mdp.n_states)


# --- Every trajectory ---


def moments_by_enumeration(
    policy: TabularPolicy, trajectories: list[Trajectory], values: np.ndarray, gamma: float, gae_lambda: float | np.ndarray
) -> tuple[np.ndarray, float]:
    """Mean of the gradient, and trace of its covariance."""
    chances = np.array([each.probability for each in trajectories])
    gradients = np.array(
        [each.gradient(policy, each.advantages(policy.mdp, values, gamma, gae_lambda)) for each in trajectories]
    )
    mean = np.einsum("n,nsa->sa", chances, gradients)
    return mean, float(chances @ np.square(gradients - mean).sum(axis=(1, 2)))


@given(seeds, factors, factors)
@example(0, 1.0, 1.0)
@example(0, 0.0, 0.0)
def test_moments_of_the_gradient_are_those_over_all_trajectories(seed: int, gamma: float, gae_lambda: float) -> None:
    policy = random_policy(layered_mdp(seed), seed)
    values, trajectories = random_values(policy, seed), all_trajectories(policy)
    assert sum(each.probability for each in trajectories) == pytest.approx(1.0)
    mean, variance = moments_by_enumeration(policy, trajectories, values, gamma, gae_lambda)
    moments = policy.gradient_moments(values, gamma, gae_lambda)
    np.testing.assert_allclose(moments.mean, mean, atol=1e-12)
    np.testing.assert_allclose(policy.expected_gradient(values, gamma, gae_lambda), mean, atol=1e-12)
    assert moments.variance == pytest.approx(variance, abs=1e-11)
    curve = policy.lambda_curve(values, gamma, [gae_lambda])
    assert curve.variance[0] == moments.variance
    truth = policy.true_gradient(gamma)
    assert curve.bias_squared[0] == pytest.approx(np.square(mean - truth).sum(), abs=1e-12)


@given(seeds, factors)
def test_moments_of_the_gradient_with_a_lambda_for_each_state(seed: int, gamma: float) -> None:
    policy = random_policy(layered_mdp(seed), seed)
    values, trajectories = random_values(policy, seed), all_trajectories(policy)
    lambdas = np.random.default_rng(seed).uniform(size=policy.mdp.n_states)
    mean, variance = moments_by_enumeration(policy, trajectories, values, gamma, lambdas)
    moments = policy.gradient_moments(values, gamma, lambdas)
    np.testing.assert_allclose(moments.mean, mean, atol=1e-12)
    assert moments.variance == pytest.approx(variance, abs=1e-11)


@given(seeds, factors, factors)
@example(0, 1.0, 1.0)
@settings(max_examples=8)
def test_moments_hold_where_states_are_visited_again(seed: int, gamma: float, gae_lambda: float) -> None:
    # Few go on for long, and a later visit shares its logits with an earlier one
    policy = random_policy(cyclic_mdp(seed, n_states=3, n_actions=2, ending=0.95), seed)
    values, trajectories = random_values(policy, seed), all_trajectories(policy, max_steps=6)
    assert 1.0 - sum(each.probability for each in trajectories) < 2e-8
    mean, variance = moments_by_enumeration(policy, trajectories, values, gamma, gae_lambda)
    moments = policy.gradient_moments(values, gamma, gae_lambda)
    np.testing.assert_allclose(moments.mean, mean, atol=1e-6)
    assert moments.variance == pytest.approx(variance, abs=2e-5)


@given(seeds, factors, factors)
def test_moments_of_the_advantages_are_those_over_all_ways_on(seed: int, gamma: float, gae_lambda: float) -> None:
    policy = random_policy(layered_mdp(seed), seed)
    values = random_values(policy, seed)
    moments = policy.gradient_moments(values, gamma, gae_lambda)
    for state in np.flatnonzero(~policy.mdp.terminal).tolist():
        for action in range(policy.mdp.n_actions):
            ways = [each for each in trajectories_from(policy, (state,)) if each.actions[0] == action]
            chances = np.array([each.probability for each in ways]) / policy.probabilities[state, action]
            advantages = np.array([each.advantages(policy.mdp, values, gamma, gae_lambda)[0] for each in ways])
            mean = chances @ advantages
            assert moments.advantage_mean[state, action] == pytest.approx(mean, abs=1e-12)
            assert moments.advantage_variance[state, action] == pytest.approx(chances @ (advantages - mean) ** 2, abs=1e-11)


@given(seeds, factors)
def test_values_and_returns_are_means_over_all_ways_on(seed: int, gamma: float) -> None:
    policy = random_policy(layered_mdp(seed), seed)
    nothing = np.zeros(policy.mdp.n_states)
    for state in np.flatnonzero(~policy.mdp.terminal).tolist():
        ways = list(trajectories_from(policy, (state,)))
        expected = sum(each.probability * each.advantages(policy.mdp, nothing, gamma, 1.0)[0] for each in ways)
        assert policy.values(gamma)[state] == pytest.approx(expected, abs=1e-12)
    np.testing.assert_array_equal(policy.values(gamma)[policy.mdp.terminal], 0.0)
    returns = sum(each.probability * sum(each.rewards(policy.mdp)) for each in all_trajectories(policy))
    assert policy.expected_return() == pytest.approx(returns, abs=1e-12)
    lengths = sum(each.probability * len(each.actions) for each in all_trajectories(policy))
    assert policy.mean_length == pytest.approx(lengths)


@given(seeds, factors, st.booleans())
def test_response_and_lagged_gradients_are_means_over_all_trajectories(seed: int, gamma: float, shaped: bool) -> None:
    policy, n_lags = random_policy(layered_mdp(seed), seed), 4
    mdp, values = policy.mdp, random_values(policy, seed) if shaped else np.zeros(policy.mdp.n_states)
    arguments = (values, gamma) if shaped else ()
    responses = response_function(policy, n_lags, *arguments)
    for state in np.flatnonzero(~mdp.terminal).tolist():
        ways = list(trajectories_from(policy, (state,)))
        chances = np.array([each.probability for each in ways])
        later = np.zeros((len(ways), n_lags))
        for way, each in zip(later, ways, strict=True):
            deltas = each.advantages(mdp, values, gamma, 0.0) if shaped else each.rewards(mdp)
            way[: len(deltas)] = deltas[:n_lags]
        for action in range(mdp.n_actions):
            such = np.array([each.actions[0] == action for each in ways])
            expected = chances[such] @ later[such] / chances[such].sum() - chances @ later
            np.testing.assert_allclose(responses[:, state, action], expected, atol=1e-12)
    expected = np.zeros((n_lags, *policy.logits.shape))
    for each in all_trajectories(policy):
        signal = each.advantages(mdp, values, gamma, 0.0) if shaped else each.rewards(mdp)
        for lag in range(n_lags):
            expected[lag] += each.probability * each.gradient(policy, signal[lag:])
    np.testing.assert_allclose(lagged_gradients(policy, n_lags, *arguments), expected, atol=1e-12)


# --- Identities of the paper ---


@given(seeds, factors)
def test_responses_add_up_to_the_advantages(seed: int, gamma: float) -> None:
    policy, n_lags = random_policy(layered_mdp(seed), seed), 4
    total = np.tensordot(gamma ** np.arange(n_lags), response_function(policy, n_lags), axes=1)
    ongoing = ~policy.mdp.terminal
    np.testing.assert_allclose(total[ongoing], policy.advantages(gamma)[ongoing], atol=1e-12)


@given(seeds, factors)
def test_lambda_one_is_unbiased_for_any_values(seed: int, gamma: float) -> None:
    policy = random_policy(cyclic_mdp(seed), seed)
    gradient = policy.expected_gradient(random_values(policy, seed), gamma, 1.0)
    np.testing.assert_allclose(gradient, policy.true_gradient(gamma), atol=1e-9)


@given(seeds, factors, factors)
def test_exact_values_are_unbiased_for_any_lambda(seed: int, gamma: float, gae_lambda: float) -> None:
    policy = random_policy(cyclic_mdp(seed), seed)
    values = policy.values(gamma)
    np.testing.assert_allclose(policy.expected_gradient(values, gamma, gae_lambda), policy.true_gradient(gamma), atol=1e-9)
    np.testing.assert_allclose(policy.expected_advantages(values, gamma, gae_lambda), policy.advantages(gamma), atol=1e-9)


@given(seeds, factors, factors)
def test_only_errors_of_states_that_actions_lead_to_bias_the_gradient(seed: int, gamma: float, gae_lambda: float) -> None:
    policy = random_policy(cyclic_mdp(seed), seed)
    values = random_values(policy, seed)
    error = np.where(policy.mdp.terminal, 0.0, values - policy.values(gamma))
    # gamma (1 - lambda) sum_l (gamma lambda)^l E[score e(s_{t+l+1})], the sum by powers of the chain
    after, factor, signal = error, 1.0, np.zeros_like(policy.logits)
    for _ in range(2000):
        signal += factor * np.einsum("sat,t->sa", policy.mdp.transitions, after)
        after, factor = policy.chain @ after, factor * gamma * gae_lambda
    expected = gamma * (1.0 - gae_lambda) * policy.gradient_of(signal)
    actual = policy.expected_gradient(values, gamma, gae_lambda) - policy.true_gradient(gamma)
    np.testing.assert_allclose(actual, expected, atol=1e-9)


@given(seeds, factors, st.floats(-100.0, 100.0))
def test_values_off_by_a_constant_bias_one_step_estimates_only_next_to_an_end(seed: int, gamma: float, shift: float) -> None:
    policy = random_policy(gridworld(), seed)
    bias = policy.expected_gradient(policy.values(gamma) + shift, gamma, 0.0) - policy.true_gradient(gamma)
    next_to_an_end = policy.mdp.transitions[:, :, policy.mdp.terminal].any(axis=(1, 2))
    np.testing.assert_allclose(bias[~next_to_an_end], 0.0, atol=1e-9)
    if abs(gamma * shift) > 1e-3:
        assert np.abs(bias[next_to_an_end]).max() > 1e-9


# --- Power series, differences, sampling ---


@pytest.mark.parametrize("gamma", [0.0, 0.9, 1.0])
@pytest.mark.parametrize("gae_lambda", [0.0, 0.7, 1.0])
def test_gridworld_against_power_series(gamma: float, gae_lambda: float) -> None:
    policy = random_policy(gridworld(), 3)
    values = random_values(policy, 3)
    values[policy.mdp.terminal] = 0.0
    deltas = policy.mdp.rewards + gamma * values - values[:, None, None]
    here = np.einsum("sat,sat->sa", policy.mdp.transitions, deltas)
    chain = np.einsum("sa,sat->st", policy.probabilities, policy.mdp.transitions)
    later, total, visits, arrived = (policy.probabilities * here).sum(axis=1), here.copy(), np.zeros(25), policy.mdp.start
    for step in range(8000):
        total += (gamma * gae_lambda) ** (step + 1) * policy.mdp.transitions @ later
        later, visits, arrived = chain @ later, visits + arrived, arrived @ chain
    inside = ~policy.mdp.terminal
    np.testing.assert_allclose(
        policy.expected_advantages(values, gamma, gae_lambda)[inside], total[inside], rtol=1e-9, atol=1e-9
    )
    np.testing.assert_allclose(policy.visits, visits, rtol=1e-9)
    series = response_function(policy, 8000, values, gamma)
    centred = total - (policy.probabilities * total).sum(axis=1, keepdims=True)
    summed = np.einsum("l,lsa->sa", (gamma * gae_lambda) ** np.arange(8000.0), series)
    np.testing.assert_allclose(summed[inside], centred[inside], rtol=1e-8, atol=1e-9)


@given(seeds)
@settings(max_examples=10)
def test_undiscounted_gradient_is_that_of_the_expected_return(seed: int) -> None:
    mdp = cyclic_mdp(seed)
    logits, step = np.random.default_rng(seed).normal(size=(mdp.n_states, mdp.n_actions)), 1e-5
    differences = np.zeros_like(logits)
    for cell in np.ndindex(*logits.shape):
        shift = np.zeros_like(logits)
        shift[cell] = step
        up, down = (TabularPolicy(mdp, logits + sign * shift).expected_return() for sign in (1, -1))
        differences[cell] = (up - down) / (2 * step)
    np.testing.assert_allclose(TabularPolicy(mdp, logits).true_gradient(1.0), differences, rtol=1e-6, atol=1e-7)


@given(seeds, factors)
@settings(max_examples=10)
def test_discounted_gradient_is_that_of_the_surrogate_with_visits_held_fixed(seed: int, gamma: float) -> None:
    mdp = cyclic_mdp(seed)
    policy, step = random_policy(mdp, seed), 1e-5
    differences = np.zeros_like(policy.logits)
    for cell in np.ndindex(*policy.logits.shape):
        shift = np.zeros_like(policy.logits)
        shift[cell] = step
        up, down = (
            np.einsum("s,sa,sa->", policy.visits, TabularPolicy(mdp, policy.logits + sign * shift).probabilities,
                      policy.action_values(gamma))
            for sign in (1, -1)
        )  # fmt: skip
        differences[cell] = (up - down) / (2 * step)
    np.testing.assert_allclose(policy.true_gradient(gamma), differences, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize(("gamma", "gae_lambda"), [(1.0, 1.0), (0.95, 0.9), (0.9, 0.0)])
def test_sampled_episodes_have_the_exact_moments(gamma: float, gae_lambda: float) -> None:
    policy, n_episodes = random_policy(gridworld(), 5), 20_000
    values = random_values(policy, 5)
    episodes = sample_episodes(policy, n_episodes, np.random.default_rng(0))
    gradients = episode_gradients(policy, episodes, episode_advantages(policy, episodes, values, gamma, gae_lambda))
    moments = policy.gradient_moments(values, gamma, gae_lambda)
    gradients = gradients.reshape(n_episodes, -1)
    errors = (gradients.mean(axis=0) - moments.mean.ravel()) / (gradients.std(axis=0) / np.sqrt(n_episodes) + 1e-12)
    assert np.abs(errors).max() < 4.5
    squares = np.square(gradients - moments.mean.ravel()).sum(axis=1)
    assert abs(squares.mean() - moments.variance) < 4.0 * squares.std() / np.sqrt(n_episodes)


# --- Edges ---


@pytest.mark.parametrize(
    ("first", "second", "expected"),
    [([1, 0], [1, 1], np.pi / 4), ([2, 0], [0, 3], np.pi / 2), ([1, 2], [-1, -2], np.pi), ([1, 0], [1, 1e-9], 1e-9)],
)
def test_angle(first: list[float], second: list[float], expected: float) -> None:
    assert angle(np.array(first), np.array(second)) == pytest.approx(expected, rel=1e-6)
    assert np.isnan(angle(np.array(first), np.zeros(2)))


def test_softmax_does_not_overflow_and_ignores_a_common_shift() -> None:
    mdp = gridworld()
    logits = np.random.default_rng(0).normal(size=(25, 4))
    shifted = TabularPolicy(mdp, logits + 1e4 * np.arange(25)[:, None])
    np.testing.assert_allclose(shifted.probabilities, TabularPolicy(mdp, logits).probabilities, rtol=1e-9)


def test_refuses_policies_that_go_on_forever() -> None:
    mdp = gridworld(slip=0.0)
    into_the_wall = np.tile([-1000.0, -1000.0, 1000.0, -1000.0], (25, 1))
    with pytest.raises(ValueError, match="`logits` must let every state reach a terminal one"):
        TabularPolicy(mdp, into_the_wall)


def test_refuses_bad_arguments() -> None:
    mdp = gridworld()
    policy = TabularPolicy(mdp, np.zeros((25, 4)))
    with pytest.raises(ValueError, match=r"`logits` must have the shape \(25, 4\), got \(4, 25\)"):
        TabularPolicy(mdp, np.zeros((4, 25)))
    with pytest.raises(ValueError, match="`logits` must be finite"):
        TabularPolicy(mdp, np.full((25, 4), np.inf))
    with pytest.raises(ValueError, match=r"`values` must have the shape \(25,\), got \(5, 5\)"):
        policy.expected_gradient(np.zeros((5, 5)), 0.9, 0.9)
    with pytest.raises(ValueError, match=r"`gamma` must be a number in \[0, 1\], got 1.5"):
        policy.true_gradient(1.5)
    with pytest.raises(ValueError, match=r"`gae_lambda` must be a number in \[0, 1\], got -0.1"):
        policy.gradient_moments(np.zeros(25), 0.9, -0.1)
    with pytest.raises(ValueError, match=r"`gae_lambda` must be a number or have the shape \(25,\), got \(3,\)"):
        policy.gradient_moments(np.zeros(25), 0.9, np.ones(3))
    with pytest.raises(ValueError, match="`n_lags` must be a whole number of at least 1, got 0"):
        response_function(policy, 0)
