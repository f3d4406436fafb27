"""Bad numbers and bad arguments are refused with words that say which, before anything has moved."""

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
import torch as th
from envs_for_tests import (
    ACTIONS,
    SMALL,
    VECTOR,
    AnySpacesEnv,
    BadNumberEnv,
    differing,
    optimizer_state,
    state_of,
    train_once,
    vec_env,
    vec_env_of,
)
from gymnasium import spaces
from stable_baselines3.common.buffers import RolloutBuffer

import sb3_gae.update.policy_step
import sb3_gae.update.value_step
from sb3_gae import TRPOGAE, GAEDictRolloutBuffer, MlpPolicy, NumericalError

BAD = [math.nan, math.inf, -math.inf]
WORDS = {"nan": "NaN", "inf": "infinity", "-inf": "infinity"}


def small_model(env: Any = None, policy: Any = "MlpPolicy", **kwargs: Any) -> TRPOGAE:
    return TRPOGAE(policy, env or vec_env(), **({"n_steps": 8, "policy_kwargs": SMALL, "seed": 0} | kwargs))


def check_refused(model: TRPOGAE, message: str) -> None:
    """The next iteration fails with this message and moves nothing, the scale of the values included."""
    before = state_of(model.policy)
    with pytest.raises(NumericalError, match=message):
        train_once(model)
    assert differing(before, state_of(model.policy)) == []


def bad_env(what: str, bad: float, at: int, which: int, **kwargs: Any) -> Any:
    """Three environments, in one of which a number goes bad once."""
    good = {"observation_space": kwargs["observation_space"]} if "observation_space" in kwargs else {}
    length = kwargs.get("length", 5)
    return vec_env_of(
        BadNumberEnv(what, bad, at, **kwargs) if index == which else AnySpacesEnv(**good, length=length) for index in range(3)
    )


# Numbers of the environment


def test_a_numerical_error_is_a_value_error() -> None:
    """rl-zoo3 prunes a trial on that, and on few others."""
    assert issubclass(NumericalError, ValueError)


@pytest.mark.parametrize("bad", BAD)
@pytest.mark.parametrize(("at", "step"), [(1, 0), (6, 5), (8, 7)])
@pytest.mark.parametrize("which", [0, 2])
def test_a_bad_reward_is_refused(which: int, at: int, step: int, bad: float) -> None:
    message = rf"reward contains {WORDS[str(bad)]} at step {step} of the rollout in environment {which}\b"
    check_refused(small_model(bad_env("reward", bad, at, which)), message)


@pytest.mark.parametrize("bad", BAD)
@pytest.mark.parametrize("at", [0, 1, 3, 7, 8])
@pytest.mark.parametrize("which", [0, 2])
def test_a_bad_observation_is_refused(which: int, at: int, bad: float) -> None:
    """The first of the rollout, any in the middle, and the one after its last step, from which values are estimated."""
    message = rf"observation contains {WORDS[str(bad)]} at step {at} of the rollout in environment {which}\b"
    check_refused(small_model(bad_env("observation", bad, at, which, length=20)), message)


def test_a_bad_observation_after_an_earlier_rollout_is_refused() -> None:
    model = small_model(bad_env("observation", math.nan, 8 + 3, 1, length=50))
    train_once(model)
    check_refused(model, r"observation contains NaN at step 3 of the rollout in environment 1\b")


@pytest.mark.parametrize("at", [0, 2, 8])
def test_a_bad_part_of_a_dict_observation_is_named(at: int) -> None:
    space = spaces.Dict({"good": VECTOR, "choice": spaces.Discrete(3), "poor": VECTOR})
    env = bad_env("poor", math.nan, at, 1, observation_space=space, length=20)
    message = rf"observation 'poor' contains NaN at step {at} of the rollout in environment 1\b"
    check_refused(small_model(env, "MultiInputPolicy"), message)


