"""Networks and policies of one's own, with what SB3 lets them be, train like SB3's."""

from typing import Any

import numpy as np
import pytest
import torch as th
from envs_for_tests import VECTOR, AnySpacesEnv, check_training, differing, small_model, state_of, train_once, vec_env
from gymnasium import spaces
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn

from sb3_gae import TRPOGAE, GradientDiagnosticsCallback, MlpPolicy
from sb3_gae.rollout.collection import ActionSampler

DOUBLE_ACTIONS = spaces.Box(-1.0, 1.0, (2,), np.float64)


class OwnNames(ActorCriticPolicy):
    """Layers and methods of its own, none of them by SB3's names."""

    def _build(self, lr_schedule: Any) -> None:
        self.act, self.judge = nn.Linear(self.features_dim, 2), nn.Linear(self.features_dim, 1)
        self.log_std = nn.Parameter(th.zeros(2))
        self.optimizer = self.optimizer_class(self.parameters(), lr=lr_schedule(1))

    def get_distribution(self, obs: Any) -> Any:
        return self.action_dist.proba_distribution(self.act(obs.float()), self.log_std)

    def predict_values(self, obs: Any) -> th.Tensor:
        return self.judge(obs.float())

    def evaluate_actions(self, obs: Any, actions: th.Tensor) -> Any:
        return self.predict_values(obs), self.get_distribution(obs).log_prob(actions), None

    def _predict(self, observation: Any, deterministic: bool = False) -> th.Tensor:
        return self.get_distribution(observation).get_actions(deterministic)


class DoublePrecision(OwnNames):
    """Its parameters are doubles; observations come as they are."""

    def _build(self, lr_schedule: Any) -> None:
        super()._build(lr_schedule)
        self.double()

    def get_distribution(self, obs: Any) -> Any:
        return self.action_dist.proba_distribution(self.act(obs), self.log_std)

    def predict_values(self, obs: Any) -> th.Tensor:
        return self.judge(obs)


class ColumnValues(MlpPolicy):
    def predict_values(self, obs: Any) -> th.Tensor:
        return super().predict_values(obs)


class Doubles(BaseFeaturesExtractor):
    """SB3 makes single precision of all observations before."""

    def __init__(self, observation_space: spaces.Box):
        super().__init__(observation_space, features_dim=3)

    def forward(self, observations: th.Tensor) -> th.Tensor:
        return observations.double()


class DoubleMlp(MlpPolicy):
    def _build(self, lr_schedule: Any) -> None:
        super()._build(lr_schedule)
        self.double()


class FlatValues(MlpPolicy):
    def predict_values(self, obs: Any) -> th.Tensor:
        return super().predict_values(obs).flatten()


def test_values_may_come_without_an_axis_of_their_own() -> None:
    """SB3 flattens them in any case."""
    states = []
    for policy in (ColumnValues, FlatValues):
        model = small_model(vec_env(), policy)
        check_training(model)
        states.append(state_of(model.policy))
    assert differing(*states) == []


class Attentive(BaseFeaturesExtractor):
    """Two layers of attention over the numbers of a vector."""

    def __init__(self, observation_space: spaces.Box):
        super().__init__(observation_space, features_dim=12)
        self.embed = nn.Linear(1, 4)
        self.layers = nn.Sequential(*(nn.TransformerEncoderLayer(4, 2, 8, batch_first=True) for _ in range(2)))

    def forward(self, observations: th.Tensor) -> th.Tensor:
        return self.layers(self.embed(observations[..., None])).flatten(1)


@pytest.mark.parametrize("share", [True, False])
def test_attention_is_differentiated_twice(share: bool) -> None:
    policy_kwargs = {"net_arch": [], "features_extractor_class": Attentive, "share_features_extractor": share}
    check_training(small_model(vec_env(), policy_kwargs=policy_kwargs))


