"""Policy gradients by groups against one backward pass a sample, for every kind of policy."""

from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from oracles import ACTION_SPACES, OF_IMAGES, double_policy, jacobian, training_batch
from tabular_oracles import random_policy

from sb3_gae import MlpPolicy, MultiInputPolicy
from sb3_gae.diagnostics import policy_gradients as module
from sb3_gae.diagnostics.policy_gradients import policy_gradients
from sb3_gae.gridworld import episode_advantages, episode_gradients, gridworld, sample_episodes
from sb3_gae.update.policy_step import policy_parameters

N_SAMPLES = 30

POLICIES: dict[str, dict[str, Any]] = {
    **{name: dict(action_space=space) for name, space in ACTION_SPACES.items()},
    "gSDE": dict(action_space=ACTION_SPACES["Box"], use_sde=True),
    "images": dict(action_space=ACTION_SPACES["Discrete"], **OF_IMAGES),
    "linear": dict(action_space=ACTION_SPACES["Box"], net_arch=[]),
}


@pytest.mark.parametrize("name", POLICIES)
@pytest.mark.parametrize("chunk_rows", [4096, 7])
def test_equals_sums_of_single_gradients(name: str, chunk_rows: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_CHUNK_ROWS", chunk_rows)
    policy = double_policy(**POLICIES[name])
    batch = training_batch(policy, N_SAMPLES)
    parameters = policy_parameters(policy, batch)
    generator = np.random.default_rng(0)
    advantages, groups = generator.normal(size=(3, N_SAMPLES)), generator.integers(-1, 4, N_SAMPLES)
    scores = jacobian(lambda: policy.get_distribution(batch.observations).log_prob(batch.actions), parameters).numpy()
    expected = np.stack([advantages[:, groups == group] @ scores[groups == group] for group in range(4)])
    actual = policy_gradients(policy, parameters, batch.observations, batch.actions, advantages, groups)
    np.testing.assert_allclose(actual, expected, rtol=1e-10, atol=1e-12)
    alone = policy_gradients(policy, parameters, batch.observations, batch.actions, advantages)
    np.testing.assert_allclose(alone, (advantages @ scores)[None], rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("name", POLICIES)
def test_order_is_that_of_the_parameters_asked_for_and_nothing_is_left_behind(name: str) -> None:
    policy = double_policy(**POLICIES[name])
    batch = training_batch(policy, N_SAMPLES)
    parameters = policy_parameters(policy, batch)
    advantages = np.random.default_rng(0).normal(size=(2, N_SAMPLES))
    forwards, backwards = (
        policy_gradients(policy, order, batch.observations, batch.actions, advantages)
        for order in (parameters, parameters[::-1])
    )
    sizes = np.cumsum([parameter.numel() for parameter in parameters])[:-1]
    turned = np.concatenate(np.split(forwards, sizes, axis=2)[::-1], axis=2)
    np.testing.assert_allclose(backwards, turned, rtol=1e-12)
    assert all(parameter.grad is None for parameter in policy.parameters())


def test_a_table_of_logits_has_the_tabular_gradient() -> None:
    """One layer on one-hot states is the gridworld's policy, in single precision."""
    table = random_policy(gridworld(), 0)
    policy = MlpPolicy(spaces.Discrete(25), spaces.Discrete(4), lambda _: 1e-3, net_arch=[])
    with th.no_grad():
        policy.action_net.weight.copy_(th.as_tensor(table.logits.T))
        policy.action_net.bias.zero_()
    episodes = sample_episodes(table, 20, np.random.default_rng(0))
    signal = episode_advantages(table, episodes, np.zeros(25), 0.9, 0.7)
    groups = np.broadcast_to(np.arange(20), signal.shape)[episodes.mask]
    observations = th.as_tensor(episodes.states[episodes.mask])
    actions = th.as_tensor(episodes.actions[episodes.mask])
    weight = [policy.action_net.weight]
    actual = policy_gradients(policy, weight, observations, actions, signal[episodes.mask][None], groups)
    expected = episode_gradients(table, episodes, signal)
    np.testing.assert_allclose(actual.reshape(20, 4, 25).swapaxes(1, 2), expected, rtol=1e-4, atol=1e-5)


def test_refuses_shapes_that_do_not_fit() -> None:
    policy = double_policy(ACTION_SPACES["Discrete"])
    batch = training_batch(policy, N_SAMPLES)
    parameters = policy_parameters(policy, batch)
    for advantages, groups in ((np.ones(N_SAMPLES), None), (np.ones((2, 3)), None), (np.ones((2, N_SAMPLES)), np.zeros(3))):
        with pytest.raises(ValueError, match=r"`advantages` must have the shape \(K, 30\) and `groups` \(30,\), got"):
            policy_gradients(policy, parameters, batch.observations, batch.actions, advantages, groups)


def test_dictionaries_of_observations() -> None:
    space = spaces.Dict({"a": spaces.Box(-1, 1, (2,)), "b": spaces.Discrete(3)})
    policy = MultiInputPolicy(space, spaces.Discrete(4), lambda _: 1e-3, net_arch=[4])
    observations = {"a": th.rand(9, 2), "b": th.arange(9) % 3}
    actions, advantages = th.arange(9) % 4, np.random.default_rng(0).normal(size=(2, 9))
    log_prob = policy.get_distribution(observations).log_prob(actions)
    parameters = [parameter for name, parameter in policy.named_parameters() if "policy" in name or "action" in name]
    actual = policy_gradients(policy, parameters, observations, actions, advantages)[0]
    for row, weights in zip(actual, advantages, strict=True):
        gradients = th.autograd.grad(log_prob, parameters, th.as_tensor(weights, dtype=th.float32), retain_graph=True)
        np.testing.assert_allclose(row, th.cat([each.flatten() for each in gradients]).numpy(), rtol=1e-4, atol=1e-5)