@pytest.mark.parametrize("trained", [False, True], ids=["first rollout", "second rollout"])
@pytest.mark.parametrize("what", ["observation", "poor"])
def test_a_bad_terminal_observation_is_refused_where_its_value_counts(what: str, trained: bool) -> None:
    """The second episode is cut after step 6 of all, by a time limit."""
    space = VECTOR if what == "observation" else spaces.Dict({"good": VECTOR, "poor": VECTOR})
    at = 10 if trained else 6
    model = small_model(
        bad_env(what, math.inf, at, 1, observation_space=space, length=5 if trained else 3),
        "MlpPolicy" if what == "observation" else "MultiInputPolicy",
    )
    if trained:
        train_once(model)
    name = "terminal observation" + (" 'poor'" if what == "poor" else "")
    check_refused(model, rf"{name} contains infinity at step {(at - 1) % 8} of the rollout in environment 1\b")


def test_a_bad_terminal_observation_is_of_no_matter_where_the_episode_really_ended() -> None:
    """The first episode is terminated at step 4."""
    logged = train_once(small_model(bad_env("observation", math.nan, 5, 1)))
    assert logged["train/is_line_search_success"] == 1.0


@pytest.mark.filterwarnings("ignore:overflow")
def test_a_reward_too_large_for_single_precision_is_refused() -> None:
    check_refused(small_model(bad_env("reward", 1e39, 2, 0)), r"reward contains infinity at step 1 .* environment 0\b")


@pytest.mark.filterwarnings("ignore:overflow")
def test_rewards_whose_sum_overflows_are_refused() -> None:
    env = vec_env(lambda: AnySpacesEnv(reward_scale=1e38, length=100))
    check_refused(small_model(env, n_steps=64, gamma=1.0, gae_lambda=1.0), "contains (NaN|infinity) at step")


# Numbers of the policy


@pytest.mark.parametrize("name", ["action_net.weight", "log_std", "value_net.bias", "mlp_extractor.value_net.0.weight"])
@pytest.mark.parametrize("bad", BAD)
def test_a_bad_parameter_is_named(bad: float, name: str) -> None:
    model = small_model()
    train_once(model)
    with th.no_grad():
        model.policy.get_parameter(name).view(-1)[1 if name != "value_net.bias" else 0] = bad
    before = {name: tensor.nan_to_num(7.0) for name, tensor in state_of(model.policy).items()}
    with pytest.raises(NumericalError, match=f"parameter '{name}' contains NaN or infinity"):
        train_once(model)
    assert differing(before, {name: tensor.nan_to_num(7.0) for name, tensor in state_of(model.policy).items()}) == []


@pytest.mark.parametrize(
    ("actions", "bad"),
    [
        *[(actions, bad) for actions in (ACTIONS, spaces.Discrete(3), spaces.MultiDiscrete([3, 2])) for bad in BAD],
        # An infinite logit of a binary action makes it certain, and that is all
        (spaces.MultiBinary(2), math.nan),
    ],
    ids=str,
)
def test_a_bad_action_distribution_is_refused(actions: spaces.Space, bad: float) -> None:
    """From finite weights: the network itself goes wrong at step 3."""
    model = small_model(vec_env(lambda: AnySpacesEnv(VECTOR, actions)))
    calls = []

    def go_wrong(module: Any, inputs: Any, outputs: th.Tensor) -> th.Tensor:
        calls.append(True)
        return th.full_like(outputs, bad) if len(calls) == 4 else outputs

    model.policy.action_net.register_forward_hook(go_wrong)
    check_refused(model, r"action.* step 3 of the rollout")


class BadEvaluation(MlpPolicy):
    """Wrong for one sample of the batch."""

    what = "nothing"

    def evaluate_actions(self, obs: Any, actions: th.Tensor) -> Any:
        values, log_prob, entropy = super().evaluate_actions(obs, actions)
        if self.what == "value":
            values = values.index_fill(0, th.tensor([5]), math.inf)
        elif self.what == "log-probability":
            log_prob = log_prob.index_fill(0, th.tensor([5]), math.nan)
        return values, log_prob, entropy