class Residual(nn.Sequential):
    """Layers like SB3's, and a way past them."""

    def forward(self, input: th.Tensor) -> th.Tensor:
        return input.sum(dim=1, keepdim=True) + super().forward(input)


class Branched(nn.Module):
    """The layers, without their order."""

    def __init__(self, *layers: nn.Module):
        super().__init__()
        self.layers = nn.ModuleDict({str(number): layer for number, layer in enumerate(layers)})

    def forward(self, features: th.Tensor) -> th.Tensor:
        for layer in self.layers.values():
            features = layer(features)
        return features


@pytest.mark.parametrize("body", ["policy_net", "value_net"])
@pytest.mark.parametrize("kind", [Residual, Branched])
def test_hidden_layers_may_be_any_module(kind: type[nn.Module], body: str) -> None:
    model = small_model(vec_env())
    extractor = model.policy.mlp_extractor
    setattr(extractor, body, kind(*getattr(extractor, body)))
    check_training(model)
    assert_drawn_as_judged(model)


def assert_drawn_as_judged(model: TRPOGAE) -> None:
    """The actions of a rollout are those of the distribution that the update takes them to be of."""
    observations = th.linspace(-1.0, 1.0, 6).reshape(2, 3)
    th.manual_seed(0)
    with th.no_grad():
        expected = model.policy.get_distribution(observations).sample()
    th.manual_seed(0)
    th.testing.assert_close(th.as_tensor(ActionSampler(model.policy)(observations.numpy(), 0)), expected)


@pytest.mark.parametrize("shape", [(), (1,), (1, 2)], ids=str)
def test_actions_may_share_their_deviations(shape: tuple[int, ...]) -> None:
    model = small_model(vec_env())
    model.policy.log_std = nn.Parameter(th.zeros(shape))
    check_training(model)
    assert_drawn_as_judged(model)
    assert model.policy.log_std.abs().min() > 0.0


@pytest.mark.parametrize("shape", [(), (2,)], ids=str)
@pytest.mark.parametrize("is_buffer", [True, False], ids=["buffer", "tensor"])
def test_deviations_may_be_constants(is_buffer: bool, shape: tuple[int, ...]) -> None:
    model = small_model(vec_env())
    del model.policy.log_std
    constant = th.full(shape, -0.5)
    if is_buffer:
        model.policy.register_buffer("log_std", constant)
    else:
        model.policy.log_std = constant
    check_training(model)
    assert_drawn_as_judged(model)
    assert (model.policy.log_std == -0.5).all()


@pytest.mark.parametrize("activation", [nn.LeakyReLU(-0.1), nn.ELU(-1.0)], ids=["leaky relu", "elu"])
def test_activations_may_fall_where_their_inputs_rise(activation: nn.Module) -> None:
    check_training(small_model(vec_env(), policy_kwargs={"net_arch": [8], "activation_fn": lambda: activation}))


def test_hooks_on_gradients_of_parameters_count_while_they_are_there() -> None:
    """What SB3's own algorithms leave alone, for its gradient is masked."""
    model = small_model(vec_env())
    policy = model.policy
    parameters = [
        policy.log_std,
        policy.action_net.weight,
        policy.mlp_extractor.policy_net[0].bias,
        policy.value_net.weight,
        policy.mlp_extractor.value_net[0].weight,
    ]

    def only_first(gradient: th.Tensor) -> th.Tensor:
        mask = th.zeros_like(gradient)
        mask.view(-1)[0] = 1.0
        return mask * gradient

    def moved() -> list[list[bool]]:
        # Weights of the last value layer follow the scale of the targets
        scale = policy.value_net.scale.clone()
        before = [parameter.detach().clone() for parameter in parameters]
        check_training(model, 1)
        before[3] *= scale / policy.value_net.scale
        return [(now != then).flatten().tolist() for now, then in zip(parameters, before, strict=True)]

    train_once(model)  # sets that scale
    hooks = [parameter.register_hook(only_first) for parameter in parameters]
    for which in moved():
        assert which[0]
        assert not any(which[1:])
    for hook in hooks:
        hook.remove()
    assert all(all(which) for which in moved())


