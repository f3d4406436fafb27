"""Bad numbers of the environment or the policy are refused with words that say which, before anything has moved."""

import math
from typing import Any

import numpy as np
import pytest
import torch as th
from bad_numbers import BAD, check_refused
from envs_for_tests import (
    ACTIONS,
    VECTOR,
    AnySpacesEnv,
    BadNumberEnv,
    check_training,
    differing,
    short_model,
    state_of,
    train_once,
    vec_env,
    vec_env_of,
)
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn

from sb3_gae import MlpPolicy, NumericalError
from sb3_gae.rollout.collection import RolloutPlan, take_steps
from sb3_gae.rollout.episode_quota import EpisodeQuota

WORDS = {"nan": "NaN", "inf": "infinity", "-inf": "infinity"}


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
    check_refused(short_model(bad_env("reward", bad, at, which)), message)


@pytest.mark.parametrize("bad", BAD)
@pytest.mark.parametrize("at", [0, 1, 3, 7, 8])
@pytest.mark.parametrize("which", [0, 2])
def test_a_bad_observation_is_refused(which: int, at: int, bad: float) -> None:
    """The first of the rollout, any in the middle, and the one after its last step, from which values are estimated."""
    message = rf"observation contains {WORDS[str(bad)]} at step {at} of the rollout in environment {which}\b"
    check_refused(short_model(bad_env("observation", bad, at, which, length=20)), message)


def test_a_bad_observation_after_an_earlier_rollout_is_refused() -> None:
    model = short_model(bad_env("observation", math.nan, 8 + 3, 1, length=50))
    train_once(model)
    check_refused(model, r"observation contains NaN at step 3 of the rollout in environment 1\b")


@pytest.mark.parametrize("at", [0, 2, 8])
def test_a_bad_part_of_a_dict_observation_is_named(at: int) -> None:
    space = spaces.Dict({"good": VECTOR, "choice": spaces.Discrete(3), "poor": VECTOR})
    env = bad_env("poor", math.nan, at, 1, observation_space=space, length=20)
    message = rf"observation 'poor' contains NaN at step {at} of the rollout in environment 1\b"
    check_refused(short_model(env, "MultiInputPolicy"), message)


@pytest.mark.parametrize("trained", [False, True], ids=["first rollout", "second rollout"])
@pytest.mark.parametrize("what", ["observation", "poor"])
def test_a_bad_terminal_observation_is_refused_where_its_value_counts(what: str, trained: bool) -> None:
    """The second episode is cut after step 6 of all, by a time limit."""
    space = VECTOR if what == "observation" else spaces.Dict({"good": VECTOR, "poor": VECTOR})
    at = 10 if trained else 6
    model = short_model(
        bad_env(what, math.inf, at, 1, observation_space=space, length=5 if trained else 3),
        "MlpPolicy" if what == "observation" else "MultiInputPolicy",
    )
    if trained:
        train_once(model)
    name = "terminal observation" + (" 'poor'" if what == "poor" else "")
    check_refused(model, rf"{name} contains infinity at step {(at - 1) % 8} of the rollout in environment 1\b")


def test_a_bad_terminal_observation_is_of_no_matter_where_the_episode_really_ended() -> None:
    """The first episode is terminated at step 4."""
    logged = train_once(short_model(bad_env("observation", math.nan, 5, 1)))
    assert logged["train/is_line_search_success"] == 1.0


@pytest.mark.filterwarnings("ignore:overflow")
def test_a_reward_too_large_for_single_precision_is_refused() -> None:
    check_refused(short_model(bad_env("reward", 1e39, 2, 0)), r"reward contains infinity at step 1 .* environment 0\b")


@pytest.mark.filterwarnings("ignore:overflow")
def test_rewards_whose_sum_overflows_are_refused() -> None:
    env = vec_env(lambda: AnySpacesEnv(reward_scale=1e38, length=100))
    check_refused(short_model(env, n_steps=64, gamma=1.0, gae_lambda=1.0), "contains (NaN|infinity) at step")


# Numbers of the policy


@pytest.mark.parametrize("name", ["action_net.weight", "log_std", "value_net.bias", "mlp_extractor.value_net.0.weight"])
@pytest.mark.parametrize("bad", BAD)
def test_a_bad_parameter_is_named(bad: float, name: str) -> None:
    model = short_model()
    train_once(model)
    with th.no_grad():
        model.policy.get_parameter(name).view(-1)[1 if name != "value_net.bias" else 0] = bad
    before = {name: tensor.nan_to_num(7.0) for name, tensor in state_of(model.policy).items()}
    with pytest.raises(NumericalError, match=f"parameter '{name}' contains NaN or infinity"):
        train_once(model)
    assert differing(before, {name: tensor.nan_to_num(7.0) for name, tensor in state_of(model.policy).items()}) == []


