"""Models and policies can be copied at any time, as those of SB3 can."""

import copy
import pickle
from typing import Any

import numpy as np
import pytest
import torch as th
from envs_for_tests import VECTOR, AnySpacesEnv, differing, small_model, state_of, train_once, vec_env
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback

from sb3_gae import TRPOGAE, GradientDiagnosticsCallback, NumericalError
from sb3_gae.borrowed_distribution import borrowed_distribution

ACTION_SPACES = {
    "Box": spaces.Box(-1.0, 1.0, (2,), np.float32),
    "Discrete": spaces.Discrete(3),
    "MultiDiscrete": spaces.MultiDiscrete([2, 3]),
    "MultiBinary": spaces.MultiBinary(3),
}


def model_for(actions: str, reward_scale: float = 1.0, **kwargs: Any) -> TRPOGAE:
    return small_model(vec_env(lambda: AnySpacesEnv(VECTOR, ACTION_SPACES[actions], reward_scale=reward_scale)), **kwargs)


def check_copies(model: TRPOGAE) -> None:
    """Policy and model can be copied, and a copy is of its own."""
    before = state_of(model.policy)
    policy, twin = copy.deepcopy(model.policy), copy.deepcopy(model)
    assert differing(before, state_of(policy)) == differing(before, state_of(twin.policy)) == []
    train_once(twin)
    assert differing(before, state_of(model.policy)) == []
    assert "action_net.weight" in differing(before, state_of(twin.policy))


@pytest.mark.parametrize("actions", ACTION_SPACES)
@pytest.mark.parametrize(
    "kwargs",
    [
        {},
        {"vf_kl_fraction": 0.1, "policy": "SharedMlpPolicy"},
        {"vf_optimizer": "adam"},
        {"policy_kwargs": {"net_arch": [8], "activation_fn": th.nn.CELU}},
    ],
    ids=["two networks", "one network", "adam", "double backward"],
)
def test_a_model_that_has_learned_can_be_copied(kwargs: dict[str, Any], actions: str) -> None:
    model = model_for(actions, **kwargs)
    train_once(model)
    check_copies(model)


@pytest.mark.parametrize("actions", ACTION_SPACES)
def test_a_model_whose_policy_made_no_step_can_be_copied(actions: str) -> None:
    """There the last that is computed of the distribution has a graph."""
    model = model_for(actions, reward_scale=0.0, baseline="time")
    assert train_once(model)["train/is_line_search_success"] == 0.0
    copy.deepcopy(model.policy)
    copy.deepcopy(model)


def test_a_policy_takes_no_batch_along() -> None:
    model = model_for("Box", n_steps=256)
    before = len(pickle.dumps(model.policy))
    train_once(model)
    assert len(pickle.dumps(model.policy)) == pytest.approx(before, rel=0.1)


@pytest.mark.parametrize("sde_sample_freq", [-1, 4])
def test_a_gsde_model_that_has_learned_can_be_copied(sde_sample_freq: int) -> None:
    """SB3's own cannot, for its noise has a graph."""
    model = model_for("Box", use_sde=True, sde_sample_freq=sde_sample_freq)
    train_once(model)
    check_copies(model)


class CopyEachStep(BaseCallback):
    """Copies the policy wherever a callback is called."""

    def _on_step(self) -> bool:
        copy.deepcopy(self.model.policy)
        return True

    def _on_rollout_end(self) -> None:
        copy.deepcopy(self.model.policy)


@pytest.mark.parametrize("actions", ACTION_SPACES)
@pytest.mark.parametrize("gae_lambda", ["auto", "improvement"])
def test_measuring_gradients_leaves_a_policy_that_can_be_copied(gae_lambda: str, actions: str) -> None:
    model = model_for(actions, gae_lambda=gae_lambda)
    model.learn(64, callback=[GradientDiagnosticsCallback([0.9, 1.0]), CopyEachStep()])
    check_copies(model)


def test_an_update_that_failed_leaves_a_policy_that_can_be_copied(monkeypatch: pytest.MonkeyPatch) -> None:
    model = model_for("Discrete")
    train_once(model)

    def fail(*args: Any) -> None:
        model.policy.get_distribution(th.zeros(1, 3))
        raise ZeroDivisionError

    monkeypatch.setattr(model, "_fit_value", fail)
    with pytest.raises(NumericalError):
        train_once(model)
    copy.deepcopy(model.policy)


def test_the_distribution_is_given_back_as_it_was() -> None:
    policy = model_for("Discrete").policy
    with th.no_grad():
        content = policy.get_distribution(th.zeros(4, 3)).distribution
    with borrowed_distribution(policy):
        policy.get_distribution(th.ones(5, 3))
        assert policy.action_dist.distribution is not content
    assert policy.action_dist.distribution is content
