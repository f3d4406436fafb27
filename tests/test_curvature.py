"""Curvature products, dense and by autograd, against matrices from the definition of the Fisher information."""

from typing import Any

import pytest
import torch as th
from gymnasium import spaces
from oracles import (
    ACTION_SPACES,
    OF_IMAGES,
    actions_and_weights,
    dense_matrix,
    double_policy,
    fisher_matrix,
    jacobian,
    observations_for,
    training_batch,
)
from stable_baselines3.common.policies import ActorCriticPolicy
from torch import nn

from sb3_gae import MlpPolicy, SharedMlpPolicy
from sb3_gae.networks import dense_network
from sb3_gae.networks.dense_policy import (
    dense_policy_network,
    dense_value_network,
    has_dense_policy,
    has_dense_value,
    policy_log_std,
)
from sb3_gae.networks.distributions import fisher_metric, mean_kl, snapshot
from sb3_gae.networks.parameters import assign, flatten
from sb3_gae.update.conjugate_gradient import conjugate_gradient
from sb3_gae.update.curvature import CurvatureProduct, hessian_product
from sb3_gae.update.kronecker import KroneckerPreconditioner
from sb3_gae.update.policy_step import DenseFisher, autograd_fisher_product, policy_parameters
from sb3_gae.update.shared_parameters import shared_parameters
from sb3_gae.update.value_step import value_parameters

N_SAMPLES = 7
each_space = pytest.mark.parametrize("action_space", ACTION_SPACES.values(), ids=ACTION_SPACES.keys())


@pytest.fixture(autouse=True)
def small_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dense_network, "_BLOCK_ROWS", 3)


def parameters_in_dense_order(policy: ActorCriticPolicy, observations: th.Tensor) -> list[th.Tensor]:
    return [*dense_policy_network(policy, observations).parameters, *policy_log_std(policy)]


def size_of(parameters: list[th.Tensor]) -> int:
    return sum(parameter.numel() for parameter in parameters)


def value_curvature(policy: ActorCriticPolicy, observations: th.Tensor, parameters: list[th.Tensor]) -> CurvatureProduct:
    values = policy.predict_values(observations).squeeze(1)
    return hessian_product(0.5 * (values - values.detach()).square().mean(), parameters)


# --- Policies ---


@each_space
@pytest.mark.parametrize("net_arch", [[], [5, 4]], ids=["linear", "two layers"])
@pytest.mark.parametrize("activation", [nn.Tanh, nn.ReLU, nn.ELU])
def test_both_fisher_products_are_those_of_the_definition(
    action_space: spaces.Space, net_arch: list[int], activation: type[nn.Module]
) -> None:
    policy = double_policy(action_space, net_arch=dict(pi=net_arch, vf=[4]), activation_fn=activation)
    observations = observations_for(policy, N_SAMPLES)
    parameters = parameters_in_dense_order(policy, observations)
    expected = fisher_matrix(policy, observations, parameters)
    dense = dense_matrix(DenseFisher(policy, observations).product, len(expected))
    autograd = dense_matrix(autograd_fisher_product(policy, parameters, observations), len(expected))
    assert expected.diagonal().max() > 0.01
    th.testing.assert_close(dense, expected, rtol=1e-10, atol=1e-10)
    th.testing.assert_close(autograd, expected, rtol=1e-10, atol=1e-10)


@each_space
def test_in_single_precision_both_fisher_products_agree_to_five_digits(action_space: spaces.Space) -> None:
    th.manual_seed(0)
    space = spaces.Box(-10, 10, (6,))
    policy = MlpPolicy(space, action_space, lambda _: 0.0, net_arch=[16, 8], ortho_init=False)
    observations = th.randn(50, 6)
    parameters = parameters_in_dense_order(policy, observations)
    vector = th.randn(size_of(parameters))
    dense = DenseFisher(policy, observations).product(vector)
    autograd = autograd_fisher_product(policy, parameters, observations)(vector)
    assert dense.dtype == th.float32
    assert (dense - autograd).norm() <= 1e-5 * autograd.norm()


@each_space
def test_policies_of_sb3_have_dense_products(action_space: spaces.Space) -> None:
    policy = double_policy(action_space)
    assert has_dense_policy(policy, policy_parameters(policy, training_batch(policy)))


@each_space
def test_fisher_product_is_the_second_derivative_of_the_divergence(action_space: spaces.Space) -> None:
    policy = double_policy(action_space)
    observations = observations_for(policy, N_SAMPLES)
    parameters = parameters_in_dense_order(policy, observations)
    origin = flatten(parameters)
    direction = th.randn(len(origin), generator=th.Generator().manual_seed(3)).double()
    expected = direction.dot(DenseFisher(policy, observations).product(direction)).item()
    with th.no_grad():
        old = snapshot(policy.get_distribution(observations))
        divergences = []
        for length in (1e-3, -1e-3):
            assign(parameters, origin + length * direction)
            divergences.append(mean_kl(old, policy.get_distribution(observations)).item())
    # Both sides of the minimum, so that the third derivative cancels
    assert sum(divergences) / 1e-6 == pytest.approx(expected, rel=1e-4)