FROZEN = [
    "action_net.weight",
    "log_std",
    "mlp_extractor.policy_net.0.bias",
    "value_net.bias",
    "mlp_extractor.value_net.0.weight",
]


@pytest.mark.parametrize("vf_optimizer", ["trust_region", "adam"])
@pytest.mark.parametrize("name", FROZEN)
def test_a_bad_parameter_that_is_frozen_is_refused_by_what_it_does(name: str, vf_optimizer: str) -> None:
    model = short_model(vf_optimizer=vf_optimizer)
    train_once(model)
    frozen = model.policy.get_parameter(name).requires_grad_(False)
    with th.no_grad():
        frozen.view(-1)[-1] = math.nan
    before = {name: tensor.nan_to_num(7.0) for name, tensor in state_of(model.policy).items()}
    with pytest.raises(NumericalError, match=r"(action|value) contains NaN at step 0"):
        train_once(model)
    assert differing(before, {name: tensor.nan_to_num(7.0) for name, tensor in state_of(model.policy).items()}) == []


class Masked(BaseFeaturesExtractor):
    """Mixes the numbers of a vector, each with those before it alone."""

    def __init__(self, observation_space: spaces.Box):
        super().__init__(observation_space, features_dim=3)
        self.scores = nn.Parameter(th.zeros(3, 3))
        self.mask = nn.Parameter(th.full((3, 3), -math.inf).triu(1), requires_grad=False)

    def forward(self, observations: th.Tensor) -> th.Tensor:
        return observations @ th.softmax(self.scores + self.mask, dim=1).T


@pytest.mark.parametrize("share", [True, False])
def test_a_frozen_mask_of_infinity_is_no_bad_number(share: bool) -> None:
    policy_kwargs = {"net_arch": [8], "features_extractor_class": Masked, "share_features_extractor": share}
    check_training(short_model(policy_kwargs=policy_kwargs))


@pytest.mark.parametrize(
    ("actions", "bad"),
    [
        *[(actions, bad) for actions in (ACTIONS, spaces.Discrete(3), spaces.MultiDiscrete([3, 2])) for bad in BAD],
        # An infinite logit of a binary action makes it certain, and that is all
        (spaces.MultiBinary(2), math.nan),
    ],
    ids=str,
)
@pytest.mark.parametrize("validate_args", [True, False], ids=["torch refuses it", "as after torch.compile"])
def test_a_bad_action_distribution_is_refused(
    validate_args: bool, actions: spaces.Space, bad: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From finite weights: the network itself goes wrong from step 3 on."""
    monkeypatch.setattr(th.distributions.Distribution, "_validate_args", validate_args)
    model = short_model(vec_env(lambda: AnySpacesEnv(VECTOR, actions)))
    calls = []

    def go_wrong(module: Any, inputs: Any, outputs: th.Tensor) -> th.Tensor:
        calls.append(True)
        return th.full_like(outputs, bad) if len(calls) >= 4 else outputs

    model.policy.action_net.register_forward_hook(go_wrong)
    check_refused(model, r"action.* step 3 of the rollout")


@pytest.mark.parametrize("error", [RuntimeError("out of memory"), ValueError("too many values to unpack")], ids=repr)
def test_an_error_of_the_network_itself_is_not_one_of_numbers(error: Exception) -> None:
    model = short_model(vec_env(lambda: AnySpacesEnv(VECTOR, spaces.Discrete(3))))
    errors = [error]

    def fail_once(module: Any, inputs: Any, outputs: th.Tensor) -> None:
        if errors:
            raise errors.pop()

    model.policy.action_net.register_forward_hook(fail_once)
    with pytest.raises(type(error), match=str(error)) as raised:
        train_once(model)
    assert raised.value is error


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
    model = short_model(policy=BadEvaluation)
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


def test_exploration_that_has_shrunk_to_nothing_is_refused() -> None:
    model = short_model(policy_kwargs={"log_std_init": -110.0})
    check_refused(model, "standard deviation is 0")


def test_a_bad_action_has_the_number_of_its_environment_among_all() -> None:
    model = short_model(policy=NaNActionAtStep)
    steps = take_steps(
        model.policy, model.env, model.env.reset(), np.ones(3, dtype=bool), RolloutPlan(8), EpisodeQuota(3, None), first_env=6
    )
    with pytest.raises(NumericalError, match=r"action contains NaN at step 3 of the rollout in environment 7\b"):
        list(steps)


def test_a_bad_action_is_refused_before_the_environment_sees_it() -> None:
    check_refused(short_model(policy=NaNActionAtStep), r"action contains NaN at step 3 of the rollout in environment 1\b")
