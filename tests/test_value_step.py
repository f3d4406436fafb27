"""The value step against least squares and dense matrices, its constraint, and what it must leave alone."""

import math
from dataclasses import replace

import pytest
import torch as th
from oracles import ACTION_SPACES, OF_IMAGES, double_policy, jacobian, moved, state_of, training_batch
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.utils import explained_variance

from sb3_gae import NumericalError, SharedMlpPolicy
from sb3_gae.batch import TrainingBatch, take
from sb3_gae.networks.parameters import flatten
from sb3_gae.update import value_step
from sb3_gae.update.policy_step import policy_parameters
from sb3_gae.update.trust_region import TrustRegionSettings
from sb3_gae.update.value_step import (
    PRIOR_PRECISION,
    ValueFitRecord,
    automatic_damping,
    value_parameters,
    value_steps,
)

BOX = ACTION_SPACES["Box"]
EXACT = TrustRegionSettings(radius=0.05, cg_max_steps=300, cg_damping=0.0, max_scale=1.0)
DAMPED = replace(EXACT, cg_max_steps=10, cg_damping=1e-2, radius=0.2)
LINEAR = dict(net_arch=dict(pi=[3], vf=[]))

KINDS = {
    "linear": LINEAR,
    "network": {},
    "shared convolution": OF_IMAGES,
    "own convolution": {**OF_IMAGES, "share_features_extractor": False},
    "gSDE": dict(use_sde=True),
    "first layer shared": dict(policy_class=SharedMlpPolicy, net_arch=dict(pi=[5], vf=[5, 4])),
}
each_kind = pytest.mark.parametrize("kwargs", KINDS.values(), ids=KINDS.keys())


def fit(
    policy: ActorCriticPolicy,
    batch: TrainingBatch,
    settings: TrustRegionSettings = EXACT,
    n_steps: int = 1,
    subset: th.Tensor | None = None,
) -> ValueFitRecord:
    return value_steps(policy, value_parameters_of(policy, batch), batch, settings, n_steps, subset)


def value_parameters_of(policy: ActorCriticPolicy, batch: TrainingBatch) -> list[th.Tensor]:
    return value_parameters(policy, batch, policy_parameters(policy, batch))


def values_of(policy: ActorCriticPolicy, batch: TrainingBatch) -> th.Tensor:
    with th.no_grad():
        return policy.predict_values(batch.observations).squeeze(1)


def variance_of(policy: ActorCriticPolicy, batch: TrainingBatch) -> float:
    """The paper's sigma squared, in units of the squared reward."""
    return (values_of(policy, batch) - batch.value_targets).square().mean().item()


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


# --- Several steps ---