@each_space
def test_divergence_is_the_expected_log_ratio_of_whole_actions(action_space: spaces.Space) -> None:
    old, new = double_policy(action_space, seed=0), double_policy(action_space, seed=1)
    observations = observations_for(old, N_SAMPLES)
    with th.no_grad():
        p, q = old.get_distribution(observations), new.get_distribution(observations)
        weighted = list(actions_and_weights(p, N_SAMPLES))
        expected = sum((weight * (p.log_prob(action) - q.log_prob(action))).mean().item() for action, weight in weighted)
        assert mean_kl(p, q).item() == pytest.approx(expected, rel=1e-9)
        assert mean_kl(p, p).item() == pytest.approx(0.0, abs=1e-12)


def test_fisher_metric_takes_rows_of_their_own_block() -> None:
    policy = double_policy(ACTION_SPACES["MultiDiscrete"])
    observations = observations_for(policy, N_SAMPLES)
    with th.no_grad():
        metric = fisher_metric(snapshot(policy.get_distribution(observations)))
        tangents = th.randn(N_SAMPLES, 5, generator=th.Generator().manual_seed(0)).double()
        whole = metric(tangents, slice(None))
        parts = [metric(tangents[rows], rows) for rows in (slice(0, 2), slice(2, 7))]
    assert th.equal(th.cat(parts), whole)
    # Shifting all logits of one action changes no probability
    shifts = th.tensor([2.0, 2, 2, -3, -3], dtype=th.float64).expand(N_SAMPLES, -1)
    th.testing.assert_close(metric(shifts, slice(None)), th.zeros_like(shifts))


@pytest.mark.parametrize("kwargs", [{}, {"squash_output": True}, {"full_std": False}, {"use_expln": True}])
def test_state_dependent_exploration_falls_back_to_a_true_fisher_matrix(kwargs: dict) -> None:
    policy = double_policy(ACTION_SPACES["Box"], use_sde=True, **kwargs)
    batch = training_batch(policy, N_SAMPLES)
    parameters = policy_parameters(policy, batch)
    assert not has_dense_policy(policy, parameters)
    matrix = dense_matrix(autograd_fisher_product(policy, parameters, batch.observations), size_of(parameters))
    check_symmetric_and_positive(matrix)
    if not kwargs.get("squash_output"):
        expected = fisher_matrix(policy, batch.observations, parameters)
        th.testing.assert_close(matrix, expected, rtol=1e-8, atol=1e-8)


@each_space
def test_convolutions_fall_back_to_a_true_fisher_matrix(action_space: spaces.Space) -> None:
    policy = double_policy(action_space, **OF_IMAGES, net_arch=dict(pi=[3], vf=[3]))
    batch = training_batch(policy, 4)
    parameters = policy_parameters(policy, batch)
    assert not has_dense_policy(policy, parameters)
    matrix = dense_matrix(autograd_fisher_product(policy, parameters, batch.observations), size_of(parameters))
    check_symmetric_and_positive(matrix)
    expected = fisher_matrix(policy, batch.observations, parameters)
    th.testing.assert_close(matrix, expected, rtol=1e-10, atol=1e-10)


def check_symmetric_and_positive(matrix: th.Tensor) -> None:
    th.testing.assert_close(matrix, matrix.t(), rtol=1e-9, atol=1e-9)
    eigenvalues = th.linalg.eigvalsh(0.5 * (matrix + matrix.t()))
    assert eigenvalues.max() > 1e-3
    assert eigenvalues.min() > -1e-9 * eigenvalues.max()


# --- Value functions ---


@pytest.mark.parametrize("scale", [1.0, 50.0])
@pytest.mark.parametrize("net_arch", [[], [4], [5, 4]], ids=str)
def test_gauss_newton_products_of_values_are_those_of_the_dense_jacobian(net_arch: list[int], scale: float) -> None:
    policy = double_policy(ACTION_SPACES["Box"], net_arch=dict(pi=[3], vf=net_arch))
    policy.value_net.scale.fill_(scale)
    observations = observations_for(policy, N_SAMPLES)
    network = dense_value_network(policy, observations)
    parameters = network.parameters
    rows = jacobian(lambda: policy.predict_values(observations), parameters)
    expected = rows.t() @ rows / N_SAMPLES

    unscaled_values = network.forward().squeeze(1)
    th.testing.assert_close(scale * unscaled_values, policy.predict_values(observations).squeeze(1).detach())
    dense = dense_matrix(lambda vector: network.gauss_newton_product(vector, lambda tangents, _: tangents), len(expected))
    th.testing.assert_close(scale**2 * dense / N_SAMPLES, expected, rtol=1e-10, atol=1e-10)
    autograd = dense_matrix(value_curvature(policy, observations, parameters), len(expected))
    th.testing.assert_close(autograd, expected, rtol=1e-10, atol=1e-10)


