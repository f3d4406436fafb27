"""Training works on every space and with every kind of policy, within the trust region."""

from typing import Any

import numpy as np
import pytest
import torch as th
from envs_for_tests import (
    ACTIONS,
    SMALL,
    VECTOR,
    AnySpacesEnv,
    KLProbe,
    differing,
    distribution_bits,
    state_of,
    train_once,
    vec_env,
)
from gymnasium import spaces
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, MlpExtractor, NatureCNN
from stable_baselines3.common.vec_env import VecEnv, VecFrameStack, VecNormalize, VecTransposeImage, is_vecenv_wrapped
from torch import nn

import sb3_gae.trpo_gae
from sb3_gae import TRPOGAE, MlpPolicy
from sb3_gae.collection import training_batch
from sb3_gae.policy_step import policy_parameters
from sb3_gae.value_head import ValueHead
from sb3_gae.value_step import value_parameters

ACTION_SPACES = {
    "Box": spaces.Box(-1.0, 1.0, (3,), np.float32),
    "Box 2x2": spaces.Box(-1.0, 1.0, (2, 2), np.float32),
    "Box asymmetric": spaces.Box(np.float32([-3.0, 0.5]), np.float32([1.0, 2.0])),
    "Discrete": spaces.Discrete(4),
    "MultiDiscrete": spaces.MultiDiscrete([3, 2]),
    "MultiBinary": spaces.MultiBinary(3),
}

OBSERVATION_SPACES = {
    "Box float32": VECTOR,
    "Box float64": spaces.Box(-1.0, 1.0, (3,), np.float64),
    "Box 2x3": spaces.Box(-1.0, 1.0, (2, 3), np.float32),
    "Discrete": spaces.Discrete(5),
    "MultiDiscrete": spaces.MultiDiscrete([3, 4]),
    "MultiBinary": spaces.MultiBinary(4),
    "Dict": spaces.Dict({"vector": VECTOR, "choice": spaces.Discrete(3), "wide": spaces.Box(-1, 1, (2,), np.float64)}),
}

CHANNEL_FIRST = spaces.Box(0, 255, (1, 36, 36), np.uint8)
CHANNEL_LAST = spaces.Box(0, 255, (36, 36, 3), np.uint8)
SMALL_CNN: dict[str, Any] = {"features_extractor_kwargs": {"features_dim": 8}}


def policy_name(observation_space: spaces.Space) -> str:
    if isinstance(observation_space, spaces.Dict):
        return "MultiInputPolicy"
    return "CnnPolicy" if observation_space.dtype == np.uint8 else "MlpPolicy"


def small_model(env: VecEnv, policy: Any = None, **kwargs: Any) -> TRPOGAE:
    kwargs = {"n_steps": 16, "policy_kwargs": SMALL, "seed": 0} | kwargs
    return TRPOGAE(policy or policy_name(env.observation_space), env, **kwargs)


def check_training(model: TRPOGAE, iterations: int = 2) -> None:
    """Each update moves the policy, by as much as is logged and no more than allowed, and actions lie in their space."""
    for _ in range(iterations):
        probe = KLProbe()
        logged = train_once(model, probe)
        assert logged["train/is_line_search_success"] == 1.0
        assert 0.0 < logged["train/kl_divergence_loss"] <= model.target_kl
        assert probe.kl() == pytest.approx(logged["train/kl_divergence_loss"], rel=1e-3, abs=1e-6)
        assert logged["train/vf_steps"] >= 1
        assert logged["train/vf_kl_divergence"] <= model.vf_trust_region
    assert all(tensor.isfinite().all() for tensor in model.policy.state_dict().values())
    observations = model.get_env().reset()
    for deterministic in (True, False):
        actions, _ = model.predict(observations, deterministic=deterministic)
        assert len(actions) == model.n_envs
        assert all(model.action_space.contains(action) for action in actions)


@pytest.mark.parametrize("observations", OBSERVATION_SPACES)
@pytest.mark.parametrize("actions", ACTION_SPACES)
def test_every_action_space_trains_on_every_observation_space(actions: str, observations: str) -> None:
    check_training(small_model(vec_env(lambda: AnySpacesEnv(OBSERVATION_SPACES[observations], ACTION_SPACES[actions]))))


@pytest.mark.parametrize("actions", ["Box", "Discrete"])
@pytest.mark.parametrize("images", [CHANNEL_FIRST, CHANNEL_LAST], ids=["channel first", "channel last"])
def test_images_train(images: spaces.Box, actions: str) -> None:
    env = vec_env(lambda: AnySpacesEnv(images, ACTION_SPACES[actions]))
    model = small_model(env, policy_kwargs=SMALL_CNN, n_steps=8)
    assert is_vecenv_wrapped(model.get_env(), VecTransposeImage) == (images is CHANNEL_LAST)
    check_training(model)


def test_images_train_with_an_extractor_for_each_step() -> None:
    env = vec_env(lambda: AnySpacesEnv(CHANNEL_FIRST))
    check_training(small_model(env, policy_kwargs=SMALL_CNN | {"share_features_extractor": False}, n_steps=8))


def test_a_dict_with_an_image_trains() -> None:
    observations = spaces.Dict({"image": CHANNEL_FIRST, "vector": VECTOR})
    model = small_model(
        vec_env(lambda: AnySpacesEnv(observations)),
        policy_kwargs=SMALL | {"features_extractor_kwargs": {"cnn_output_dim": 8}},
        n_steps=8,
    )
    check_training(model)


