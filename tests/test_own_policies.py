"""Networks and policies of one's own, with what SB3 lets them be, train like SB3's."""

from typing import Any

import pytest
import torch as th
from envs_for_tests import check_training, differing, small_model, state_of, train_once, vec_env
from gymnasium import spaces
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn

from sb3_gae import MlpPolicy


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


class ColumnValues(MlpPolicy):
    def predict_values(self, obs: Any) -> th.Tensor:
        return super().predict_values(obs)


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
