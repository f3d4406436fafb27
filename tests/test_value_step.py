"""A single value step against least squares and dense matrices, and the paper's constraint in every unit."""

import math
from dataclasses import replace

import pytest
import torch as th
from oracles import double_policy, jacobian, training_batch
from stable_baselines3.common.policies import ActorCriticPolicy
from value_fits import BOX, DAMPED, EXACT, LINEAR, each_kind, fit, value_parameters_of, values_of, variance_of

from sb3_gae.batch import TrainingBatch
from sb3_gae.networks.parameters import flatten
from sb3_gae.update import value_step
from sb3_gae.update.trust_region import TrustRegionSettings
from sb3_gae.update.value_step import ValueFitRecord


def unshrunk(change: th.Tensor, fitted: ValueFitRecord) -> th.Tensor:
    """What the first trial of a single step on linear values changed, whichever trial was accepted."""
    return change / fitted.steps[0].length


# --- The constraint, and its units ---


@each_kind
@pytest.mark.parametrize("radius", [1e-4, 0.05, 0.5])
@pytest.mark.parametrize("reward_scale", [1e-3, 1.0, 1e3])
def test_each_step_keeps_to_the_papers_constraint_and_lowers_the_error(
    kwargs: dict, radius: float, reward_scale: float
) -> None:
    policy = double_policy(BOX, **kwargs)
    batch = training_batch(policy)
    batch = replace(batch, value_targets=batch.value_targets * reward_scale)
    for step in range(4):
        before, variance = values_of(policy, batch), variance_of(policy, batch)
        (record,) = fit(policy, batch, replace(DAMPED, radius=radius)).steps
        if step > 0 and not record.accepted:
            break  # in the minimum
        constraint = (values_of(policy, batch) - before).square().mean().item() / (2.0 * variance)
        assert record.accepted
        assert constraint <= radius * (1 + 1e-9)
        assert record.divergence == pytest.approx(constraint, rel=1e-6)
        assert record.objective_before == -0.5
        assert record.objective_after == pytest.approx(-0.5 * variance_of(policy, batch) / variance)
        assert variance_of(policy, batch) < variance


@pytest.mark.parametrize("reward_scale", [1e-6, 0.1, 1.0, 30.0, 1e6])
def test_linear_values_move_by_the_radius_in_units_of_the_error(reward_scale: float) -> None:
    policy = double_policy(BOX, **LINEAR)
    batch = training_batch(policy)
    batch = replace(batch, value_targets=batch.value_targets * reward_scale)
    before, variance = values_of(policy, batch), variance_of(policy, batch)
    fitted = fit(policy, batch)
    change = unshrunk(values_of(policy, batch) - before, fitted)
    assert change.square().mean().item() / (2.0 * variance) == pytest.approx(EXACT.radius, rel=1e-6)


@pytest.mark.parametrize("factor", [1e-6, 1e-3, 1e3, 1e6])
def test_rewards_in_another_unit_scale_the_step_of_linear_values_by_that_unit(factor: float) -> None:
    changes = []
    for scale in (1.0, factor):
        policy = double_policy(BOX, **LINEAR)
        with th.no_grad():
            policy.value_net.weight.mul_(scale)
            policy.value_net.bias.mul_(scale)
        batch = training_batch(policy)
        batch = replace(batch, value_targets=batch.value_targets * scale)
        before = values_of(policy, batch)
        fitted = fit(policy, batch)
        changes.append(unshrunk(values_of(policy, batch) - before, fitted) / scale)
    th.testing.assert_close(changes[1], changes[0], rtol=1e-5, atol=1e-7)


@each_kind
@pytest.mark.parametrize("exponent", [-90, -1, 90])
def test_in_units_of_the_heads_scale_every_step_is_bit_for_bit_the_same(kwargs: dict, exponent: int) -> None:
    # Whatever damping, truncation and search do: settings carry over to rewards of any size
    policies, factor = [double_policy(BOX, **kwargs) for _ in range(2)], 2.0**exponent
    batch = training_batch(policies[0])
    fitted = fit(policies[0], batch, DAMPED, n_steps=3)
    policies[1].value_net.scale.fill_(factor)
    fitted_in_other_units = fit(policies[1], replace(batch, value_targets=batch.value_targets * factor), DAMPED, n_steps=3)
    assert fitted.steps[0].accepted
    assert fitted_in_other_units.steps == fitted.steps
    assert th.equal(fitted_in_other_units.values_after, fitted.values_after * factor)
    for one, other in zip(policies[0].parameters(), policies[1].parameters(), strict=True):
        assert th.equal(one, other)


@pytest.mark.parametrize("head_scale", [1e-3, 50.0])
def test_the_scale_of_the_head_alone_changes_no_undamped_step(head_scale: float) -> None:
    changes, records = [], []
    for scale in (1.0, head_scale):
        policy = double_policy(BOX, **LINEAR)
        with th.no_grad():
            policy.value_net.scale.fill_(scale)
            policy.value_net.weight.div_(scale)
            policy.value_net.bias.div_(scale)
        batch = training_batch(policy)
        before = values_of(policy, batch)
        records.append(fit(policy, batch))
        changes.append(values_of(policy, batch) - before)
        th.testing.assert_close(records[-1].values_after - records[-1].values_before, changes[-1], rtol=1e-9, atol=1e-9)
    moves = [unshrunk(change, record) for change, record in zip(changes, records, strict=True)]
    th.testing.assert_close(moves[1], moves[0], rtol=1e-5, atol=1e-7)


