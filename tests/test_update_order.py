"""The order of an update: which advantages the policy steps on, and when the value function is fitted."""

from typing import Any

import pytest
import torch as th
from envs_for_tests import SMALL, differing, distribution_bits, state_of, train_once, vec_env
from stable_baselines3.common.callbacks import BaseCallback

import sb3_gae.trpo_gae
from sb3_gae import TRPOGAE


def test_the_policy_steps_on_advantages_of_the_old_values_and_the_value_function_is_fitted_last(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    model = TRPOGAE("MlpPolicy", vec_env(), n_steps=16, normalize_advantage=False, policy_kwargs=SMALL, seed=0)
    order = []
    at_collection: dict[str, Any] = {}

    class AtCollection(BaseCallback):
        def _on_step(self) -> bool:
            return True

        def _on_rollout_end(self) -> None:
            order.append("rollout")
            observations = self.locals["rollout_buffer"].batch().observations
            at_collection["values"] = self.model.policy.predict_values(observations).flatten()
            at_collection["policy"] = distribution_bits(self.model.policy, observations)

    def policy_step(policy: Any, parameters: Any, batch: Any, advantages: th.Tensor, *rest: Any) -> Any:
        order.append("policy")
        buffer = model.rollout_buffer
        th.testing.assert_close(th.as_tensor(buffer.values.flatten()), at_collection["values"])
        th.testing.assert_close(advantages, th.as_tensor(buffer.advantages.flatten()), rtol=0, atol=0)
        th.testing.assert_close(policy.predict_values(batch.observations).flatten(), at_collection["values"], rtol=0, atol=0)
        return real_policy_step(policy, parameters, batch, advantages, *rest)

    def value_steps(policy: Any, parameters: Any, batch: Any, *rest: Any) -> Any:
        order.append("value")
        now = distribution_bits(policy, batch.observations)
        assert not any(th.equal(old, new) for old, new in zip(at_collection["policy"], now, strict=True))
        th.testing.assert_close(policy.predict_values(batch.observations).flatten(), at_collection["values"])
        return real_value_steps(policy, parameters, batch, *rest)

    real_policy_step, real_value_steps = sb3_gae.trpo_gae.policy_step, sb3_gae.trpo_gae.value_steps
    monkeypatch.setattr(sb3_gae.trpo_gae, "policy_step", policy_step)
    monkeypatch.setattr(sb3_gae.trpo_gae, "value_steps", value_steps)
    for _ in range(3):
        train_once(model, AtCollection())
    assert order == ["rollout", "policy", "value"] * 3


@pytest.mark.parametrize("normalize", [True, False])
def test_advantages_are_standardized_only_if_asked_and_never_in_the_buffer(
    normalize: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = TRPOGAE("MlpPolicy", vec_env(), n_steps=16, normalize_advantage=normalize, policy_kwargs=SMALL, seed=0)
    seen = []
    real = sb3_gae.trpo_gae.policy_step
    monkeypatch.setattr(sb3_gae.trpo_gae, "policy_step", lambda *args: (seen.append(args[3]), real(*args))[1])
    train_once(model)
    raw = th.as_tensor(model.rollout_buffer.advantages.flatten())
    assert abs(raw.mean()) > 1e-2
    expected = (raw - raw.mean()) / raw.std() if normalize else raw
    th.testing.assert_close(seen[0], expected, rtol=1e-4, atol=1e-5)


def test_no_value_steps_leave_the_value_function_alone() -> None:
    model = TRPOGAE("MlpPolicy", vec_env(), n_steps=16, vf_steps=0, normalize_value=False, policy_kwargs=SMALL, seed=0)
    before = state_of(model.policy)
    train_once(model)
    moved = differing(before, state_of(model.policy))
    assert "action_net.weight" in moved and not any("value" in name for name in moved)
