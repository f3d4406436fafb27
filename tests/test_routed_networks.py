"""Networks that choose by what they see which of their layers a sample goes through."""

from typing import Any

import pytest
import torch as th
from envs_for_tests import VECTOR, AnySpacesEnv, KLProbe, small_model, train_once, vec_env
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn

import sb3_gae.batch
from sb3_gae import TRPOGAE
from sb3_gae.rollout.evaluation import training_batch


class Routed(BaseFeaturesExtractor):
    """An expert for small first numbers and one for large ones; samples that there are none of leave no trace in the graph."""

    def __init__(self, observation_space: spaces.Box):
        super().__init__(observation_space, features_dim=6)
        self.experts = nn.ModuleList(nn.Linear(3, 6) for _ in range(2))

    def forward(self, observations: th.Tensor) -> th.Tensor:
        features = observations.new_zeros(len(observations), 6)
        for expert, chosen in zip(self.experts, (observations[:, 0] < 0.5, observations[:, 0] >= 0.5), strict=True):
            if chosen.any():
                features = features.index_put((chosen.nonzero()[:, 0],), th.tanh(expert(observations[chosen])))
        return features


def routed_model(**kwargs: Any) -> TRPOGAE:
    policy_kwargs = {"net_arch": [], "features_extractor_class": Routed} | kwargs.pop("policy_kwargs", {})
    return small_model(vec_env(lambda: AnySpacesEnv(VECTOR)), policy_kwargs=policy_kwargs, **kwargs)


def moved_experts(model: TRPOGAE, extractor: str, iterations: int = 1) -> list[bool]:
    experts = getattr(model.policy, extractor).experts
    before = [expert.weight.detach().clone() for expert in experts]
    for _ in range(iterations):
        train_once(model)
    return [not th.equal(old, expert.weight) for old, expert in zip(before, experts, strict=True)]


@pytest.mark.parametrize("rows", [None, 5])
def test_what_any_sample_goes_through_belongs_to_its_step(rows: int | None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where the batch is looked through in pieces."""
    if rows is not None:
        monkeypatch.setattr(sb3_gae.batch, "_CHUNK_VALUES", 3 * rows)
    model = routed_model(policy_kwargs={"share_features_extractor": False}, vf_kl_fraction=0.1)
    train_once(model)
    batch = training_batch(model.rollout_buffer, model.action_space)
    large = batch.observations[:, 0] >= 0.5
    assert 0 < large.sum() < len(batch)
    for subset, experts in ((large.nonzero()[:, 0], {"1"}), ((~large).nonzero()[:, 0], {"0"}), (None, {"0", "1"})):
        groups = model._parameter_groups(batch.take(subset))
        names = {id(parameter): name for name, parameter in model.policy.named_parameters()}
        for part, extractor in ((groups.of_policy, "features_extractor"), (groups.of_value, "vf_features_extractor")):
            found = [names[id(parameter)] for parameter in part]
            assert {name.split(".")[2] for name in found if name.startswith(f"{extractor}.experts")} == experts
    assert groups.of_both == []


@pytest.mark.parametrize("share", [True, False])
def test_all_experts_are_trained(share: bool) -> None:
    model = routed_model(policy_kwargs={"share_features_extractor": share})
    assert moved_experts(model, "pi_features_extractor") == [True, True]
    assert moved_experts(model, "vf_features_extractor") == [True, True]


@pytest.mark.parametrize("batch_size", [1, 3])
def test_adam_leaves_alone_what_no_sample_of_a_minibatch_goes_through(batch_size: int) -> None:
    """A minibatch of one sample misses one of the experts; of those of three some do."""
    policy_kwargs = {"share_features_extractor": False}
    model = routed_model(vf_optimizer="adam", batch_size=batch_size, policy_kwargs=policy_kwargs)
    assert moved_experts(model, "vf_features_extractor") == [True, True]
    assert all(parameter.grad is None for parameter in model.policy.parameters())


def test_adam_passes_over_minibatches_that_reach_nothing_trainable() -> None:
    model = routed_model(vf_optimizer="adam", batch_size=1, policy_kwargs={"share_features_extractor": False})
    extractor: Any = model.policy.vf_features_extractor
    for frozen in (model.policy.value_net, extractor.experts[0]):
        frozen.requires_grad_(False)
    assert moved_experts(model, "vf_features_extractor") == [False, True]


def test_the_value_fit_leaves_alone_what_the_policy_depends_on_in_any_state(monkeypatch: pytest.MonkeyPatch) -> None:
    """The critic sees what both experts say; the actor, in any one state, what one of them does."""
    model = routed_model()
    extractor = model.policy.features_extractor
    model.policy.value_net = nn.Linear(12, 1)

    def predict_values(observations: th.Tensor) -> th.Tensor:
        everything = th.cat([th.tanh(expert(observations)) for expert in extractor.experts], dim=1)
        return model.policy.value_net(everything)

    monkeypatch.setattr(model.policy, "predict_values", predict_values)
    monkeypatch.setattr(
        model.policy,
        "evaluate_actions",
        lambda observations, actions: (
            predict_values(observations),
            model.policy.get_distribution(observations).log_prob(actions),
            None,
        ),
    )
    for _ in range(3):
        probe = KLProbe()
        logged = train_once(model, probe)
        assert probe.kl() == pytest.approx(logged["train/kl_divergence_loss"], rel=1e-3)
        assert probe.kl() <= model.target_kl * (1.0 + 1e-3)