def test_values_on_shared_convolutional_features_are_dense_and_agree_with_autograd() -> None:
    policy = double_policy(ACTION_SPACES["Discrete"], **OF_IMAGES)
    batch = training_batch(policy, N_SAMPLES)
    parameters = value_parameters(policy, batch, policy_parameters(policy, batch))
    # The features belong to the policy, so to the value step they are constants
    assert has_dense_value(policy, parameters)
    network = dense_value_network(policy, batch.observations)
    assert {id(parameter) for parameter in network.parameters} == {id(parameter) for parameter in parameters}
    network.forward()
    dense = dense_matrix(
        lambda vector: network.gauss_newton_product(vector, lambda tangents, _: tangents) / N_SAMPLES, size_of(parameters)
    )
    autograd = dense_matrix(value_curvature(policy, batch.observations, network.parameters), size_of(parameters))
    th.testing.assert_close(dense, autograd, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("net_arch", [[5, 4], dict(pi=[5, 4], vf=[5, 3])], ids=str)
def test_layers_that_the_policy_shares_are_features_to_the_value_step_unless_it_moves_them(net_arch: Any) -> None:
    policy = double_policy(ACTION_SPACES["Box"], policy_class=SharedMlpPolicy, net_arch=net_arch)
    batch = training_batch(policy, N_SAMPLES)
    of_policy = policy_parameters(policy, batch)
    own = value_parameters(policy, batch, of_policy)
    shared = shared_parameters(policy, batch, of_policy)
    assert has_dense_policy(policy, of_policy)
    for moved in (own, [*own, *shared]):
        assert has_dense_value(policy, moved)
        network = dense_value_network(policy, batch.observations, moved)
        assert {id(parameter) for parameter in network.parameters} == {id(parameter) for parameter in moved}
        th.testing.assert_close(network.forward(), policy.predict_values(batch.observations).detach())
    # A part of the layers that move is no case for it
    assert not has_dense_value(policy, [*own, shared[0]])


# --- Preconditioners ---


@pytest.mark.parametrize("scale", [0.01, 1.0, 100.0])
def test_the_preconditioner_of_linear_values_is_the_inverse_itself(scale: float) -> None:
    policy = double_policy(ACTION_SPACES["Box"], net_arch=dict(pi=[3], vf=[]))
    network = dense_value_network(policy, observations_for(policy, N_SAMPLES))
    network.forward()
    preconditioner = KroneckerPreconditioner(network, th.ones(N_SAMPLES, 1).double())
    hessian = dense_matrix(lambda vector: network.gauss_newton_product(vector, lambda tangents, _: tangents) / N_SAMPLES, 4)
    expected = th.linalg.inv(scale * hessian + 0.1 * th.eye(4).double())
    th.testing.assert_close(dense_matrix(lambda vector: preconditioner(vector, scale, 0.1), 4), expected)


@each_space
@pytest.mark.parametrize("damping", [1e-3, 1e-2])
def test_preconditioners_are_symmetric_and_positive_and_bring_the_first_step_nearer(
    action_space: spaces.Space, damping: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(dense_network, "_BLOCK_ROWS", 1000)
    policy = double_policy(action_space)
    batch = training_batch(policy, 1000)
    fisher = DenseFisher(policy, batch.observations)
    assert fisher.prepare(batch.actions)
    n = size_of(parameters_in_dense_order(policy, batch.observations))
    damped = dense_matrix(fisher.product, n) + damping * th.eye(n).double()
    approximate = dense_matrix(lambda vector: fisher.precondition(vector, damping), n)
    th.testing.assert_close(approximate, approximate.t(), rtol=1e-9, atol=1e-9)
    assert th.linalg.eigvalsh(approximate).min() > 0

    errors = {"plain": 0.0, "preconditioned": 0.0}
    for gradient in th.randn(10, n, generator=th.Generator().manual_seed(4)).double():
        exact = th.linalg.solve(damped, gradient)
        for name, preconditioner in (("plain", None), ("preconditioned", lambda vector: approximate @ vector)):
            first = conjugate_gradient(lambda vector: damped @ vector, gradient, 1, preconditioner=preconditioner).solution
            errors[name] += ((first - exact).dot(damped @ (first - exact)) / exact.dot(damped @ exact)).item()
    assert errors["preconditioned"] < 0.8 * errors["plain"]


@each_space
def test_scores_can_be_asked_for_again(action_space: spaces.Space) -> None:
    policy = double_policy(action_space)
    batch = training_batch(policy, N_SAMPLES)
    fisher, fresh = (DenseFisher(policy, batch.observations) for _ in range(2))
    assert fisher.prepare(batch.actions)
    again, expected = fisher.output_moments(batch.actions), fresh.output_moments(batch.actions)
    assert again.keys() == expected.keys()
    assert all(th.equal(again[linear], expected[linear]) for linear in expected)
