"""Training, and going on, with a value fit that moves parameters of the policy, too."""

import io
import math
from typing import Any

import numpy as np
import pytest
import torch as th
from envs_for_tests import (
    CHANNEL_FIRST,
    SMALL,
    VECTOR,
    AnySpacesEnv,
    KLProbe,
    differing,
    distribution_bits,
    small_model,
    train_once,
    vec_env,
)
from gymnasium import spaces
from oracles import ACTION_SPACES, state_of
from shared_fits import distribution_of, divergence
from stable_baselines3.common.policies import ActorCriticPolicy

from sb3_gae import TRPOGAE, SharedMlpPolicy
from sb3_gae.update.shared_parameters import policy_step_radius


@pytest.mark.parametrize("fraction", [0.0, 0.01, 0.25, 0.81])
def test_ways_in_the_policys_metric_add_up_to_the_whole(fraction: float) -> None:
    way = math.sqrt(policy_step_radius(0.02, fraction)) + math.sqrt(fraction * 0.02)
    assert way == pytest.approx(math.sqrt(0.02))


def observations_of(name: str) -> spaces.Space:
    return {
        "image": CHANNEL_FIRST,
        "dict": spaces.Dict({"image": CHANNEL_FIRST, "vector": VECTOR}),
    }.get(name, VECTOR)


SETTINGS: dict[str, dict[str, Any]] = {
    "vector": dict(policy="SharedMlpPolicy"),
    "gSDE": dict(policy="SharedMlpPolicy", use_sde=True),
    "image": dict(policy_kwargs={"features_extractor_kwargs": {"features_dim": 8}}),
    "dict": dict(policy="MultiInputPolicy", policy_kwargs=SMALL | {"features_extractor_kwargs": {"cnn_output_dim": 8}}),
    "few samples for curvature": dict(policy="SharedMlpPolicy", curvature_samples=8),
    "discrete": dict(policy="SharedMlpPolicy"),
}


def shared_model(name: str = "vector", **kwargs: Any) -> TRPOGAE:
    actions = {"action_space": spaces.Discrete(4)} if name == "discrete" else {}
    env = vec_env(lambda: AnySpacesEnv(observations_of(name), **actions))
    return small_model(env, **dict(vf_kl_fraction=0.2) | SETTINGS[name] | kwargs)


@pytest.mark.parametrize("name", SETTINGS)
def test_an_update_keeps_to_the_parts_of_the_radius_that_are_meant_for_its_steps(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = shared_model(name)
    fit_value, measured = TRPOGAE._fit_value, []

    def watched(self: TRPOGAE, batch: Any, parameters: Any) -> Any:
        old = distribution_of(self.policy, batch)
        record = fit_value(self, batch, parameters)
        measured.append(divergence(old, distribution_of(self.policy, batch)))
        return record

    monkeypatch.setattr(TRPOGAE, "_fit_value", watched)
    for _ in range(3):
        probe = KLProbe()
        logged = train_once(model, probe)
        assert 0.0 < logged["train/kl_divergence_loss"] <= policy_step_radius(model.target_kl, 0.2)
        assert 0.0 < measured[-1] <= 0.2 * model.target_kl
        assert logged["train/vf_policy_kl"] == pytest.approx(measured[-1], rel=1e-3, abs=1e-7)
        assert probe.kl() <= 1.1 * model.target_kl
        assert logged["train/vf_steps"] >= 1 and logged["train/vf_kl_divergence"] <= model.vf_trust_region


@pytest.mark.parametrize("name", SETTINGS)
def test_with_a_fraction_of_0_the_value_fit_leaves_the_action_distribution_alone(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = shared_model(name, vf_kl_fraction=0.0)
    fit_value, seen = TRPOGAE._fit_value, []

    def watched(self: TRPOGAE, batch: Any, parameters: Any) -> Any:
        before = distribution_bits(self.policy, batch.observations)
        record = fit_value(self, batch, parameters)
        after = distribution_bits(self.policy, batch.observations)
        seen.append(all(th.equal(old, new) for old, new in zip(before, after, strict=True)))
        return record

    monkeypatch.setattr(TRPOGAE, "_fit_value", watched)
    logged = train_once(model)
    assert seen == [True]
    assert "train/vf_policy_kl" not in logged
    assert policy_step_radius(model.target_kl, 0.2) < logged["train/kl_divergence_loss"] <= model.target_kl


@pytest.mark.parametrize("policy", ["MlpPolicy", ActorCriticPolicy])
def test_without_shared_parameters_the_fraction_changes_no_bit(policy: Any) -> None:
    states, logs = [], []
    for fraction in (0.0, 0.3):
        model = small_model(policy=policy, env=vec_env(), policy_kwargs=SMALL, vf_kl_fraction=fraction)
        logs.append([train_once(model) for _ in range(3)])
        states.append(state_of(model.policy))
    assert differing(*states) == []
    for one, other in zip(*logs, strict=True):
        assert {name: value for name, value in one.items() if name.startswith("train/")} == {
            name: value for name, value in other.items() if name.startswith("train/")
        }


def test_a_shared_policy_learns() -> None:
    model = TRPOGAE("SharedMlpPolicy", "CartPole-v1", n_steps=1024, gae_lambda=0.98, vf_kl_fraction=0.05, seed=1)
    model.learn(1024)
    first = np.mean([episode["r"] for episode in model.ep_info_buffer])
    explained = [train_once(model)["train/explained_variance_after"] for _ in range(9)]
    last = np.mean([episode["r"] for episode in list(model.ep_info_buffer)[-10:]])
    assert first < 40.0 and last > 100.0
    assert max(explained) > 0.5


def test_a_shared_model_comes_back_and_goes_on_as_if_it_had_not_stopped() -> None:
    model = shared_model()
    train_once(model)
    file = io.BytesIO()
    model.save(file)
    file.seek(0)
    loaded = TRPOGAE.load(file)
    assert type(loaded.policy) is SharedMlpPolicy and loaded.vf_kl_fraction == 0.2
    assert loaded.policy.mlp_extractor.value_net[0] is loaded.policy.mlp_extractor.policy_net[0]
    states = []
    for each in (model, loaded):
        each.set_env(vec_env())
        each.set_random_seed(7)
        assert "train/vf_policy_kl" in train_once(each)
        states.append(state_of(each.policy))
    assert differing(*states) == []


def test_a_shared_policy_comes_back_on_its_own(tmp_path: Any) -> None:
    policy = SharedMlpPolicy(VECTOR, ACTION_SPACES["Box"], lambda _: 1e-3, **SMALL)
    policy.save(tmp_path / "policy")
    loaded = SharedMlpPolicy.load(tmp_path / "policy")
    assert differing(state_of(policy), state_of(loaded)) == []
    assert loaded.mlp_extractor.value_net[0] is loaded.mlp_extractor.policy_net[0]


@pytest.mark.parametrize(("name", "value"), [("vf_optimizer", "adam"), ("baseline", "time"), ("value_fit_first", True)])
def test_a_fraction_needs_a_trust_region_fit_after_the_policy_step(name: str, value: Any) -> None:
    with pytest.raises(ValueError, match=f"`vf_kl_fraction` = 0.1 .* leave out `{name}` = {value!r}"):
        small_model(vec_env(), vf_kl_fraction=0.1, **{name: value})
    small_model(vec_env(), vf_kl_fraction=0.0, **{name: value})