# --- The direction and its length ---


@pytest.mark.parametrize("reward_scale", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize("dense", [True, False], ids=["dense", "autograd"])
def test_linear_values_reach_the_least_squares_solution_in_one_step(
    reward_scale: float, dense: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not dense:
        monkeypatch.setattr(value_step, "has_dense_value", lambda policy, parameters: False)
    policy = double_policy(BOX, **LINEAR)
    batch = training_batch(policy)
    batch = replace(batch, value_targets=batch.value_targets * reward_scale)
    features = th.cat([batch.observations.double(), th.ones(len(batch), 1).double()], dim=1)
    solution = th.linalg.lstsq(features, batch.value_targets[:, None]).solution.squeeze(1)
    (record,) = fit(policy, batch, replace(EXACT, radius=1e9)).steps
    assert (record.accepted, record.trials) == (True, 1)
    th.testing.assert_close(flatten(policy.value_net.parameters()), solution, rtol=1e-5, atol=1e-5 * reward_scale)
    th.testing.assert_close(values_of(policy, batch), features @ solution, rtol=1e-5, atol=1e-5 * reward_scale)


@each_kind
@pytest.mark.parametrize("radius", [1e-3, 1e9], ids=["on the radius", "within it"])
def test_steps_are_those_of_dense_matrices(kwargs: dict, radius: float) -> None:
    policy = double_policy(BOX, **kwargs)
    policy.value_net.scale.fill_(2.0)
    batch = training_batch(policy)
    settings = replace(EXACT, radius=radius, cg_damping=0.05 * (batch.value_targets / 2.0).square().mean().item())
    parameters = value_parameters_of(policy, batch)
    expected, before = dense_step(policy, batch, parameters, settings), flatten(parameters)
    (record,) = fit(policy, batch, settings).steps
    assert record.accepted
    expected *= record.length
    th.testing.assert_close(flatten(parameters) - before, expected, rtol=1e-4, atol=1e-6)


def test_curvature_may_come_from_a_subset_while_the_gradient_sees_everything() -> None:
    policy = double_policy(BOX)
    batch, subset = training_batch(policy), th.tensor([1, 2, 3, 5, 8, 13, 21])
    settings = replace(EXACT, radius=1e-3, cg_damping=0.05)
    parameters = value_parameters_of(policy, batch)
    expected, before = dense_step(policy, batch, parameters, settings, subset), flatten(parameters)
    assert not th.allclose(expected, dense_step(policy, batch, parameters, settings), rtol=0.01)
    (record,) = fit(policy, batch, settings, subset=subset).steps
    assert record.accepted
    expected *= record.length
    th.testing.assert_close(flatten(parameters) - before, expected, rtol=1e-4, atol=1e-6)


def dense_step(
    policy: ActorCriticPolicy,
    batch: TrainingBatch,
    parameters: list[th.Tensor],
    settings: TrustRegionSettings,
    subset: th.Tensor | None = None,
) -> th.Tensor:
    """Section 5 of the paper with matrices, in units of the scale of the values."""
    scale = policy.value_net.scale.item()
    rows = jacobian(lambda: policy.predict_values(batch.observations), parameters) / scale
    errors = (batch.value_targets - values_of(policy, batch)) / scale
    variance = errors.square().mean()
    gradient = rows.t() @ errors / len(batch) / variance
    curvature_rows = rows if subset is None else rows[subset]
    hessian = curvature_rows.t() @ curvature_rows / len(curvature_rows) / variance
    # The damping is meant for targets of mean square 1
    damping = settings.cg_damping / (batch.value_targets / scale).square().mean()
    step = th.linalg.solve(hessian + damping * th.eye(len(hessian), dtype=th.float64), gradient)
    return step * min(1.0, math.sqrt(2.0 * settings.radius / step.dot(hessian @ step).item()))


@each_kind
def test_dense_and_autograd_steps_are_the_same(kwargs: dict, monkeypatch: pytest.MonkeyPatch) -> None:
    policies = [double_policy(BOX, **kwargs), double_policy(BOX, **kwargs)]
    batch = training_batch(policies[0])
    # Solved to the end: on the way there the two may differ, by a preconditioner that only one of them has
    settings = replace(DAMPED, cg_max_steps=300, cg_damping=1.0)
    fast = fit(policies[0], batch, settings, n_steps=3)
    monkeypatch.setattr(value_step, "has_dense_value", lambda policy, parameters: False)
    slow = fit(policies[1], batch, settings, n_steps=3)
    assert [step.trials for step in fast.steps] == [step.trials for step in slow.steps]
    assert len(fast.steps) == 3
    th.testing.assert_close(fast.values_after, slow.values_after, rtol=1e-4, atol=1e-5)
    for one, other in zip(policies[0].parameters(), policies[1].parameters(), strict=True):
        th.testing.assert_close(one, other, rtol=1e-3, atol=1e-4)
