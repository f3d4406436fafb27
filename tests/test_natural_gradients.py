"""Natural gradients against dense linear algebra."""

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from oracles import double_policy, training_batch

from sb3_gae.batch import TrainingBatch
from sb3_gae.networks.dense_policy import dense_policy_network
from sb3_gae.networks.policies import MlpPolicy
from sb3_gae.update.natural_gradients import has_natural_gradients, natural_gradients
from sb3_gae.update.policy_step import policy_parameters

DAMPING = 0.3
BOX, DISCRETE = spaces.Box(-1.0, 1.0, (2,)), spaces.Discrete(3)


def policy_and_batch(action_space: spaces.Space, hidden: list[int]) -> tuple[MlpPolicy, TrainingBatch, list[th.Tensor]]:
    policy = double_policy(action_space, net_arch=hidden)
    batch = training_batch(policy, 40)
    return policy, batch, policy_parameters(policy, batch)


def dense_fisher(policy: MlpPolicy, batch: TrainingBatch, parameters: list[th.Tensor]) -> np.ndarray:
    """The Kronecker-factored matrix, put together as a whole in the order of the parameters."""
    network = dense_policy_network(policy, batch.observations)
    outputs = network.forward().requires_grad_()
    mean = policy.action_dist.proba_distribution(outputs, *([policy.log_std] if hasattr(policy, "log_std") else []))
    (scores,) = th.autograd.grad(mean.log_prob(batch.actions).sum(), outputs)
    places, start = {}, 0
    for parameter in parameters:
        places[id(parameter)] = np.arange(start, start + parameter.numel())
        start += parameter.numel()
    matrix = np.zeros((start, start))
    for (linear, _), (of_inputs, of_outputs) in zip(network.layers, network.kronecker_factors(scores), strict=True):
        weight, bias = places[id(linear.weight)].reshape(linear.weight.shape), places[id(linear.bias)]
        order = np.concatenate([weight, bias[:, None]], axis=1).ravel()
        matrix[np.ix_(order, order)] = np.kron(of_outputs.numpy(), of_inputs.numpy())
    if hasattr(policy, "log_std"):
        own = places[id(policy.log_std)]
        matrix[own, own] = 2.0
    return matrix


@pytest.mark.parametrize("action_space", [BOX, DISCRETE])
@pytest.mark.parametrize("hidden", [[], [4, 3]])
def test_they_are_the_gradients_times_one_matrix(action_space: spaces.Space, hidden: list[int]) -> None:
    policy, batch, parameters = policy_and_batch(action_space, hidden)
    n_parameters = sum(parameter.numel() for parameter in parameters)
    gradients = np.random.default_rng(0).normal(size=(2, 3, n_parameters))
    fisher = dense_fisher(policy, batch, parameters)
    inverse = np.linalg.inv(fisher + DAMPING * np.eye(n_parameters))
    steps, duals = natural_gradients(policy, parameters, batch, gradients, DAMPING)
    np.testing.assert_allclose(steps, gradients @ inverse, rtol=1e-8)
    np.testing.assert_allclose(duals, gradients @ inverse @ fisher @ inverse, rtol=1e-7, atol=1e-10)
    lengths = np.einsum("ijp,pq,ijq->ij", steps, fisher, steps)
    np.testing.assert_allclose((gradients * duals).sum(axis=-1), lengths, rtol=1e-7)


@pytest.mark.parametrize("scale", [1e-30, 1e30])
def test_they_scale_with_the_gradients(scale: float) -> None:
    policy, batch, parameters = policy_and_batch(BOX, [4])
    gradients = np.random.default_rng(0).normal(size=(3, sum(parameter.numel() for parameter in parameters)))
    scaled = natural_gradients(policy, parameters, batch, scale * gradients)
    for part, unscaled in zip(scaled, natural_gradients(policy, parameters, batch, gradients), strict=True):
        np.testing.assert_allclose(part / scale, unscaled, rtol=1e-9)
    assert not np.any(natural_gradients(policy, parameters, batch, np.zeros_like(gradients)))


def test_a_large_batch_is_thinned_out_without_random_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    policy, batch, parameters = policy_and_batch(BOX, [4])
    gradients = np.random.default_rng(0).normal(size=(1, sum(parameter.numel() for parameter in parameters)))
    monkeypatch.setattr("sb3_gae.update.natural_gradients._MOST_SAMPLES", 15)
    state = th.get_rng_state()
    found = natural_gradients(policy, parameters, batch, gradients)
    assert th.equal(th.get_rng_state(), state)
    third = batch.take(th.arange(0, 40, 3))
    np.testing.assert_array_equal(found, natural_gradients(policy, parameters, third, gradients))


def test_other_policies_are_refused() -> None:
    policy = double_policy(BOX, net_arch=[4], use_sde=True)
    batch = training_batch(policy, 5)
    parameters = policy_parameters(policy, batch)
    assert not has_natural_gradients(policy, parameters, batch)
    with pytest.raises(ValueError, match="Natural gradients need a policy that is an MLP"):
        natural_gradients(policy, parameters, batch, np.zeros((1, 3)))
