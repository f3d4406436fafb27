"""Parameters go from one model, or its file, to another, and those that do not fit change nothing."""

import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sb3_contrib
import torch as th
from envs_for_tests import SMALL, KLProbe, differing, optimizer_state, state_of, train_once, vec_env
from saved_models import check_same, fresh_model, saved, trained_model, values_and_actions
from stable_baselines3.common.policies import ActorCriticPolicy

from sb3_gae import TRPOGAE


def test_parameters_go_from_one_model_to_another(some_model: TRPOGAE) -> None:
    other = fresh_model()
    assert differing(state_of(other.policy), state_of(some_model.policy)) != []
    other.set_parameters(some_model.get_parameters())
    check_same(other, some_model)


def test_parameters_go_from_a_file_to_a_model(some_model: TRPOGAE, model_file: bytes, tmp_path: Path) -> None:
    (tmp_path / "model.zip").write_bytes(model_file)
    for source in (tmp_path / "model.zip", str(tmp_path / "model"), io.BytesIO(model_file)):
        other = fresh_model()
        other.set_parameters(source)  # type: ignore[arg-type]
        check_same(other, some_model)


def test_weights_go_back_to_contrib_with_the_scale_multiplied_in() -> None:
    """As docs/migrating.md has it."""
    model = trained_model()
    weights = model.get_parameters()["policy"]
    scale = weights.pop("value_net.scale")
    del weights["value_net.n_batches"]
    assert scale != 1.0
    weights |= {name: scale * weights[name] for name in ("value_net.weight", "value_net.bias")}
    other = sb3_contrib.TRPO("MlpPolicy", vec_env(), n_steps=16, policy_kwargs=model.policy_kwargs)
    other.set_parameters({"policy": weights}, exact_match=False)
    observations = th.as_tensor(vec_env().reset())
    th.testing.assert_close(other.policy.predict_values(observations), model.policy.predict_values(observations))
    th.testing.assert_close(
        other.predict(observations.numpy(), deterministic=True)[0], model.predict(observations.numpy(), deterministic=True)[0]
    )


def test_some_parameters_can_be_replaced() -> None:
    other = trained_model()
    assert other.policy.value_net.scale != 1.0
    before = state_of(other.policy)
    other.set_parameters({"policy": {"action_net.bias": th.ones(2)}}, exact_match=False)
    assert differing(before, state_of(other.policy)) == ["action_net.bias"]


@pytest.mark.parametrize("policy", ["MlpPolicy", ActorCriticPolicy])
@pytest.mark.parametrize("through_a_file", [False, True])
def test_weights_of_contribs_trpo_are_taken_over(through_a_file: bool, policy: Any) -> None:
    theirs = sb3_contrib.TRPO("MlpPolicy", vec_env(), n_steps=16, batch_size=32, policy_kwargs=SMALL, seed=3)
    theirs.learn(32)
    ours = TRPOGAE(policy, vec_env(), n_steps=16, policy_kwargs=SMALL, seed=0)
    train_once(ours)
    ours.set_parameters(io.BytesIO(saved(theirs)) if through_a_file else theirs.get_parameters())  # type: ignore[arg-type]
    for mine, expected in zip(values_and_actions(ours), values_and_actions(theirs), strict=True):
        np.testing.assert_array_equal(mine, expected)
    values = []
    probe = KLProbe()
    probe._on_rollout_end = lambda: values.append(values_and_actions(ours)[0])  # type: ignore[method-assign]
    train_once(ours, probe)
    np.testing.assert_array_equal(values[0], values_and_actions(theirs)[0], "the first rollout leaves the values as they were")


def mismatches() -> dict[str, dict[str, Any]]:
    good = fresh_model(seed=9, vf_optimizer="adam").get_parameters()
    policy, optimizer = good["policy"], good["policy.optimizer"]
    one_group_more = {"state": {}, "param_groups": optimizer["param_groups"] * 2}
    return {
        "a tensor is missing": good | {"policy": {name: policy[name] for name in policy if name != "value_net.bias"}},
        "a tensor too many": good | {"policy": policy | {"other": th.zeros(1)}},
        "the last tensor is of another shape": good | {"policy": policy | {"value_net.bias": th.zeros(3)}},
        "an object is missing": {"policy": policy},
        "an object too many": good | {"nobody": policy},
        "another optimiser": good | {"policy.optimizer": one_group_more},
        "numbers instead of tensors": good | {"policy": dict.fromkeys(policy, 0.0)},
    }


@pytest.mark.parametrize("what", mismatches())
def test_parameters_that_do_not_fit_change_nothing(what: str) -> None:
    model = trained_model(vf_optimizer="adam")
    before, optimizer = state_of(model.policy), optimizer_state(model)
    with pytest.raises((ValueError, RuntimeError, TypeError, AttributeError)):
        model.set_parameters(mismatches()[what])
    assert differing(before, state_of(model.policy)) == []
    assert len(optimizer) > 8 and differing(optimizer, optimizer_state(model)) == []
