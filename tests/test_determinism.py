"""The same seed gives the same parameters, and the unit of the reward makes no difference."""

from typing import Any

import numpy as np
import pytest
import torch as th
from envs_for_tests import (
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
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import VecNormalize

import sb3_gae.trpo_gae
from sb3_gae import TRPOGAE

VARIANTS: dict[str, dict[str, Any]] = {
    "defaults": {},
    "one in two samples": {"sub_sampling_factor": 2},
    "few curvature samples": {"curvature_samples": 8},
    "Adam": {"vf_optimizer": "adam", "batch_size": 8},
    "gSDE": {"use_sde": True, "sde_sample_freq": 3},
}


def small_model(env: Any = None, policy: Any = "MlpPolicy", **kwargs: Any) -> TRPOGAE:
    return TRPOGAE(policy, env or vec_env(), **({"n_steps": 16, "policy_kwargs": SMALL, "seed": 0} | kwargs))


def trained(env: Any = None, **kwargs: Any) -> dict[str, th.Tensor]:
    """Parameters after three iterations."""
    model = small_model(env, **kwargs)
    model.learn(3 * model.n_steps * model.n_envs)
    return state_of(model.policy)


# Seeds


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("n_envs", [1, 3])
def test_the_same_seed_gives_the_same_parameters(n_envs: int, variant: str) -> None:
    first = trained(vec_env(n_envs=n_envs), seed=5, **VARIANTS[variant])
    # Whatever happened to the generators before
    np.random.normal(size=3)
    th.randn(3)
    assert differing(first, trained(vec_env(n_envs=n_envs), seed=5, **VARIANTS[variant])) == []


def test_different_seeds_give_different_parameters() -> None:
    moved = differing(trained(seed=5), trained(seed=6))
    assert {"action_net.weight", "action_net.bias", "log_std", "value_net.weight"} <= set(moved)


def test_a_seed_can_be_set_later() -> None:
    def trained_from(seed: int) -> dict[str, th.Tensor]:
        model = small_model(seed=0)
        model.set_random_seed(seed)
        model.learn(64)
        return state_of(model.policy)

    assert differing(trained_from(1), trained_from(1)) == []
    assert differing(trained_from(1), trained_from(2)) != []


def test_the_global_seed_of_sb3_counts_where_no_other_is_given() -> None:
    def trained_from(seed: int) -> dict[str, th.Tensor]:
        env = vec_env()
        env.seed(0)
        set_random_seed(seed)
        return trained(env, seed=None)

    assert differing(trained_from(1), trained_from(1)) == []
    assert differing(trained_from(1), trained_from(2)) != []


def test_deterministic_predictions_repeat_and_others_follow_the_seed() -> None:
    model = small_model()
    observations = np.tile(np.float32(0.1), (6, 3))
    for deterministic in (True, False):
        actions = []
        for _ in range(2):
            th.manual_seed(3)
            actions.append(model.predict(observations, deterministic=deterministic)[0])
        np.testing.assert_array_equal(*actions)
        assert (np.ptp(actions[0], axis=0) == 0.0).all() == deterministic


def test_an_update_is_the_same_whatever_else_used_torchs_generator(monkeypatch: pytest.MonkeyPatch) -> None:
    """Unlike sb3-contrib's conjugate gradient, nothing in an update draws from it."""
    states = []
    train = TRPOGAE.train

    def watched(self: TRPOGAE) -> None:
        before = th.get_rng_state()
        train(self)
        states.append(th.equal(before, th.get_rng_state()))

    monkeypatch.setattr(TRPOGAE, "train", watched)
    trained(curvature_samples=8, sub_sampling_factor=2)
    assert states == [True] * 3


# Units of the reward


@pytest.mark.parametrize(
    ("variant", "scale"),
    [*[(variant, 2.0**10) for variant in VARIANTS], *[("defaults", 2.0**power) for power in (-10, 70, -70)]],
)
def test_a_power_of_two_on_the_rewards_changes_no_bit_of_the_policy(variant: str, scale: float) -> None:
    """
    Floating point is exact about such factors, so that any place that forgot the unit shows.

    The squares of the larger ones leave the range of single precision.
    """
    make = lambda reward_scale: vec_env(lambda: AnySpacesEnv(reward_scale=reward_scale))  # noqa: E731
    plain, scaled = trained(make(1.0), **VARIANTS[variant]), trained(make(scale), **VARIANTS[variant])
    assert differing(plain, scaled) == ["value_net.scale"]
    assert scaled["value_net.scale"] == plain["value_net.scale"] * scale


@pytest.mark.parametrize("scale", [1000.0, 1e-3, 3e20, 1e-20])
def test_any_factor_on_the_rewards_gives_the_same_policy_step_but_for_rounding(scale: float) -> None:
    def policy_after_one_step(reward_scale: float) -> dict[str, th.Tensor]:
        model = small_model(vec_env(lambda: AnySpacesEnv(reward_scale=reward_scale)))
        train_once(model)
        return {name: tensor for name, tensor in state_of(model.policy).items() if "value" not in name}

    plain, scaled = policy_after_one_step(1.0), policy_after_one_step(scale)
    for name in plain:
        th.testing.assert_close(scaled[name], plain[name], rtol=1e-5, atol=1e-7)


def test_what_is_logged_about_the_fit_is_finite_and_has_no_unit_but_the_loss() -> None:
    def logged(reward_scale: float) -> dict[str, float]:
        return train_once(small_model(vec_env(lambda: AnySpacesEnv(reward_scale=reward_scale))))

    plain, scaled = logged(1.0), logged(2.0**70)
    for key in ("explained_variance", "explained_variance_after", "vf_kl_divergence", "policy_objective"):
        assert scaled[f"train/{key}"] == pytest.approx(plain[f"train/{key}"], rel=1e-4), key
    assert scaled["train/value_loss"] == pytest.approx(plain["train/value_loss"] * 2.0**140, rel=1e-4)


def test_without_the_running_scale_the_unit_matters() -> None:
    make = lambda reward_scale: vec_env(lambda: AnySpacesEnv(reward_scale=reward_scale))  # noqa: E731
    plain, scaled = (trained(make(scale), normalize_value=False) for scale in (1.0, 1024.0))
    assert "action_net.weight" in differing(plain, scaled)


def test_values_are_in_units_of_the_reward() -> None:
    model = small_model(vec_env(lambda: AnySpacesEnv(reward_scale=1000.0, length=50)), n_steps=64)
    for _ in range(5):
        logged = train_once(model)
    buffer = model.rollout_buffer
    assert 0.1 < np.abs(buffer.values).mean() / np.abs(buffer.returns).mean() < 10.0
    assert logged["train/value_scale"] == pytest.approx(np.sqrt(np.square(buffer.returns).mean()), rel=1.0)


def test_a_task_without_rewards_trains_in_peace() -> None:
    model = small_model(vec_env(lambda: AnySpacesEnv(reward_scale=0.0)))
    for _ in range(2):
        train_once(model)
        assert all(tensor.isfinite().all() for tensor in model.policy.state_dict().values())


# Sub-samples


@pytest.mark.parametrize(
    "observations", [VECTOR, spaces.Dict({"one": VECTOR, "two": spaces.Discrete(3)})], ids=["Box", "Dict"]
)
@pytest.mark.parametrize("factor", [2, 3])
def test_a_sub_sample_is_for_the_policy_step_alone(
    factor: int, observations: spaces.Space, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: dict[str, Any] = {}
    real_policy_step, real_value_steps = sb3_gae.trpo_gae.policy_step, sb3_gae.trpo_gae.value_steps

    def policy_step(policy: Any, parameters: Any, batch: Any, advantages: th.Tensor, *rest: Any) -> Any:
        seen["policy"], seen["advantages"] = batch, advantages
        seen["old"] = policy.get_distribution(batch.observations).log_prob(batch.actions).detach()
        return real_policy_step(policy, parameters, batch, advantages, *rest)

    def value_steps(policy: Any, parameters: Any, batch: Any, *rest: Any) -> Any:
        seen["value"] = batch
        return real_value_steps(policy, parameters, batch, *rest)

    monkeypatch.setattr(sb3_gae.trpo_gae, "policy_step", policy_step)
    monkeypatch.setattr(sb3_gae.trpo_gae, "value_steps", value_steps)
    is_dict = isinstance(observations, spaces.Dict)
    model = small_model(
        vec_env(lambda: AnySpacesEnv(observations)),
        "MultiInputPolicy" if is_dict else "MlpPolicy",
        sub_sampling_factor=factor,
        normalize_advantage=False,
    )
    for _ in range(2):
        logged = train_once(model)
        assert 0.0 < logged["train/kl_divergence_loss"] <= model.target_kl
    buffer = model.rollout_buffer
    assert len(seen["policy"]) == 32 // factor and len(seen["value"]) == 32
    # Observations, actions and advantages of the same samples, each sample once
    positions = [buffer.advantages.flatten().tolist().index(advantage) for advantage in seen["advantages"].tolist()]
    assert len(set(positions)) == 32 // factor
    np.testing.assert_array_equal(seen["policy"].actions, buffer.actions.reshape(32, -1)[positions])
    np.testing.assert_allclose(seen["old"], buffer.log_probs.flatten()[positions], rtol=1e-5)
    found = seen["policy"].observations["one"] if is_dict else seen["policy"].observations
    stored = buffer.observations["one"] if is_dict else buffer.observations
    np.testing.assert_array_equal(found, stored.reshape(32, 3)[positions])


def test_sub_samples_differ_between_iterations(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn = []
    real = sb3_gae.trpo_gae.random_subset
    monkeypatch.setattr(sb3_gae.trpo_gae, "random_subset", lambda *args: (drawn.append(real(*args)), drawn[-1])[1])
    trained(sub_sampling_factor=2, curvature_samples=None)
    subsets = [tuple(subset.tolist()) for subset in drawn if subset is not None]
    assert len(set(subsets)) == 3


@pytest.mark.parametrize("curvature_samples", [2, 8, 31, 32, 1000, None])
def test_the_constraint_holds_on_the_whole_batch_however_few_samples_the_curvature_sees(curvature_samples: int | None) -> None:
    model = small_model(curvature_samples=curvature_samples)
    for _ in range(3):
        probe = KLProbe()
        logged = train_once(model, probe)
        assert probe.kl() == pytest.approx(logged["train/kl_divergence_loss"], rel=1e-3)
        assert logged["train/kl_divergence_loss"] <= model.target_kl


def test_as_many_curvature_samples_as_there_are_is_all_of_them() -> None:
    assert differing(trained(curvature_samples=32), trained(curvature_samples=None)) == []
    assert "action_net.weight" in differing(trained(curvature_samples=31), trained(curvature_samples=None))


# Environments that are wrapped


def test_normalized_environments_repeat() -> None:
    first = trained(VecNormalize(vec_env()))
    assert differing(first, trained(VecNormalize(vec_env()))) == []


def test_predicting_between_iterations_does_not_move_the_policy() -> None:
    model = small_model()
    train_once(model)
    observations = th.rand(4, 3)
    before = distribution_bits(model.policy, observations)
    model.predict(observations.numpy())
    for old, new in zip(before, distribution_bits(model.policy, observations), strict=True):
        assert th.equal(old, new)
