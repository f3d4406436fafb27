"""Bad arguments are refused by name, and the edges of what is allowed train."""

import math
from typing import Any

import numpy as np
import pytest
from envs_for_tests import VECTOR, AnySpacesEnv, differing, short_model, state_of, train_once, vec_env
from gymnasium import spaces
from stable_baselines3.common.buffers import RolloutBuffer

from sb3_gae import GAEDictRolloutBuffer, MlpPolicy


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *[(name, value) for name in ("gamma", "gae_lambda", "value_lambda") for value in (-0.1, 1.1, math.nan, "0.9", True)],
        *[(name, value) for name in ("target_kl", "vf_trust_region") for value in (0.0, -0.01, math.nan, math.inf, None)],
        *[(name, value) for name in ("cg_damping", "vf_cg_damping") for value in (-0.1, math.nan, math.inf, None, "none")],
        *[("line_search_shrinking_factor", value) for value in (0.0, 1.0, -0.5, math.nan)],
        *[
            (name, value)
            for name in ("n_steps", "cg_max_steps", "vf_cg_max_steps", "line_search_max_iter", "sub_sampling_factor")
            for value in (0, -1, 2.5, True)
        ],
        *[(name, "False") for name in ("value_fit_first", "normalize_advantage", "normalize_value")],
        *[(name, value) for name in ("vf_steps", "n_critic_updates") for value in (-1, 1.5)],
        *[("batch_size", value) for value in (0, 1.5)],
        *[("curvature_samples", value) for value in (0, 1, 2.5)],
        *[("vf_kl_fraction", value) for value in (-0.1, 1.0, math.nan, "0.1", True, None)],
        *[("vf_optimizer", value) for value in ("Adam", "sgd", None)],
    ],
)
@pytest.mark.filterwarnings("ignore:.*has no effect here")
def test_an_argument_outside_its_domain_is_refused_by_name(name: str, value: Any) -> None:
    with pytest.raises(ValueError, match=f"`{name}` must be") as caught:
        short_model(**{name: value})
    assert repr(value) in str(caught.value), "the message says what was passed"


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *[(name, value) for name in ("gamma", "gae_lambda", "value_lambda") for value in (0, 0.0, 1, np.float32(0.5))],
        *[
            ("cg_damping", 0.0),
            ("vf_cg_damping", 0.0),
            ("vf_cg_damping", "auto"),
            ("curvature_samples", None),
            ("curvature_samples", 2),
        ],
        *[("target_kl", 1e-12), ("target_kl", 100.0), ("vf_trust_region", 1e-12), ("vf_trust_region", 100.0)],
        *[("cg_max_steps", 1), ("vf_cg_max_steps", np.int64(1)), ("line_search_max_iter", 1), ("vf_steps", 0)],
        *[("vf_kl_fraction", value) for value in (0, 1e-12, np.float32(0.99))],
    ],
)
def test_the_edges_of_a_domain_are_inside_and_train(name: str, value: Any) -> None:
    model = short_model(**{name: value})
    logged = train_once(model)
    assert logged["train/kl_divergence_loss"] <= model.target_kl
    assert all(tensor.isfinite().all() for tensor in model.policy.state_dict().values())


@pytest.mark.parametrize(
    ("n_envs", "arguments"),
    [(1, {"n_steps": 1}), (2, {"n_steps": 1, "sub_sampling_factor": 2}), (1, {"sub_sampling_factor": 5})],
)
def test_a_batch_of_one_is_refused(n_envs: int, arguments: dict[str, int]) -> None:
    with pytest.raises(ValueError, match=r"at least 2 samples.*`n_steps`"):
        short_model(vec_env(n_envs=n_envs), **({"n_steps": 8} | arguments))


def test_one_step_of_several_environments_is_a_batch() -> None:
    logged = train_once(short_model(vec_env(n_envs=3), n_steps=1))
    assert 0.0 < logged["train/kl_divergence_loss"] <= 0.01


def test_a_policy_without_trainable_parameters_is_refused() -> None:
    class Frozen(MlpPolicy):
        def _build(self, lr_schedule: Any) -> None:
            super()._build(lr_schedule)
            self.requires_grad_(False)

    with pytest.raises(ValueError, match="no trainable parameters"):
        short_model(policy=Frozen)


def test_a_frozen_action_distribution_is_refused_and_the_value_function_stays() -> None:
    model = short_model(normalize_value=False)
    for parameter in [*model.policy.mlp_extractor.policy_net.parameters(), *model.policy.action_net.parameters()]:
        parameter.requires_grad_(False)
    model.policy.log_std.requires_grad_(False)
    before = state_of(model.policy)
    with pytest.raises(ValueError, match="action distribution depends on no trainable parameter"):
        train_once(model)
    assert differing(before, state_of(model.policy)) == []


@pytest.mark.parametrize("buffer_class", [RolloutBuffer, dict, "GAERolloutBuffer"])
def test_another_kind_of_buffer_is_refused(buffer_class: Any) -> None:
    with pytest.raises(TypeError, match=r"`rollout_buffer_class` must be a subclass of sb3_gae\.GAERolloutBuffer"):
        short_model(rollout_buffer_class=buffer_class)


def test_a_buffer_for_other_observations_is_refused() -> None:
    with pytest.raises(AssertionError, match="Dict"):
        short_model(rollout_buffer_class=GAEDictRolloutBuffer)


def test_a_dict_observation_needs_the_policy_for_it() -> None:
    with pytest.raises(ValueError, match="MultiInputPolicy"):
        short_model(vec_env(lambda: AnySpacesEnv(spaces.Dict({"one": VECTOR}))), "MlpPolicy")


def test_an_unknown_policy_is_refused_by_name() -> None:
    with pytest.raises(ValueError, match="Policy MlpPolice unknown"):
        short_model(policy="MlpPolice")


def test_unbounded_actions_are_refused() -> None:
    with pytest.raises(AssertionError, match="finite lower and upper bound"):
        short_model(vec_env(lambda: AnySpacesEnv(VECTOR, spaces.Box(-np.inf, np.inf, (2,), np.float32))))


def test_settings_that_are_changed_later_are_those_that_count() -> None:
    model = short_model()
    model.target_kl, model.gamma, model.gae_lambda, model.value_lambda = 1e-5, 0.0, 0.0, 1.0
    assert 0.0 < train_once(model)["train/kl_divergence_loss"] <= 1e-5
    buffer = model.rollout_buffer
    np.testing.assert_allclose(buffer.advantages, buffer.rewards - buffer.values, atol=1e-6)
    np.testing.assert_allclose(buffer.returns, buffer.rewards, atol=1e-6)
    model.gamma, model.gae_lambda = 0.9, 0.0
    train_once(model)
    assert np.abs(buffer.returns - buffer.advantages - buffer.values).max() > 1e-2, "targets have a lambda of their own"


def test_settings_that_are_changed_later_are_checked_before_training_goes_on() -> None:
    model = short_model()
    train_once(model)
    before = state_of(model.policy)
    model.target_kl = -0.01
    with pytest.raises(ValueError, match="`target_kl` must be"):
        model.learn(1)
    assert differing(before, state_of(model.policy)) == []


@pytest.mark.parametrize("name", ["gamma", "gae_lambda", "value_lambda"])
def test_the_buffer_has_these_numbers_from_the_algorithm_alone(name: str) -> None:
    with pytest.raises(ValueError, match=f"Pass `{name}` to TRPOGAE itself"):
        short_model(rollout_buffer_kwargs={name: 0.5})