@each_kind
@pytest.mark.parametrize("damping", [1e-2, 0.5])
def test_several_steps_are_single_steps_with_one_damping_of_the_undivided_matrix(kwargs: dict, damping: float) -> None:
    together, one_by_one = (double_policy(BOX, **kwargs) for _ in range(2))
    batch = training_batch(together)
    settings = replace(DAMPED, cg_damping=damping)
    first_variance = variance_of(together, batch)
    records = fit(together, batch, settings, n_steps=4).steps
    singles = []
    for _ in range(4):
        of_this_step = damping * first_variance / variance_of(one_by_one, batch)
        singles += fit(one_by_one, batch, replace(settings, cg_damping=of_this_step)).steps
    assert [record.trials for record in records] == [single.trials for single in singles]
    assert [record.divergence for record in records] == pytest.approx([single.divergence for single in singles], rel=1e-6)
    th.testing.assert_close(values_of(together, batch), values_of(one_by_one, batch), rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("n_steps", [1, 2, 5])
@pytest.mark.parametrize("damping", [1e-2, 0.5])
def test_steps_of_linear_values_are_ridge_regressions_from_where_each_begins(n_steps: int, damping: float) -> None:
    policy = double_policy(BOX, **LINEAR)
    batch = training_batch(policy)
    parameters = value_parameters_of(policy, batch)
    rows = jacobian(lambda: policy.predict_values(batch.observations), parameters)
    errors = batch.value_targets - values_of(policy, batch)
    penalty = damping * errors.square().mean() / batch.value_targets.square().mean()
    matrix = rows.t() @ rows / len(batch) + penalty * th.eye(rows.shape[1], dtype=th.float64)
    # What a step leaves of the errors: iterated Tikhonov regularisation
    left = th.eye(len(batch), dtype=th.float64) - rows @ th.linalg.solve(matrix, rows.t()) / len(batch)
    fit(policy, batch, replace(EXACT, radius=1e9, cg_damping=damping), n_steps)
    expected = th.linalg.matrix_power(left, n_steps) @ errors
    th.testing.assert_close(batch.value_targets - values_of(policy, batch), expected, rtol=1e-6, atol=1e-8)


def test_the_automatic_damping_is_a_prior_on_how_far_parameters_move() -> None:
    """The mean of a Bayesian's belief about linear values, whose prior knows nothing of the number of samples."""
    policy = double_policy(BOX, **LINEAR)
    batch = training_batch(policy)
    parameters = value_parameters_of(policy, batch)
    rows = jacobian(lambda: policy.predict_values(batch.observations), parameters)
    errors = batch.value_targets - values_of(policy, batch)
    before = flatten(parameters)
    noise = errors.square().mean() / batch.value_targets.square().mean()
    precision = PRIOR_PRECISION * th.eye(rows.shape[1], dtype=th.float64)
    posterior_mean = th.linalg.solve(rows.t() @ rows / noise + precision, rows.t() @ errors / noise)
    fit(policy, batch, replace(EXACT, radius=1e9, cg_damping=automatic_damping(len(batch))))
    th.testing.assert_close(flatten(parameters) - before, posterior_mean, rtol=1e-6, atol=1e-9)


@each_kind
@pytest.mark.parametrize("head_scale", [1.0, 20.0])
def test_the_record_has_the_values_before_and_after_in_units_of_the_reward(kwargs: dict, head_scale: float) -> None:
    policy = double_policy(BOX, **kwargs)
    policy.value_net.scale.fill_(head_scale)
    batch = training_batch(policy)
    before = values_of(policy, batch)
    fitted = fit(policy, batch, DAMPED, n_steps=3)
    assert len(fitted.steps) == 3
    th.testing.assert_close(fitted.values_before, before, rtol=1e-12, atol=1e-12)
    th.testing.assert_close(fitted.values_after, values_of(policy, batch), rtol=1e-12, atol=1e-12)
    assert (fitted.values_after - fitted.values_before).abs().max() > 0.1


@each_kind
def test_explained_variance_rises(kwargs: dict) -> None:
    policy = double_policy(BOX, **kwargs)
    batch = training_batch(policy)
    # Something that can be learnt, in noise
    signal = batch.observations.double().flatten(1)[:, 0]
    batch = replace(batch, value_targets=batch.value_targets + 5.0 * signal / signal.std())
    fitted = fit(policy, batch, DAMPED, n_steps=5)
    targets = batch.value_targets.numpy()
    before, after = (explained_variance(each.numpy(), targets) for each in (fitted.values_before, fitted.values_after))
    assert after > before
    assert after > 0.5 or "features_extractor_class" in kwargs


# --- What stays as it is ---


@each_kind
def test_nothing_that_the_policy_depends_on_moves(kwargs: dict) -> None:
    policy = double_policy(BOX, **kwargs)
    batch = training_batch(policy)
    of_value = {id(parameter) for parameter in value_parameters_of(policy, batch)}
    names = {name for name, parameter in policy.named_parameters(remove_duplicate=False) if id(parameter) in of_value}
    with th.no_grad():
        log_prob = policy.get_distribution(batch.observations).log_prob(batch.actions)
    before = state_of(policy)
    assert fit(policy, batch, DAMPED, n_steps=3).steps[0].accepted
    assert moved(before, policy) == names
    with th.no_grad():
        assert th.equal(policy.get_distribution(batch.observations).log_prob(batch.actions), log_prob)


def test_without_an_error_there_is_no_step() -> None:
    policy = double_policy(BOX)
    with th.no_grad():
        for parameter in policy.value_net.parameters():
            parameter.zero_()
    batch = training_batch(policy)
    batch = replace(batch, value_targets=th.zeros_like(batch.value_targets))
    before = state_of(policy)
    fitted = fit(policy, batch, DAMPED, n_steps=3)
    assert fitted.steps == []
    assert not fitted.values_after.any()
    assert not moved(before, policy)


@each_kind
@pytest.mark.parametrize("reward_scale", [1e-10, 1.0, 1e10])
def test_an_error_of_rounding_alone_is_not_fitted(kwargs: dict, reward_scale: float) -> None:
    policy = double_policy(BOX, **kwargs)
    with th.no_grad():
        for parameter in policy.value_net.parameters():
            parameter.mul_(reward_scale)
    batch, rounding = training_batch(policy), th.finfo(th.float64).eps
    values = values_of(policy, batch)
    before = state_of(policy)
    assert fit(policy, replace(batch, value_targets=values * (1.0 + rounding)), DAMPED).steps == []
    assert not moved(before, policy)
    assert fit(policy, replace(batch, value_targets=values * (1.0 + 1e4 * rounding)), DAMPED).steps != []


@each_kind
def test_no_steps_and_no_parameters_move_nothing(kwargs: dict) -> None:
    policy = double_policy(BOX, **kwargs)
    batch = training_batch(policy)
    before = state_of(policy)
    for fitted in (fit(policy, batch, DAMPED, n_steps=0), value_steps(policy, [], batch, DAMPED, 3)):
        assert fitted.steps == []
        assert th.equal(fitted.values_before, fitted.values_after)
    assert not moved(before, policy)


@each_kind
def test_the_first_rejected_step_is_the_last_and_changes_no_bit(kwargs: dict) -> None:
    policy = double_policy(BOX, **kwargs)
    batch = training_batch(policy)
    before = state_of(policy)
    # Far beyond the minimum on purpose, where the error is larger than it was
    fitted = fit(policy, batch, replace(DAMPED, radius=1e12, max_scale=math.inf, max_trials=2), n_steps=4)
    assert [step.accepted for step in fitted.steps] == [False]
    assert (fitted.steps[0].divergence, fitted.steps[0].objective_after) == (0.0, -0.5)
    assert th.equal(fitted.values_before, fitted.values_after)
    assert not moved(before, policy)


@each_kind
@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_targets_that_are_not_finite_are_an_error_before_anything_moves(kwargs: dict, bad: float) -> None:
    policy = double_policy(BOX, **kwargs)
    batch = training_batch(policy)
    batch.value_targets[2] = bad
    before = state_of(policy)
    with pytest.raises(NumericalError, match="gradient of the value function"):
        fit(policy, batch, DAMPED)
    assert not moved(before, policy)


def test_values_need_no_scaled_head() -> None:
    policies = [double_policy(BOX), double_policy(BOX)]
    policies[1].value_net = policies[1].value_net.unscaled()
    batch = training_batch(policies[0])
    fitted = [fit(policy, batch, DAMPED, n_steps=2) for policy in policies]
    assert fitted[0].steps == fitted[1].steps
    assert th.equal(fitted[0].values_after, fitted[1].values_after)
    assert th.equal(values_of(policies[0], batch), values_of(policies[1], batch))


def test_a_subset_of_everything_is_everything() -> None:
    policies = [double_policy(BOX), double_policy(BOX)]
    batch = training_batch(policies[0])
    everything = th.arange(len(batch))
    assert th.equal(take(batch.observations, everything), batch.observations)
    fitted = [fit(policy, batch, DAMPED, 2, subset) for policy, subset in zip(policies, (None, everything), strict=True)]
    th.testing.assert_close(fitted[0].values_after, fitted[1].values_after, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("reward_scale", [1.0, 1e3])
def test_a_policy_whose_values_have_no_scale_of_their_own_learns_whatever_the_unit_of_the_reward(reward_scale: float) -> None:
    th.manual_seed(0)
    policy = ActorCriticPolicy(BOX, BOX, lambda _: 0.0)
    observations = th.randn(500, *BOX.shape)
    signal = observations.flatten(1)[:, 0]
    batch = TrainingBatch(observations, th.zeros(500, *BOX.shape), signal, reward_scale * signal)
    settings = TrustRegionSettings(radius=0.2, cg_max_steps=10, cg_damping=1e-2, cg_progress_tolerance=0.1, max_scale=1.0)
    for _ in range(8):
        fitted = fit(policy, batch, settings, n_steps=5)
    assert explained_variance(fitted.values_after.numpy(), batch.value_targets.numpy()) > 0.9