@pytest.mark.parametrize(("what", "word"), [("value", "infinity"), ("log-probability", "NaN")])
def test_bad_values_and_log_probabilities_are_refused(what: str, word: str) -> None:
    model = small_model(policy=BadEvaluation)
    train_once(model)
    model.policy.what = what
    check_refused(model, rf"{what} contains {word} at step 2 of the rollout in environment 1\b")


class NaNActionAtStep(MlpPolicy):
    """Its own sampling goes wrong in one environment, once."""

    at, which, bad = 3, 1, math.nan
    calls = 0

    def _predict(self, observation: Any, deterministic: bool = False) -> th.Tensor:
        actions = super()._predict(observation, deterministic).clone()
        if self.calls == self.at:
            actions[self.which, -1] = self.bad
        self.calls += 1
        return actions


def test_a_bad_action_is_refused_before_the_environment_sees_it() -> None:
    check_refused(small_model(policy=NaNActionAtStep), r"action contains NaN at step 3 of the rollout in environment 1\b")


# Numbers of the update


def spoil(monkeypatch: pytest.MonkeyPatch, step: Any, **changes: Any) -> None:
    """Let the problem of a step arrive at its solver with something changed."""
    real = step.trust_region_step

    def spoilt(problem: Any, settings: Any) -> Any:
        changed = {name: change(getattr(problem, name)) for name, change in changes.items()}
        return real(dataclasses.replace(problem, **changed), settings)

    monkeypatch.setattr(step, "trust_region_step", spoilt)


@pytest.mark.parametrize("bad", BAD)
def test_a_bad_gradient_of_the_policy_is_refused(bad: float, monkeypatch: pytest.MonkeyPatch) -> None:
    model = small_model()
    train_once(model)
    spoil(monkeypatch, sb3_gae.update.policy_step, gradient=lambda gradient: gradient.index_fill(0, th.tensor([3]), bad))
    check_refused(model, "gradient of the policy contains NaN or infinity")


def test_a_bad_curvature_of_the_policy_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    model = small_model()
    train_once(model)
    spoil(monkeypatch, sb3_gae.update.policy_step, curvature=lambda product: lambda vector: product(vector) * math.nan)
    check_refused(model, "curvature product of the policy contains NaN or infinity")


@pytest.mark.parametrize("what", ["gradient", "curvature product"])
def test_a_bad_value_step_is_refused_and_undoes_the_policy_step_before_it(what: str, monkeypatch: pytest.MonkeyPatch) -> None:
    model = small_model()
    train_once(model)
    if what == "gradient":
        spoil(monkeypatch, sb3_gae.update.value_step, gradient=lambda gradient: gradient * math.inf)
    else:
        spoil(monkeypatch, sb3_gae.update.value_step, curvature=lambda product: lambda vector: product(vector) * math.nan)
    check_refused(model, f"{what} of the value function contains NaN or infinity")


def test_a_bad_gradient_of_adam_is_refused_and_undoes_the_policy_step_before_it(monkeypatch: pytest.MonkeyPatch) -> None:
    model = small_model(vf_optimizer="adam", batch_size=4)
    train_once(model)
    optimizer = optimizer_state(model)
    losses = []

    def third_is_bad(*args: Any, **kwargs: Any) -> th.Tensor:
        losses.append(real(*args, **kwargs))
        return losses[-1] * (math.nan if len(losses) == 3 else 1.0)

    real = th.nn.functional.mse_loss
    monkeypatch.setattr(th.nn.functional, "mse_loss", third_is_bad)
    check_refused(model, "gradient of the value function contains NaN or infinity")
    assert len(losses) == 3
    assert differing(optimizer, optimizer_state(model)) == []


