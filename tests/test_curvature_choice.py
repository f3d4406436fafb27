"""Which policies and value functions have dense products, which fall back to autograd, and which parameters they move."""

from collections.abc import Callable

import pytest
import torch as th
from gymnasium import spaces
from oracles import (
    ACTION_SPACES,
    OF_IMAGES,
    dense_matrix,
    double_policy,
    fisher_matrix,
    training_batch,
)
from stable_baselines3.common.distributions import Distribution
from stable_baselines3.common.policies import ActorCriticPolicy
from torch import nn

from sb3_gae import MlpPolicy, SharedMlpPolicy
from sb3_gae.networks.dense_policy import (
    has_dense_policy,
    has_dense_value,
)
from sb3_gae.update.policy_step import autograd_fisher_product, policy_parameters
from sb3_gae.update.shared_parameters import shared_parameters
from sb3_gae.update.value_step import value_parameters

N_SAMPLES = 7
each_space = pytest.mark.parametrize("action_space", ACTION_SPACES.values(), ids=ACTION_SPACES.keys())


class OtherDistribution(MlpPolicy):
    """Leaves SB3's path from observations to the distribution."""

    def get_distribution(self, obs: th.Tensor) -> Distribution:
        return super().get_distribution(2.0 * obs)


class OtherValues(MlpPolicy):
    """Leaves SB3's path from observations to the value."""

    def predict_values(self, obs: th.Tensor) -> th.Tensor:
        return super().predict_values(obs) + 1.0


def test_policies_that_override_how_they_are_evaluated_fall_back() -> None:
    space = ACTION_SPACES["Box"]
    for policy_class, dense_actor, dense_critic in [(MlpPolicy, 1, 1), (OtherDistribution, 0, 1), (OtherValues, 1, 0)]:
        policy = double_policy(space, policy_class=policy_class)
        batch = training_batch(policy)
        of_policy = policy_parameters(policy, batch)
        assert has_dense_policy(policy, of_policy) == bool(dense_actor)
        assert has_dense_value(policy, value_parameters(policy, batch, of_policy)) == bool(dense_critic)


@pytest.mark.parametrize("attribute", ["action_net", "value_net"])
def test_a_hook_on_a_last_layer_falls_back(attribute: str) -> None:
    policy = double_policy(ACTION_SPACES["Box"])
    batch = training_batch(policy)

    def is_dense() -> bool:
        of_policy = policy_parameters(policy, batch)
        of_value = value_parameters(policy, batch, of_policy)
        return has_dense_policy(policy, of_policy) if attribute == "action_net" else has_dense_value(policy, of_value)

    assert is_dense()
    hook = getattr(policy, attribute).register_forward_hook(lambda module, inputs, output: 2.0 * output)
    assert not is_dense()
    hook.remove()
    assert is_dense()


def are_dense(policy: ActorCriticPolicy) -> tuple[bool, bool]:
    """Whether the policy and its value function are; the latter of its own parameters alone."""
    batch = training_batch(policy)
    of_policy = policy_parameters(policy, batch)
    of_value = value_parameters(policy, batch, of_policy)
    return has_dense_policy(policy, of_policy), has_dense_value(policy, of_value)


class Residual(nn.Sequential):
    """Layers like SB3's, and a way past them."""

    def forward(self, input: th.Tensor) -> th.Tensor:
        return input.sum(dim=1, keepdim=True) + super().forward(input)


class Wrapped(nn.Module):
    """Nothing to iterate over."""

    def __init__(self, layers: nn.Module):
        super().__init__()
        self.layers = layers

    def forward(self, features: th.Tensor) -> th.Tensor:
        return self.layers(features)


@pytest.mark.parametrize("wrap", [lambda layers: Residual(*layers), Wrapped, nn.DataParallel, nn.Sequential])
@pytest.mark.parametrize("body", ["policy_net", "value_net"])
def test_hidden_layers_that_are_not_a_plain_sequence_fall_back(body: str, wrap: Callable[[nn.Module], nn.Module]) -> None:
    policy = double_policy(ACTION_SPACES["Box"])
    extractor = policy.mlp_extractor
    setattr(extractor, body, wrap(getattr(extractor, body)))
    assert are_dense(policy) == (body != "policy_net", body != "value_net")


@pytest.mark.parametrize("attribute", ["action_net", "value_net"])
def test_last_layers_that_only_look_linear_fall_back(attribute: str) -> None:
    policy = double_policy(ACTION_SPACES["Box"])
    # Of the same kind as before, and yet of another class
    layer = getattr(policy, attribute)
    layer.__class__ = type("Own", (type(layer),), {})
    assert are_dense(policy) == (attribute != "action_net", attribute != "value_net")


@pytest.mark.parametrize("register", ["register_full_backward_hook", "register_full_backward_pre_hook"])
@pytest.mark.parametrize("path", ["action_net", "value_net", "mlp_extractor.policy_net.1", "mlp_extractor.value_net.1"])
def test_hooks_on_gradients_of_modules_fall_back_while_they_are_there(path: str, register: str) -> None:
    policy = double_policy(ACTION_SPACES["Box"])
    hook = getattr(policy.get_submodule(path), register)(lambda *_: None)
    assert are_dense(policy) == (False, False)
    hook.remove()
    assert are_dense(policy) == (True, True)


@pytest.mark.parametrize(
    ("name", "dense_actor", "dense_critic"),
    [
        ("log_std", False, True),
        ("action_net.weight", False, True),
        ("mlp_extractor.policy_net.0.bias", False, True),
        ("value_net.bias", True, False),
        ("mlp_extractor.value_net.0.weight", True, False),
    ],
)
def test_hooks_on_gradients_of_parameters_fall_back_where_these_belong_while_they_are_there(
    name: str, dense_actor: bool, dense_critic: bool
) -> None:
    policy = double_policy(ACTION_SPACES["Box"])
    hook = policy.get_parameter(name).register_hook(lambda gradient: 0.0 * gradient)
    assert are_dense(policy) == (dense_actor, dense_critic)
    hook.remove()
    assert are_dense(policy) == (True, True)


