"""Value fits that move parameters of the policy, too, keep to both constraints, and what is left when a step fails."""

import math
from dataclasses import replace
from typing import Any

import pytest
import torch as th
from envs_for_tests import differing
from hypothesis import given
from hypothesis import strategies as st
from oracles import moved, state_of, training_batch
from shared_fits import DEFAULTS, KINDS, distribution_of, divergence, each_kind, fit, groups_of, policy_of, values_of

from sb3_gae.update.shared_parameters import SharedParameters, SharedStep

# Both constraints


@given(
    kind=st.sampled_from(list(KINDS)),
    seed=st.integers(0, 1000),
    log_radius=st.floats(-4, 1),
    log_limit=st.floats(-6, 0),
    n_steps=st.integers(1, 4),
)
def test_both_true_constraints_hold(kind: str, seed: int, log_radius: float, log_limit: float, n_steps: int) -> None:
    policy = policy_of(kind, seed)
    batch = training_batch(policy, seed=seed)
    settings, limit = replace(DEFAULTS, radius=10**log_radius), 10**log_limit
    old, before = distribution_of(policy, batch), values_of(policy, batch)
    variance = (before - batch.value_targets).square().mean().item()
    record = fit(policy, batch, limit, settings, n_steps)
    used = divergence(old, distribution_of(policy, batch))
    assert used <= limit * (1 + 1e-9)
    assert record.policy_kl == pytest.approx(used, rel=1e-9, abs=1e-15)
    assert all(step.divergence <= settings.radius for step in record.steps)
    after = values_of(policy, batch)
    th.testing.assert_close(record.values_after, after)
    assert (after - batch.value_targets).square().mean().item() < variance
    if n_steps == 1:
        change = (after - before).square().mean().item() / (2.0 * variance)
        assert record.steps[0].divergence == pytest.approx(change, rel=1e-6)


def test_each_step_of_a_fit_gets_an_equal_part_of_the_way_that_is_left() -> None:
    policy = policy_of("all layers")
    batch = training_batch(policy)
    old, limit = distribution_of(policy, batch), 1e-2
    shared = SharedParameters(policy, groups_of(policy, batch), batch, limit)
    assert shared.divergence() == 0.0
    assert [shared.radius(steps_left) for steps_left in (1, 5)] == pytest.approx([limit, limit / 25])
    with th.no_grad():
        policy.mlp_extractor.policy_net[0].weight.add_(0.2)
    used = divergence(old, distribution_of(policy, batch))
    assert 0.1 * limit < used < 0.9 * limit
    assert shared.divergence() == pytest.approx(used)
    assert shared.radius(2) == pytest.approx(((math.sqrt(limit) - math.sqrt(used)) / 2) ** 2)
    for limit in (used * (1.0 + 1e-9), used, 0.5 * used):
        shared._limit = limit
        assert shared.radius(2) == 0.0


def test_what_the_policy_alone_depends_on_stays() -> None:
    for kind in KINDS:
        policy = policy_of(kind)
        batch = training_batch(policy)
        groups, before = groups_of(policy, batch), state_of(policy)
        fit(policy, batch, 1e-2, DEFAULTS, n_steps=3)
        allowed = {id(parameter) for parameter in [*groups.of_value, *groups.of_both]}
        named = dict(policy.named_parameters(remove_duplicate=False))
        assert {id(named[name]) for name in moved(before, policy)} == allowed


@each_kind
def test_where_features_matter_the_error_falls_further_than_with_frozen_ones(kind: str) -> None:
    errors = []
    for limit in (None, 1e-3):
        policy = policy_of(kind)
        batch = training_batch(policy, 200)
        inputs = batch.observations.double().flatten(1)
        signal = th.sin(2.0 * (inputs - inputs.mean(0)) / inputs.std(0))[:, 0]
        batch = replace(batch, value_targets=3.0 * signal)
        fit(policy, batch, limit, DEFAULTS, n_steps=5)
        errors.append((values_of(policy, batch) - batch.value_targets).square().mean().item())
    assert errors[1] < errors[0]


# What is left when a step fails


@each_kind
def test_a_rejected_fit_changes_no_bit(kind: str) -> None:
    policy = policy_of(kind)
    batch = training_batch(policy)
    before = state_of(policy)
    record = fit(policy, batch, 1e12, replace(DEFAULTS, radius=1e12, max_scale=1e9, max_trials=2), n_steps=4)
    assert [step.accepted for step in record.steps] == [False, False], "with the shared parameters, and without"
    assert record.policy_kl == 0.0
    assert not moved(before, policy)


@each_kind
@pytest.mark.parametrize("bad", [math.inf, math.nan])
def test_without_room_for_the_policy_the_values_own_parameters_go_on(
    kind: str, bad: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Here the divergence of every trial is bad: the first step fails, and the others are those of a fit without it."""
    policies = [policy_of(kind), policy_of(kind)]
    batch = training_batch(policies[0])
    expected = fit(policies[0], batch, None, DEFAULTS, n_steps=2)
    real = SharedParameters.step

    def far_away(*args: Any) -> SharedStep:
        step = real(*args)
        return replace(step, constraint=replace(step.constraint, divergence=lambda: bad))

    monkeypatch.setattr(SharedParameters, "step", far_away)
    record = fit(policies[1], batch, 1e-3, DEFAULTS, n_steps=3)
    assert record.steps[0].accepted is False
    assert record.steps[1:] == expected.steps
    assert record.policy_kl == 0.0
    assert differing(state_of(policies[0]), state_of(policies[1])) == []


def test_a_limit_that_is_used_up_leaves_the_fit_of_frozen_features() -> None:
    policies = [policy_of("all layers"), policy_of("all layers")]
    batch = training_batch(policies[0])
    expected = fit(policies[0], batch, None, DEFAULTS, n_steps=3)
    assert fit(policies[1], batch, 0.0, DEFAULTS, n_steps=3).steps == expected.steps
    assert differing(state_of(policies[0]), state_of(policies[1])) == []


@pytest.mark.parametrize("validate_args", [True, False], ids=["torch refuses them", "as after torch.compile"])
def test_distribution_parameters_that_are_not_finite_are_infinitely_far(
    validate_args: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(th.distributions.Distribution, "_validate_args", validate_args)
    policy = policy_of("all layers")
    batch = training_batch(policy)
    shared = SharedParameters(policy, groups_of(policy, batch), batch, 1e-3)
    with th.no_grad():
        policy.mlp_extractor.policy_net[0].weight.fill_(math.nan)
    assert shared.divergence() == math.inf