@pytest.mark.parametrize("vf_optimizer", ["trust_region", "adam"])
@pytest.mark.parametrize("error", [KeyboardInterrupt, RuntimeError])
def test_an_update_that_is_interrupted_is_undone(error: type[BaseException], vf_optimizer: str) -> None:
    model = small_model(vf_optimizer=vf_optimizer)
    train_once(model)
    fit_value, before, optimizer = model._fit_value, state_of(model.policy), optimizer_state(model)
    moved = []

    def interrupted(*args: Any) -> None:
        fit_value(*args)
        moved.extend(differing(before, state_of(model.policy)))
        raise error

    model._fit_value = interrupted  # type: ignore[method-assign, assignment]
    with pytest.raises(error):
        train_once(model)
    assert {"action_net.weight", "value_net.weight"} <= set(moved)
    assert differing(before, state_of(model.policy)) == []
    assert differing(optimizer, optimizer_state(model)) == []
    model._fit_value = fit_value  # type: ignore[method-assign]
    assert train_once(model)["train/n_updates"] == 2


@pytest.mark.parametrize("error", [th.linalg.LinAlgError, ZeroDivisionError, OverflowError])
def test_linear_algebra_that_breaks_down_is_a_numerical_error(error: type[Exception], monkeypatch: pytest.MonkeyPatch) -> None:
    def breaks_down(vector: th.Tensor) -> th.Tensor:
        raise error("no such decomposition")

    model = small_model()
    train_once(model)
    spoil(monkeypatch, sb3_gae.update.policy_step, curvature=lambda product: breaks_down)
    check_refused(model, "linear algebra of the update broke down: no such decomposition")


def test_a_trial_that_torch_refuses_is_a_trial_that_failed() -> None:
    """With such a radius the first steps make standard deviations of 0. Shorter ones follow, and no error."""
    refusals = []

    class Watched(MlpPolicy):
        def _get_action_dist_from_latent(self, latent_pi: th.Tensor) -> Any:
            try:
                return super()._get_action_dist_from_latent(latent_pi)
            except ValueError:
                refusals.append(True)
                raise

    search = {"line_search_shrinking_factor": 0.5, "line_search_max_iter": 60}
    model = small_model(policy=Watched, target_kl=1e6, **search)
    logged = train_once(model)
    assert len(refusals) > 0
    assert logged["train/is_line_search_success"] == 1.0 and logged["train/line_search_trials"] > len(refusals)


# Arguments


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *[(name, value) for name in ("gamma", "gae_lambda", "value_lambda") for value in (-0.1, 1.1, math.nan, "0.9", True)],
        *[(name, value) for name in ("target_kl", "vf_trust_region") for value in (0.0, -0.01, math.nan, math.inf, None)],
        *[(name, value) for name in ("cg_damping", "vf_cg_damping") for value in (-0.1, math.nan, math.inf)],
        *[("line_search_shrinking_factor", value) for value in (0.0, 1.0, -0.5, math.nan)],
        *[
            (name, value)
            for name in ("n_steps", "cg_max_steps", "vf_cg_max_steps", "line_search_max_iter", "sub_sampling_factor")
            for value in (0, -1, 2.5, True)
        ],
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
        small_model(**{name: value})
    assert repr(value) in str(caught.value), "the message says what was passed"


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *[(name, value) for name in ("gamma", "gae_lambda", "value_lambda") for value in (0, 0.0, 1, np.float32(0.5))],
        *[("cg_damping", 0.0), ("vf_cg_damping", 0.0), ("curvature_samples", None), ("curvature_samples", 2)],
        *[("target_kl", 1e-12), ("target_kl", 100.0), ("vf_trust_region", 1e-12), ("vf_trust_region", 100.0)],
        *[("cg_max_steps", 1), ("vf_cg_max_steps", np.int64(1)), ("line_search_max_iter", 1), ("vf_steps", 0)],
        *[("vf_kl_fraction", value) for value in (0, 1e-12, np.float32(0.99))],
    ],
)
def test_the_edges_of_a_domain_are_inside_and_train(name: str, value: Any) -> None:
    model = small_model(**{name: value})
    logged = train_once(model)
    assert logged["train/kl_divergence_loss"] <= model.target_kl
    assert all(tensor.isfinite().all() for tensor in model.policy.state_dict().values())