def test_a_hook_on_a_shared_layer_counts_for_the_value_step_that_moves_it() -> None:
    policy = double_policy(ACTION_SPACES["Box"], policy_class=SharedMlpPolicy, net_arch=[5, 4])
    batch = training_batch(policy)
    policy.mlp_extractor.policy_net[0].weight.register_hook(lambda gradient: 0.0 * gradient)
    of_policy = policy_parameters(policy, batch)
    own = value_parameters(policy, batch, of_policy)
    shared = shared_parameters(policy, batch, of_policy)
    assert not has_dense_policy(policy, of_policy)
    # To the first of these steps the layer is a constant
    assert has_dense_value(policy, own)
    assert not has_dense_value(policy, [*own, *shared])


@pytest.mark.parametrize("shape", [(), (1,), (1, 2)], ids=str)
def test_deviations_that_actions_share_fall_back_to_a_true_fisher_matrix(shape: tuple[int, ...]) -> None:
    policy = double_policy(ACTION_SPACES["Box"])
    policy.log_std = nn.Parameter(th.full(shape, -0.3, dtype=th.float64))
    assert are_dense(policy) == (False, True)
    batch = training_batch(policy, N_SAMPLES)
    parameters = policy_parameters(policy, batch)
    assert any(parameter is policy.log_std for parameter in parameters)
    expected = fisher_matrix(policy, batch.observations, parameters)
    matrix = dense_matrix(autograd_fisher_product(policy, parameters, batch.observations), len(expected))
    th.testing.assert_close(matrix, expected, rtol=1e-8, atol=1e-8)


def test_frozen_layers_fall_back() -> None:
    policy = double_policy(ACTION_SPACES["Box"])
    policy.mlp_extractor.policy_net[0].requires_grad_(False)
    batch = training_batch(policy)
    of_policy = policy_parameters(policy, batch)
    assert len(of_policy) == 5  # of 2 weights, 2 biases, a log-deviation and the frozen two
    assert not has_dense_policy(policy, of_policy)
    assert has_dense_value(policy, value_parameters(policy, batch, of_policy))


def test_values_on_features_of_their_own_fall_back() -> None:
    policy = double_policy(ACTION_SPACES["Discrete"], **OF_IMAGES, share_features_extractor=False)
    batch = training_batch(policy, N_SAMPLES)
    parameters = value_parameters(policy, batch, policy_parameters(policy, batch))
    own = {id(parameter) for parameter in policy.vf_features_extractor.parameters()}
    assert own <= {id(parameter) for parameter in parameters}
    assert not has_dense_value(policy, parameters)


# --- Which parameters ---


class MisleadingNames(nn.Module):
    """Layers named after what they do not do, and one that nothing uses."""

    def __init__(self, n_inputs: int):
        super().__init__()
        self.latent_dim_pi, self.latent_dim_vf = 4, 5
        self.value_trunk = nn.Sequential(nn.Linear(n_inputs, 4), nn.Tanh())
        self.policy_trunk = nn.Sequential(nn.Linear(n_inputs, 5), nn.Tanh())
        self.policy_unused = nn.Linear(n_inputs, 4)

    def forward(self, features: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        return self.forward_actor(features), self.forward_critic(features)

    def forward_actor(self, features: th.Tensor) -> th.Tensor:
        return self.value_trunk(features)

    def forward_critic(self, features: th.Tensor) -> th.Tensor:
        return self.policy_trunk(features)


class MisleadingPolicy(MlpPolicy):
    def _build_mlp_extractor(self) -> None:
        self.mlp_extractor = MisleadingNames(self.features_dim)


def names_of(policy: ActorCriticPolicy, parameters: list[th.Tensor]) -> set[str]:
    names = {id(parameter): name for name, parameter in policy.named_parameters()}
    return {names[id(parameter)] for parameter in parameters}


def test_parameters_are_found_by_what_they_influence_not_by_name() -> None:
    policy = double_policy(ACTION_SPACES["Box"], policy_class=MisleadingPolicy)
    batch = training_batch(policy)
    of_policy = policy_parameters(policy, batch)
    of_value = value_parameters(policy, batch, of_policy)
    trunk, last = "mlp_extractor.value_trunk.0.", "action_net."
    assert names_of(policy, of_policy) == {"log_std", f"{trunk}weight", f"{trunk}bias", f"{last}weight", f"{last}bias"}
    trunk, last = "mlp_extractor.policy_trunk.0.", "value_net."
    assert names_of(policy, of_value) == {f"{trunk}weight", f"{trunk}bias", f"{last}weight", f"{last}bias"}
    assert not has_dense_policy(policy, of_policy)
    assert not has_dense_value(policy, of_value)


@each_space
def test_policy_and_value_share_no_parameter_and_leave_none_out(action_space: spaces.Space) -> None:
    for kwargs in ({}, OF_IMAGES):
        policy = double_policy(action_space, **kwargs)
        batch = training_batch(policy, 3)
        of_policy = names_of(policy, policy_parameters(policy, batch))
        of_value = names_of(policy, value_parameters(policy, batch, policy_parameters(policy, batch)))
        assert not of_policy & of_value
        assert of_policy | of_value == {name for name, _ in policy.named_parameters()}
        assert not any("value_net" in name for name in of_policy)
        assert not any("features_extractor" in name for name in of_value)
