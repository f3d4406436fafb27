"""Squared norms and variances from groups: against their definitions, and right on average."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tabular_oracles import random_policy

from sb3_gae.estimators.group_statistics import gradient_errors, mean_variance, squared_norm
from sb3_gae.estimators.trajectory_groups import trajectory_groups, trajectory_indices
from sb3_gae.gridworld import episode_advantages, episode_gradients, gridworld, sample_episodes


@given(st.integers(0, 1000), st.integers(2, 6), st.integers(1, 3), st.integers(1, 4))
def test_estimates_are_the_sums_over_pairs_of_groups(seed: int, n_groups: int, n_vectors: int, n_parameters: int) -> None:
    generator = np.random.default_rng(seed)
    sums, weights = generator.normal(size=(n_groups, n_vectors, n_parameters)), generator.uniform(1, 5, n_groups)
    pairs = [(j, k) for j in range(n_groups) for k in range(n_groups) if j != k]
    for vector in range(n_vectors):
        products = sum(sums[j, vector] @ sums[k, vector] for j, k in pairs)
        expected = products / sum(weights[j] * weights[k] for j, k in pairs)
        assert squared_norm(sums, weights).value[vector] == pytest.approx(expected)
        mean = sums[:, vector].sum(axis=0) / weights.sum()
        spread = sum(np.square(sums[j, vector] - weights[j] * mean).sum() for j in range(n_groups))
        expected = spread / (weights.sum() ** 2 - np.square(weights).sum())
        assert mean_variance(sums, weights).value[vector] == pytest.approx(expected)


@given(st.integers(0, 1000), st.integers(2, 5), st.integers(1, 4))
def test_a_metric_is_a_change_of_coordinates(seed: int, n_groups: int, n_parameters: int) -> None:
    generator = np.random.default_rng(seed)
    sums, root = generator.normal(size=(n_groups, 3, n_parameters)), generator.normal(size=(n_parameters, n_parameters))
    weights = generator.uniform(1, 5, n_groups)
    in_metric = gradient_errors(sums, weights, duals=sums @ (root @ root.T), steps=sums @ (root @ root.T))
    for found, expected in zip(in_metric, gradient_errors(sums @ root, weights), strict=True):
        np.testing.assert_allclose(found.value, expected.value, rtol=1e-8, atol=1e-10)


def test_inner_products_are_those_with_the_reference_in_other_groups() -> None:
    generator = np.random.default_rng(0)
    sums, weights = generator.normal(size=(4, 3, 5)), generator.uniform(1, 5, 4)
    pairs = [(j, k) for j in range(4) for k in range(4) if j != k]
    products = np.sum([(sums[j] @ sums[k, 1]) for j, k in pairs], axis=0)
    expected = products / sum(weights[j] * weights[k] for j, k in pairs)
    errors = gradient_errors(sums, weights, reference=1)
    np.testing.assert_allclose(errors.inner_product.value, expected)
    assert errors.inner_product.value[1] == pytest.approx(errors.squared_norm.value[1])
    matrix = generator.normal(size=(5, 5))
    elsewhere = gradient_errors(sums, weights, reference=1, steps=sums @ (matrix + matrix.T)).inner_product.value
    products = np.sum([(sums[j] @ (matrix + matrix.T) @ sums[k, 1]) for j, k in pairs], axis=0)
    np.testing.assert_allclose(elsewhere, products / sum(weights[j] * weights[k] for j, k in pairs))


def test_two_equal_halves_give_the_product_and_the_quarter_of_the_difference() -> None:
    sums = np.random.default_rng(0).normal(size=(2, 3, 7))
    (first, second), errors = sums / 5.0, gradient_errors(sums, [5.0, 5.0])
    products = ((first - first[-1]) * (second - second[-1])).sum(axis=1)
    np.testing.assert_allclose(errors.bias_squared.value, products)
    np.testing.assert_allclose(errors.variance.value, np.square(first - second).sum(axis=1) / 4.0)
    np.testing.assert_allclose(errors.squared_norm.value, (first * second).sum(axis=1))
    assert np.isnan(errors.bias_squared.standard_error).all()


def test_weights_may_differ_between_vectors() -> None:
    generator = np.random.default_rng(0)
    sums, weights = generator.normal(size=(4, 2, 3)), generator.uniform(1, 2, size=(4, 2))
    for vector in range(2):
        alone = squared_norm(sums[:, vector : vector + 1], weights[:, vector])
        together = squared_norm(sums, weights)
        assert together.value[vector] == pytest.approx(alone.value[0])
        assert together.standard_error[vector] == pytest.approx(alone.standard_error[0])


@pytest.mark.parametrize("sizes", [[5] * 8, [2, 3, 4, 5, 6, 7, 8, 5]])
@pytest.mark.parametrize("length", [0.3, 3.0])
def test_estimates_of_gaussian_vectors_are_unbiased_and_their_errors_honest(sizes: list[int], length: float) -> None:
    generator, n_batches = np.random.default_rng(0), 1000
    mean, deviation, n = length * np.array([1.0, -0.3, 0.6]), np.array([1.0, 2.0, 0.5]), sum(sizes)
    samples = mean + deviation * generator.normal(size=(n_batches, n, 3))
    norms, variances = [], []
    for batch in samples:
        sums = np.stack([part.sum(axis=0) for part in np.split(batch, np.cumsum(sizes)[:-1])])[:, None]
        norms.append(np.concatenate(squared_norm(sums, sizes)))
        variances.append(np.concatenate(mean_variance(sums, sizes)))
    for estimates, truth in ((norms, mean @ mean), (variances, deviation @ deviation / n)):
        values, errors = np.transpose(estimates)
        assert abs(values.mean() - truth) < 4.0 * values.std() / np.sqrt(n_batches)
        # Too large by no more than the root of 2, where noise dominates
        assert 0.8 < np.sqrt(np.square(errors).mean()) / values.std() < 1.2 * (1.0 if length > 1.0 else np.sqrt(2.0))


@pytest.mark.parametrize("n_groups", [2, 7])
def test_errors_of_lambda_on_the_gridworld_are_the_exact_ones_on_average(n_groups: int) -> None:
    """The measured bias and variance of each lambda, over 400 batches of 14 episodes, beside the linear systems' answer."""
    policy, lambdas, gamma, n_batches, n_episodes = random_policy(gridworld(), 7), [0.0, 0.5, 0.9, 1.0], 0.95, 400, 14
    values = np.random.default_rng(0).normal(size=25) * 0.3
    episodes = sample_episodes(policy, n_batches * n_episodes, np.random.default_rng(1))
    gradients = np.stack(
        [
            episode_gradients(policy, episodes, episode_advantages(policy, episodes, values, gamma, gae_lambda))
            for gae_lambda in lambdas
        ],
        axis=1,
    ).reshape(n_batches, n_groups, n_episodes // n_groups, len(lambdas), -1)
    errors = [gradient_errors(batch.sum(axis=1), np.full(n_groups, n_episodes // n_groups)) for batch in gradients]
    truth = policy.lambda_curve(values, gamma, lambdas)
    norms = [np.square(policy.expected_gradient(values, gamma, gae_lambda)).sum() for gae_lambda in lambdas]
    true = policy.true_gradient(gamma)
    products = [np.sum(policy.expected_gradient(values, gamma, gae_lambda) * true) for gae_lambda in lambdas]
    for name, expected in (
        ("bias_squared", truth.bias_squared),
        ("variance", truth.variance / n_episodes),
        ("squared_norm", norms),
        ("inner_product", products),
    ):
        estimates = np.array([getattr(each, name).value for each in errors])
        limits = 4.0 * estimates.std(axis=0) / np.sqrt(n_batches) + 1e-12
        assert (np.abs(estimates.mean(axis=0) - expected) < limits).all(), name


@pytest.mark.parametrize(
    ("shape", "weights", "message"),
    [
        ((1, 2, 3), [1.0], "`sums` must have the shape .* at least two groups, got .1, 2, 3."),
        ((2, 3), [1.0, 1.0], "`sums` must have the shape"),
        ((2, 2, 3), [1.0], r"`weights` must be positive numbers of shape \(2,\) or \(2, 2\), got the shape \(1,\)"),
        ((2, 2, 3), [1.0, 0.0], "`weights` must be positive"),
    ],
)
def test_refuses_what_has_no_groups(shape: tuple[int, ...], weights: list[float], message: str) -> None:
    for estimate in (squared_norm, mean_variance):
        with pytest.raises(ValueError, match=message):
            estimate(np.zeros(shape), weights)
        with pytest.raises(ValueError, match="`duals` must have the shape of `sums`"):
            estimate(np.zeros((2, 2, 3)), [1.0, 1.0], np.zeros((2, 1, 3)))


# --- Who belongs to which group ---


@given(st.integers(0, 1000), st.integers(1, 9), st.integers(1, 4))
def test_trajectories_are_what_lies_between_endings(seed: int, n_steps: int, n_envs: int) -> None:
    generator = np.random.default_rng(seed)
    dones, mask = generator.uniform(size=(2, n_steps, n_envs)) < [[[0.3]], [[0.8]]]
    expected, count = np.full(dones.shape, -1), 0
    for n in range(n_envs):
        inside = False
        for t in range(n_steps):
            if mask[t, n]:
                count += not inside
                expected[t, n], inside = count - 1, not dones[t, n]
            else:
                inside = False
    np.testing.assert_array_equal(trajectory_indices(dones, mask), expected)


def test_whole_environments_go_together_where_there_are_enough() -> None:
    dones = np.random.default_rng(0).uniform(size=(20, 6)) < 0.2
    np.testing.assert_array_equal(trajectory_groups(dones, 4), np.tile([0, 1, 2, 3, 0, 1], (20, 1)))


def test_trajectories_are_dealt_out_where_environments_are_few() -> None:
    dones = np.zeros((6, 1), dtype=bool)
    dones[[1, 2, 4]] = True
    assert trajectory_groups(dones, 3)[:, 0].tolist() == [0, 0, 1, 2, 2, 0]
    assert trajectory_groups(dones, 9)[:, 0].tolist() == [0, 0, 1, 2, 2, 3]
    mask = np.ones_like(dones)
    mask[2] = False
    assert trajectory_groups(dones, 2, mask)[:, 0].tolist() == [0, 0, -1, 1, 1, 0]


def test_refuses_to_divide_a_single_trajectory() -> None:
    with pytest.raises(ValueError, match="`dones` must divide the rollout into at least two trajectories, got 1"):
        trajectory_groups(np.zeros((5, 1), dtype=bool))
    with pytest.raises(ValueError, match="`n_groups` must be a whole number of at least 2, got 1"):
        trajectory_groups(np.ones((5, 1), dtype=bool), 1)