@pytest.mark.parametrize(
    ("n_envs", "arguments"),
    [(1, {"n_steps": 1}), (2, {"n_steps": 1, "sub_sampling_factor": 2}), (1, {"sub_sampling_factor": 5})],
)
def test_a_batch_of_one_is_refused(n_envs: int, arguments: dict[str, int]) -> None:
    with pytest.raises(ValueError, match=r"at least 2 samples.*`n_steps`"):
        small_model(vec_env(n_envs=n_envs), **({"n_steps": 8} | arguments))


def test_one_step_of_several_environments_is_a_batch() -> None:
    logged = train_once(small_model(vec_env(n_envs=3), n_steps=1))
    assert 0.0 < logged["train/kl_divergence_loss"] <= 0.01


def test_a_policy_without_trainable_parameters_is_refused() -> None:
    class Frozen(MlpPolicy):
        def _build(self, lr_schedule: Any) -> None:
            super()._build(lr_schedule)
            self.requires_grad_(False)

    with pytest.raises(ValueError, match="no trainable parameters"):
        small_model(policy=Frozen)


def test_a_frozen_action_distribution_is_refused_and_the_value_function_stays() -> None:
    model = small_model(normalize_value=False)
    for parameter in [*model.policy.mlp_extractor.policy_net.parameters(), *model.policy.action_net.parameters()]:
        parameter.requires_grad_(False)
    model.policy.log_std.requires_grad_(False)
    before = state_of(model.policy)
    with pytest.raises(ValueError, match="action distribution depends on no trainable parameter"):
        train_once(model)
    assert differing(before, state_of(model.policy)) == []


@pytest.mark.parametrize("buffer_class", [RolloutBuffer, dict])
def test_another_kind_of_buffer_is_refused(buffer_class: Any) -> None:
    with pytest.raises(TypeError, match=r"`rollout_buffer_class` must be a subclass of sb3_gae\.GAERolloutBuffer"):
        small_model(rollout_buffer_class=buffer_class)


def test_a_buffer_for_other_observations_is_refused() -> None:
    with pytest.raises(AssertionError, match="Dict"):
        small_model(rollout_buffer_class=GAEDictRolloutBuffer)


def test_a_dict_observation_needs_the_policy_for_it() -> None:
    with pytest.raises(ValueError, match="MultiInputPolicy"):
        small_model(vec_env(lambda: AnySpacesEnv(spaces.Dict({"one": VECTOR}))), "MlpPolicy")


def test_an_unknown_policy_is_refused_by_name() -> None:
    with pytest.raises(ValueError, match="Policy MlpPolice unknown"):
        small_model(policy="MlpPolice")


def test_unbounded_actions_are_refused() -> None:
    with pytest.raises(AssertionError, match="finite lower and upper bound"):
        small_model(vec_env(lambda: AnySpacesEnv(VECTOR, spaces.Box(-np.inf, np.inf, (2,), np.float32))))


def test_settings_that_are_changed_later_are_those_that_count() -> None:
    model = small_model()
    model.target_kl, model.gamma, model.gae_lambda, model.value_lambda = 1e-5, 0.0, 0.0, 1.0
    assert 0.0 < train_once(model)["train/kl_divergence_loss"] <= 1e-5
    buffer = model.rollout_buffer
    np.testing.assert_allclose(buffer.advantages, buffer.rewards - buffer.values, atol=1e-6)
    np.testing.assert_allclose(buffer.returns, buffer.rewards, atol=1e-6)
    model.gamma, model.gae_lambda = 0.9, 0.0
    train_once(model)
    assert np.abs(buffer.returns - buffer.advantages - buffer.values).max() > 1e-2, "targets have a lambda of their own"
