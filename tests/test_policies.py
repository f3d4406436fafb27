"""Training works with every kind of policy, and each step moves what belongs to it."""

from typing import Any

import pytest
import torch as th
from envs_for_tests import (
    CHANNEL_FIRST,
    SMALL,
    AnySpacesEnv,
    KLProbe,
    check_training,
    differing,
    distribution_bits,
    small_model,
    state_of,
    train_once,
    vec_env,
)
from gymnasium import spaces
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, MlpExtractor, NatureCNN
from torch import nn

import sb3_gae.trpo_gae
from sb3_gae import TRPOGAE, MlpPolicy
from sb3_gae.networks.value_head import ValueHead
from sb3_gae.rollout.evaluation import training_batch
from sb3_gae.update.policy_step import policy_parameters
from sb3_gae.update.value_step import value_parameters

# What belongs to which step


class OwnExtractor(BaseFeaturesExtractor):
    def __init__(self, observation_space: spaces.Box):
        super().__init__(observation_space, features_dim=6)
        self.layer = nn.Linear(3, 6)

    def forward(self, observations: th.Tensor) -> th.Tensor:
        return th.tanh(self.layer(observations))


class MisleadingBody(nn.Module):
    """Names are the wrong way round: the policy's layer is called value, the value function's is called policy."""

    def __init__(self, features_dim: int):
        super().__init__()
        self.latent_dim_pi = self.latent_dim_vf = 8
        self.value_layer = nn.Linear(features_dim, 8)
        self.policy_layer = nn.Linear(features_dim, 8)

    def forward(self, features: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        return self.forward_actor(features), self.forward_critic(features)

    def forward_actor(self, features: th.Tensor) -> th.Tensor:
        return th.tanh(self.value_layer(features))

    def forward_critic(self, features: th.Tensor) -> th.Tensor:
        return th.tanh(self.policy_layer(features))


class MisleadingNames(ActorCriticPolicy):
    def _build_mlp_extractor(self) -> None:
        self.mlp_extractor = MisleadingBody(self.features_dim)


class SharedBody(MisleadingBody):
    """One layer that both need, and one for each."""

    def __init__(self, features_dim: int):
        super().__init__(8)
        self.shared = nn.Linear(features_dim, 8)

    def forward_actor(self, features: th.Tensor) -> th.Tensor:
        return super().forward_actor(th.tanh(self.shared(features)))

    def forward_critic(self, features: th.Tensor) -> th.Tensor:
        return super().forward_critic(th.tanh(self.shared(features)))


class SharedLayers(MlpPolicy):
    def _build_mlp_extractor(self) -> None:
        self.mlp_extractor = SharedBody(self.features_dim)


class OwnValues(ActorCriticPolicy):
    """Computes values in its own way."""

    def predict_values(self, obs: Any) -> th.Tensor:
        return 3.0 * super().predict_values(obs) + 1.0

    def evaluate_actions(self, obs: Any, actions: th.Tensor) -> tuple[th.Tensor, th.Tensor, th.Tensor | None]:
        _, log_prob, entropy = super().evaluate_actions(obs, actions)
        return self.predict_values(obs), log_prob, entropy


class ReadsValues(MlpPolicy):
    """Actions that depend on the value function."""

    def get_distribution(self, obs: Any) -> Any:
        distribution = super().get_distribution(obs)
        return distribution.proba_distribution(distribution.distribution.mean + self.predict_values(obs), self.log_std)


POLICIES: dict[str, tuple[Any, dict[str, Any]]] = {
    "separate networks": ("MlpPolicy", SMALL),
    "no hidden layer": ("MlpPolicy", {"net_arch": []}),
    "networks of different depth": ("MlpPolicy", {"net_arch": {"pi": [8, 7, 6], "vf": [5]}, "activation_fn": nn.ReLU}),
    "unusual activation": ("MlpPolicy", SMALL | {"activation_fn": nn.Softplus}),
    "class of ours": (MlpPolicy, SMALL),
    "class of SB3": (ActorCriticPolicy, SMALL),
    "extractor shared": ("MlpPolicy", SMALL | {"features_extractor_class": OwnExtractor}),
    "extractor separate": (
        "MlpPolicy",
        SMALL | {"features_extractor_class": OwnExtractor, "share_features_extractor": False},
    ),
    "extractor shared, class of SB3": (ActorCriticPolicy, SMALL | {"features_extractor_class": OwnExtractor}),
    "misleading names": (MisleadingNames, {}),
    "shared layers": (SharedLayers, {}),
    "shared MLP": ("SharedMlpPolicy", SMALL),
    "values of its own": (OwnValues, SMALL),
}


def model_with(policy: str, **kwargs: Any) -> TRPOGAE:
    kind, policy_kwargs = POLICIES[policy]
    return small_model(vec_env(), kind, policy_kwargs=policy_kwargs, **kwargs)


@pytest.mark.parametrize("policy", POLICIES)
def test_every_kind_of_policy_trains(policy: str) -> None:
    check_training(model_with(policy), iterations=3)


@pytest.mark.parametrize("vf_optimizer", ["trust_region", "adam"])
@pytest.mark.parametrize("policy", POLICIES)
def test_the_value_step_leaves_the_action_distribution_alone(
    policy: str, vf_optimizer: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Bit for bit, while the values do move."""
    model = model_with(policy, vf_optimizer=vf_optimizer, n_critic_updates=2 if vf_optimizer == "adam" else None)
    seen: list[bool] = []
    fit_value = TRPOGAE._fit_value

    def watched(self: TRPOGAE, batch: Any, parameters: Any) -> Any:
        before, values = distribution_bits(self.policy, batch.observations), self.policy.predict_values(batch.observations)
        record = fit_value(self, batch, parameters)
        after = distribution_bits(self.policy, batch.observations)
        assert all(th.equal(old, new) for old, new in zip(before, after, strict=True))
        assert not th.allclose(values, self.policy.predict_values(batch.observations), rtol=1e-4)
        seen.append(True)
        return record

    monkeypatch.setattr(TRPOGAE, "_fit_value", watched)
    train_once(model)
    train_once(model)
    assert len(seen) == 2


@pytest.mark.parametrize("policy", POLICIES)
def test_the_policy_step_leaves_the_value_function_alone_unless_they_share_layers(
    policy: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = model_with(policy)
    monkeypatch.setattr(TRPOGAE, "_fit_value", lambda self, batch, parameters: None)
    monkeypatch.setattr(TRPOGAE, "_log_update", lambda self, policy_record, value_record, value_targets: None)
    train_once(model)
    samples = model.rollout_buffer.batch()
    with th.no_grad():
        values = model.policy.predict_values(samples.observations).flatten()
    shared = "shared" in policy
    assert th.equal(values, samples.old_values) != shared


def groups(model: TRPOGAE) -> tuple[set[str], set[str]]:
    """Names of the parameters of the policy step, and of the value step."""
    train_once(model)
    batch = training_batch(model.rollout_buffer, model.action_space)
    of_policy = policy_parameters(model.policy, batch)
    of_value = value_parameters(model.policy, batch, of_policy)
    names = {id(parameter): name for name, parameter in model.policy.named_parameters()}
    return {names[id(parameter)] for parameter in of_policy}, {names[id(parameter)] for parameter in of_value}


def test_parameters_are_told_apart_by_what_they_influence_and_not_by_their_names() -> None:
    of_policy, of_value = groups(model_with("misleading names"))
    assert of_policy == {
        *("log_std", "action_net.weight", "action_net.bias"),
        *("mlp_extractor.value_layer.weight", "mlp_extractor.value_layer.bias"),
    }
    assert of_value == {
        *("value_net.weight", "value_net.bias"),
        *("mlp_extractor.policy_layer.weight", "mlp_extractor.policy_layer.bias"),
    }


def test_shared_layers_belong_to_the_policy_step_alone() -> None:
    of_policy, of_value = groups(model_with("shared layers"))
    assert {"mlp_extractor.shared.weight", "mlp_extractor.shared.bias"} <= of_policy
    assert not any("shared" in name for name in of_value)


def test_a_value_function_that_actions_depend_on_belongs_to_the_policy_step(monkeypatch: pytest.MonkeyPatch) -> None:
    model = small_model(vec_env(), ReadsValues)
    fit_value = TRPOGAE._fit_value
    moved = []

    def watched(self: TRPOGAE, batch: Any, parameters: Any) -> Any:
        before = state_of(self.policy)
        record = fit_value(self, batch, parameters)
        moved.append(differing(before, state_of(self.policy)))
        return record

    monkeypatch.setattr(TRPOGAE, "_fit_value", watched)
    assert all(train_once(model)["train/is_line_search_success"] == 1.0 for _ in range(2))
    assert moved == [[], []]


def test_separate_extractors_are_each_trained_by_their_step() -> None:
    of_policy, of_value = groups(model_with("extractor separate"))
    assert "pi_features_extractor.layer.weight" in of_policy or "features_extractor.layer.weight" in of_policy
    assert "vf_features_extractor.layer.weight" in of_value


def test_a_frozen_layer_stays_and_the_rest_trains() -> None:
    model = model_with("separate networks")
    frozen = model.policy.mlp_extractor.policy_net[0].weight
    frozen.requires_grad_(False)
    before = state_of(model.policy)
    check_training(model)
    moved = differing(before, state_of(model.policy))
    assert "mlp_extractor.policy_net.0.weight" not in moved
    assert {"action_net.weight", "log_std", "mlp_extractor.policy_net.0.bias"} <= set(moved)


@pytest.mark.parametrize("vf_optimizer", ["trust_region", "adam"])
def test_a_frozen_value_function_stays_and_the_policy_trains(vf_optimizer: str) -> None:
    model = model_with("separate networks", vf_optimizer=vf_optimizer)
    for parameter in [*model.policy.mlp_extractor.value_net.parameters(), *model.policy.value_net.parameters()]:
        parameter.requires_grad_(False)
    before = state_of(model.policy)
    for _ in range(2):
        assert train_once(model)["train/is_line_search_success"] == 1.0
    moved = differing(before, state_of(model.policy))
    assert "action_net.weight" in moved
    assert all("value_net" not in name for name in moved)


def test_a_value_head_that_is_frozen_in_part_keeps_its_scale() -> None:
    model = model_with("separate networks")
    train_once(model)
    model.policy.value_net.bias.requires_grad_(False)
    head = state_of(model.policy.value_net)
    train_once(model)
    assert differing(head, state_of(model.policy.value_net)) == ["weight"]


def test_one_of_two_samples_is_not_few_enough_to_draw() -> None:
    """Batches of whole episodes may be smaller than `n_steps` promises."""
    model = small_model(vec_env(lambda: AnySpacesEnv(length=1), 2), n_episodes=1, sub_sampling_factor=2)
    assert train_once(model)["train/is_line_search_success"] == 1.0


def test_values_of_sb3s_own_policy_class_have_no_running_scale() -> None:
    model = model_with("class of SB3")
    logged = train_once(model)
    assert not isinstance(model.policy.value_net, ValueHead)
    assert "train/value_scale" not in logged


# Layers that are random or have a memory


class NoisyExtractor(BaseFeaturesExtractor):
    """Dropout and batch statistics."""

    def __init__(self, observation_space: spaces.Box):
        super().__init__(observation_space, features_dim=6)
        self.layers = nn.Sequential(nn.Linear(3, 6), nn.BatchNorm1d(6), nn.Tanh(), nn.Dropout(0.5))
        self.modes: list[bool] = []

    def forward(self, observations: th.Tensor) -> th.Tensor:
        self.modes.append(self.training)
        return self.layers(observations)


@pytest.mark.parametrize("vf_optimizer", ["trust_region", "adam"])
def test_dropout_and_batch_statistics_rest_during_an_update(vf_optimizer: str) -> None:
    policy_kwargs = SMALL | {"features_extractor_class": NoisyExtractor, "share_features_extractor": False}
    model = small_model(vec_env(), policy_kwargs=policy_kwargs, vf_optimizer=vf_optimizer)
    model.policy.set_training_mode(True)
    before = state_of(model.policy)
    probe = KLProbe()
    logged = train_once(model, probe)
    moved = differing(before, state_of(model.policy))
    assert any("layers.1.weight" in name for name in moved), "batch normalization is trained"
    assert not any("running" in name or "num_batches" in name for name in moved)
    assert not any(model.policy.pi_features_extractor.modes) and not any(model.policy.vf_features_extractor.modes)
    assert probe.kl() == pytest.approx(logged["train/kl_divergence_loss"], rel=1e-3)


def test_networks_of_the_paper_are_presets() -> None:
    model = small_model(vec_env(), policy_kwargs=sb3_gae.presets.LOCOMOTION_NETWORKS)
    policy_net, value_net = model.policy.mlp_extractor.policy_net, model.policy.mlp_extractor.value_net
    for net in (policy_net, value_net):
        assert [type(layer) for layer in net] == [nn.Linear, nn.Tanh] * 3
        assert [layer.out_features for layer in net[::2]] == [100, 50, 25]
    model = small_model(vec_env(), policy_kwargs=sb3_gae.presets.CARTPOLE_NETWORKS)
    assert len(model.policy.mlp_extractor.policy_net) == 0
    assert [layer.out_features for layer in model.policy.mlp_extractor.value_net[::2]] == [20]


def test_the_default_extractor_of_images_is_sb3s() -> None:
    model = small_model(vec_env(lambda: AnySpacesEnv(CHANNEL_FIRST)), policy_kwargs={}, n_steps=2)
    assert isinstance(model.policy.features_extractor, NatureCNN)
    assert isinstance(model.policy.mlp_extractor, MlpExtractor)