def test_stacked_frames_train() -> None:
    check_training(small_model(VecFrameStack(vec_env(), n_stack=3)))


def test_stacked_image_frames_train() -> None:
    env = VecFrameStack(vec_env(lambda: AnySpacesEnv(CHANNEL_FIRST)), n_stack=2)
    model = small_model(env, policy_kwargs=SMALL_CNN, n_steps=8)
    assert model.observation_space.shape == (2, 36, 36)
    check_training(model)


@pytest.mark.parametrize("observations", ["Box float32", "Dict of vectors"])
def test_normalized_environments_train(observations: str) -> None:
    space = VECTOR if observations == "Box float32" else spaces.Dict({"one": VECTOR, "two": VECTOR})
    env = VecNormalize(vec_env(lambda: AnySpacesEnv(space, reward_scale=50.0)), gamma=0.99)
    model = small_model(env)
    check_training(model)
    assert np.abs(model.rollout_buffer.rewards).max() < 25.0, "the buffer holds what the wrapper makes of the rewards"


def test_discrete_actions_count_from_0_whatever_the_start_of_the_space_as_in_sb3() -> None:
    """SB3's environment checker says that it does not support these; nothing here hides that."""
    with pytest.raises(AssertionError, match=r"is not in Discrete\(3, start=7\)"):
        train_once(small_model(vec_env(lambda: AnySpacesEnv(VECTOR, spaces.Discrete(3, start=7)))))


def test_an_action_space_that_sb3_does_not_know_is_refused() -> None:
    with pytest.raises(AssertionError, match="only supports"):
        small_model(vec_env(lambda: AnySpacesEnv(VECTOR, spaces.Tuple([ACTIONS, ACTIONS]))), "MlpPolicy")


# Generalized state-dependent exploration


@pytest.mark.parametrize("sde_sample_freq", [-1, 4])
@pytest.mark.parametrize("actions", ["Box", "Box asymmetric"])
@pytest.mark.parametrize("squash_output", [False, True])
def test_gsde_trains(squash_output: bool, actions: str, sde_sample_freq: int) -> None:
    # log_std -2: divergences between squashed Gaussians are taken before the squashing
    model = small_model(
        vec_env(lambda: AnySpacesEnv(VECTOR, ACTION_SPACES[actions])),
        use_sde=True,
        sde_sample_freq=sde_sample_freq,
        policy_kwargs=SMALL | {"squash_output": squash_output, "log_std_init": -2.0},
    )
    check_training(model)


@pytest.mark.parametrize("options", [{"full_std": False}, {"use_expln": True}], ids=["one std", "expln"])
def test_gsde_trains_with_its_options(options: dict[str, bool]) -> None:
    check_training(small_model(vec_env(), use_sde=True, policy_kwargs=SMALL | options))


@pytest.mark.parametrize(("sde_sample_freq", "expected"), [(-1, 1), (4, 1 + 4), (16, 1 + 1)])
def test_gsde_noise_is_sampled_as_often_as_asked(sde_sample_freq: int, expected: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Once at the start of a rollout of 16 steps, and then every so many steps, for each environment its own."""
    model = small_model(vec_env(n_envs=2), use_sde=True, sde_sample_freq=sde_sample_freq)
    calls = []
    monkeypatch.setattr(
        model.policy, "reset_noise", lambda n_envs=1, real=model.policy.reset_noise: (calls.append(n_envs), real(n_envs))
    )
    train_once(model)
    assert calls == [2] * expected


def test_squashed_actions_are_scaled_to_the_bounds() -> None:
    space = ACTION_SPACES["Box asymmetric"]
    env = vec_env(lambda: AnySpacesEnv(VECTOR, space))
    model = small_model(env, use_sde=True, policy_kwargs=SMALL | {"squash_output": True, "log_std_init": 2.0})
    sent = []
    step_async = model.env.step_async
    model.env.step_async = lambda actions: (sent.append(actions.copy()), step_async(actions))
    train_once(model)
    raw = model.rollout_buffer.actions
    assert np.abs(raw).max() <= 1.0
    np.testing.assert_allclose(np.array(sent), space.low + 0.5 * (raw + 1.0) * (space.high - space.low), atol=1e-6)
    assert np.array(sent)[..., 0].min() < -2.0, "the noise reaches beyond the part that clipping would have left"


def test_unsquashed_actions_are_clipped_and_the_buffer_keeps_what_was_drawn() -> None:
    space = ACTION_SPACES["Box asymmetric"]
    env = vec_env(lambda: AnySpacesEnv(VECTOR, space))
    model = small_model(env)
    sent = []
    step_async = model.env.step_async
    model.env.step_async = lambda actions: (sent.append(actions.copy()), step_async(actions))
    train_once(model)
    drawn = model.rollout_buffer.actions
    np.testing.assert_array_equal(np.array(sent), np.clip(drawn, space.low, space.high))
    assert (drawn[..., 1] < 0.5).any()


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
    monkeypatch.setattr(TRPOGAE, "_log_update", lambda self, policy_record, value_record: None)
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
    before = {name: parameter.clone() for name, parameter in model.policy.named_parameters()}
    for _ in range(2):
        assert train_once(model)["train/is_line_search_success"] == 1.0
    moved = differing(before, dict(model.policy.named_parameters()))
    assert "action_net.weight" in moved
    assert all("value_net" not in name for name in moved)


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