@pytest.mark.parametrize("register", ["register_full_backward_hook", "register_full_backward_pre_hook"])
def test_hooks_on_gradients_of_modules_count_while_they_are_there(register: str) -> None:
    model = small_model(vec_env())
    policy = model.policy

    def without_gradients(module: nn.Module, *gradients: Any) -> Any:
        return tuple(None if gradient is None else 0.0 * gradient for gradient in gradients[0])

    # By the one of what goes into the last layer, by the other of what comes out of it
    before = state_of(policy)
    hook = getattr(policy.action_net, register)(without_gradients)
    check_training(model)
    changed = differing(before, state_of(policy))
    assert not [name for name in changed if "policy_net" in name]
    assert "log_std" in changed
    assert ("action_net.weight" in changed) == (register == "register_full_backward_hook")
    hook.remove()
    check_training(model, 1)
    assert [name for name in differing(before, state_of(policy)) if "policy_net" in name]


@pytest.mark.parametrize("options", [{}, {"vf_optimizer": "adam"}, {"baseline": "time"}, {"gae_lambda": "auto"}], ids=str)
def test_a_policy_in_double_precision_gets_the_observations_in_it_wherever_it_is_asked(options: dict[str, Any]) -> None:
    env = vec_env(lambda: AnySpacesEnv(spaces.Box(-1.0, 1.0, (3,), np.float64), DOUBLE_ACTIONS))
    model = small_model(env, DoublePrecision, policy_kwargs={}, **options)
    for _ in range(2):
        assert train_once(model, GradientDiagnosticsCallback([0.9]))["train/is_line_search_success"] == 1.0
    assert {parameter.dtype for parameter in model.policy.parameters()} == {th.float64}


@pytest.mark.parametrize("actions", [DOUBLE_ACTIONS, spaces.Discrete(3), spaces.MultiBinary(2)], ids=str)
@pytest.mark.parametrize("share", [True, False])
def test_an_mlp_in_double_precision_trains(share: bool, actions: spaces.Space) -> None:
    env = vec_env(lambda: AnySpacesEnv(VECTOR, actions))
    policy_kwargs = {"net_arch": [8], "features_extractor_class": Doubles, "share_features_extractor": share}
    check_training(small_model(env, DoubleMlp, policy_kwargs=policy_kwargs))


def test_a_policy_needs_none_of_sb3s_layers() -> None:
    check_training(small_model(vec_env(), OwnNames, policy_kwargs={}))


def test_a_compiled_policy_trains(monkeypatch: pytest.MonkeyPatch) -> None:
    # Compiling switches the check of every distribution off, and for the whole process
    monkeypatch.setattr(th.distributions.Distribution, "_validate_args", True)
    model = small_model(vec_env())
    model.policy = th.compile(model.policy, backend="eager")  # type: ignore[assignment]
    check_training(model)


def test_values_of_weights_that_are_computed_from_others_have_no_running_scale() -> None:
    model = small_model(vec_env())
    nn.utils.parametrizations.weight_norm(model.policy.value_net)
    check_training(model)
    assert model.policy.value_net.scale == 1.0


@pytest.mark.parametrize("where", ["policy", "extractor", "layer"])
def test_methods_of_one_object_count_where_actions_are_drawn_and_where_they_are_judged(where: str) -> None:
    model = small_model(vec_env())
    policy = model.policy
    owner, method = {
        "policy": (policy, "_get_action_dist_from_latent"),
        "extractor": (policy.mlp_extractor, "forward_actor"),
        "layer": (policy.action_net, "forward"),
    }[where]
    original, calls = getattr(owner, method), []

    def counted(*args: Any) -> Any:
        calls.append(True)
        return original(*args)

    setattr(owner, method, counted)
    train_once(model)
    assert len(calls) > model.n_steps
