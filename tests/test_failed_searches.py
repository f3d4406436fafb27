"""A line search that fails restores what it moved, and the log says that nothing was done."""

import dataclasses
import math
from typing import Any

import pytest
from envs_for_tests import KLProbe, differing, short_model, state_of, train_once

import sb3_gae.update.policy_step
import sb3_gae.update.value_step


def fail_searches(monkeypatch: pytest.MonkeyPatch, step: Any, objective: float, divergence: float) -> None:
    """Let each trial of a step end so, after it has moved the parameters."""
    real = step.trust_region_step

    def failing(problem: Any, settings: Any) -> Any:
        return real(dataclasses.replace(problem, evaluate=lambda: (objective, divergence)), settings)

    monkeypatch.setattr(step, "trust_region_step", failing)


@pytest.mark.parametrize(
    ("objective", "divergence"),
    [(math.inf, 0.0100001), (-math.inf, 0.0), (math.nan, 0.0), (1e9, math.nan), (-math.inf, math.inf)],
    ids=["too far", "worse", "objective is NaN", "divergence is NaN", "both infinite"],
)
def test_a_policy_search_that_fails_restores_every_bit_and_logs_that_nothing_was_done(
    objective: float, divergence: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = short_model()
    train_once(model)
    fail_searches(monkeypatch, sb3_gae.update.policy_step, objective, divergence)
    before = state_of(model.policy)
    probe = KLProbe()
    logged = train_once(model, probe)
    assert (logged["train/kl_divergence_loss"], logged["train/is_line_search_success"]) == (0.0, 0.0)
    assert logged["train/line_search_trials"] == model.line_search_max_iter
    assert logged["train/policy_objective"] == pytest.approx(0.0, abs=1e-6), "mean of standardized advantages"
    moved = differing(before, state_of(model.policy))
    assert probe.kl() == 0.0
    assert all("value_net" in name for name in moved) and "mlp_extractor.value_net.0.weight" in moved


def test_a_step_that_is_too_long_fails_in_earnest() -> None:
    """One trial at a radius where the quadratic model of the divergence is far off."""
    model = short_model(target_kl=1e6, line_search_max_iter=1, vf_steps=0)
    before = state_of(model.policy)
    logged = train_once(model)
    assert (logged["train/kl_divergence_loss"], logged["train/is_line_search_success"]) == (0.0, 0.0)
    assert all("value_net" in name for name in differing(before, state_of(model.policy)))


def test_a_value_search_that_fails_restores_the_values_and_logs_that_nothing_was_done(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    model = short_model(normalize_value=False)
    train_once(model)
    fail_searches(monkeypatch, sb3_gae.update.value_step, 1.0, 0.3)
    before = state_of(model.policy)
    logged = train_once(model)
    assert (logged["train/vf_steps"], logged["train/vf_kl_divergence"]) == (0, 0.0)
    # One from the rollout's own values, the other from those of the fit: the same function, added up in another order
    assert logged["train/explained_variance_after"] == pytest.approx(logged["train/explained_variance"], rel=1e-5)
    samples = model.rollout_buffer.batch()
    assert logged["train/value_loss"] == pytest.approx((samples.old_values - samples.returns).square().mean().item(), rel=1e-5)
    moved = differing(before, state_of(model.policy))
    assert "action_net.weight" in moved and not any("value_net" in name for name in moved)


def test_a_rollout_without_advantages_leaves_the_policy_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """A gradient of zero is no error."""
    model = short_model()
    real = type(model.rollout_buffer).compute_returns_and_advantage

    def without(self: Any, *args: Any) -> None:
        real(self, *args)
        self.advantages[:] = 0.5

    monkeypatch.setattr(type(model.rollout_buffer), "compute_returns_and_advantage", without)
    before = state_of(model.policy)
    logged = train_once(model)
    assert (logged["train/kl_divergence_loss"], logged["train/is_line_search_success"]) == (0.0, 0.0)
    assert all("value_net" in name for name in differing(before, state_of(model.policy)))
