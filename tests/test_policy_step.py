"""The policy step against natural gradients from dense matrices, and what it must leave alone."""

import math
from dataclasses import replace

import pytest
import torch as th
from gymnasium import spaces
from oracles import (
    ACTION_SPACES,
    OF_IMAGES,
    actions_and_weights,
    double_policy,
    fisher_matrix,
    jacobian,
    moved,
    state_of,
    training_batch,
)
from stable_baselines3.common.distributions import Distribution
from stable_baselines3.common.policies import ActorCriticPolicy

from sb3_gae import MlpPolicy, NumericalError
from sb3_gae.batch import TrainingBatch, take
from sb3_gae.networks.dense_policy import dense_policy_network, policy_log_std
from sb3_gae.networks.distributions import snapshot
from sb3_gae.networks.parameters import flatten
from sb3_gae.update import policy_step
from sb3_gae.update.conjugate_gradient import CGStatus
from sb3_gae.update.trust_region import StepRecord, TrustRegionSettings

EXACT = TrustRegionSettings(radius=0.01, cg_max_steps=300, cg_damping=0.0)
DAMPED = replace(EXACT, cg_damping=0.1, cg_max_steps=10)

each_space = pytest.mark.parametrize("action_space", ACTION_SPACES.values(), ids=ACTION_SPACES.keys())
each_path = pytest.mark.parametrize("dense", [True, False], ids=["dense", "autograd"])
KINDS = {
    **{name: (space, {}) for name, space in ACTION_SPACES.items()},
    "gSDE": (ACTION_SPACES["Box"], dict(use_sde=True)),
    "squashed gSDE": (ACTION_SPACES["Box"], dict(use_sde=True, squash_output=True)),
    "images": (ACTION_SPACES["Discrete"], OF_IMAGES),
}
each_kind = pytest.mark.parametrize(("action_space", "kwargs"), KINDS.values(), ids=KINDS.keys())


@pytest.fixture
def dense(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> bool:
    if not request.param:
        monkeypatch.setattr(policy_step, "has_dense_policy", lambda policy, parameters: False)
    return request.param


def take_step(
    policy: ActorCriticPolicy, batch: TrainingBatch, settings: TrustRegionSettings = EXACT, subset: th.Tensor | None = None
) -> StepRecord:
    parameters = policy_step.policy_parameters(policy, batch)
    return policy_step.policy_step(policy, parameters, batch, batch.advantages, settings, subset)


def distribution_of(policy: ActorCriticPolicy, batch: TrainingBatch) -> Distribution:
    with th.no_grad():
        return snapshot(policy.get_distribution(batch.observations))


def log_prob_of(policy: ActorCriticPolicy, batch: TrainingBatch) -> th.Tensor:
    return distribution_of(policy, batch).log_prob(batch.actions)


def parameters_of(policy: ActorCriticPolicy, batch: TrainingBatch) -> list[th.Tensor]:
    return [*dense_policy_network(policy, batch.observations).parameters, *policy_log_std(policy)]


def closed_form(
    policy: ActorCriticPolicy, batch: TrainingBatch, settings: TrustRegionSettings, subset: th.Tensor | None = None
) -> th.Tensor:
    """Scaled natural gradient from dense matrices, in the order of :func:`parameters_of`."""
    parameters = parameters_of(policy, batch)
    scores = jacobian(lambda: policy.get_distribution(batch.observations).log_prob(batch.actions), parameters)
    gradient = scores.t() @ batch.advantages / len(batch)
    observations = batch.observations if subset is None else take(batch.observations, subset)
    fisher = fisher_matrix(policy, observations, parameters)
    damped = fisher + settings.cg_damping * th.eye(len(fisher), dtype=th.float64)
    # Shifts of all logits change nothing, so the matrix is singular; the gradient has no part in that direction
    direction = th.linalg.pinv(damped, hermitian=True, rtol=1e-10) @ gradient
    return math.sqrt(2.0 * settings.radius / direction.dot(fisher @ direction).item()) * direction


# --- The direction and its length ---


@each_space
@pytest.mark.parametrize("damping", [0.0, 0.1])
@pytest.mark.parametrize("dense", [True, False], ids=["dense", "autograd"], indirect=True)
def test_linear_policies_take_the_natural_gradient_step_of_dense_matrices(
    action_space: spaces.Space, damping: float, dense: bool
) -> None:
    policy = double_policy(action_space, net_arch=dict(pi=[], vf=[4]))
    batch = training_batch(policy)
    settings = replace(EXACT, cg_damping=damping)
    expected, before = closed_form(policy, batch, settings), flatten(parameters_of(policy, batch))
    record = take_step(policy, batch, settings)
    assert record.accepted
    expected *= record.length
    th.testing.assert_close(flatten(parameters_of(policy, batch)) - before, expected, rtol=1e-4, atol=1e-6)


def test_deep_policies_take_the_natural_gradient_step_of_dense_matrices() -> None:
    policy = double_policy(ACTION_SPACES["Box"])
    batch = training_batch(policy, 80)
    settings = replace(EXACT, cg_damping=0.01)
    expected, before = closed_form(policy, batch, settings), flatten(parameters_of(policy, batch))
    record = take_step(policy, batch, settings)
    expected *= record.length
    th.testing.assert_close(flatten(parameters_of(policy, batch)) - before, expected, rtol=1e-3, atol=1e-5)


def test_curvature_may_come_from_a_subset_while_the_gradient_sees_everything() -> None:
    policy = double_policy(ACTION_SPACES["Box"], net_arch=dict(pi=[], vf=[4]))
    batch, subset = training_batch(policy), th.tensor([1, 2, 3, 5, 8, 13, 21])
    expected, before = closed_form(policy, batch, EXACT, subset), flatten(parameters_of(policy, batch))
    assert not th.allclose(expected, closed_form(policy, batch, EXACT), rtol=0.01)
    record = take_step(policy, batch, replace(EXACT, max_trials=30), subset)
    assert record.accepted
    expected *= record.length
    th.testing.assert_close(flatten(parameters_of(policy, batch)) - before, expected, rtol=1e-4, atol=1e-6)


@each_space
def test_dense_and_autograd_steps_are_the_same(action_space: spaces.Space, monkeypatch: pytest.MonkeyPatch) -> None:
    policies = [double_policy(action_space), double_policy(action_space)]
    batch = training_batch(policies[0])
    # Solved to the end: on the way there the two may differ, by a preconditioner that only one of them has
    settings = replace(DAMPED, cg_max_steps=300)
    fast = take_step(policies[0], batch, settings)
    monkeypatch.setattr(policy_step, "has_dense_policy", lambda policy, parameters: False)
    slow = take_step(policies[1], batch, settings)
    assert (fast.accepted, fast.trials) == (slow.accepted, slow.trials)
    assert fast.cg_status is slow.cg_status is CGStatus.CONVERGED
    assert fast.divergence == pytest.approx(slow.divergence, rel=1e-5)
    for one, other in zip(policies[0].parameters(), policies[1].parameters(), strict=True):
        th.testing.assert_close(one, other, rtol=1e-5, atol=1e-6)


def test_the_step_does_not_depend_on_the_coordinates_of_the_observations() -> None:
    # Whole numbers, so that SB3's conversion to single precision changes nothing
    mixing, offset = th.tensor([[2.0, 1, 0], [0, 1, 3], [1, 0, 1]]), th.tensor([1.0, -2, 5])
    plain, mixed = (double_policy(ACTION_SPACES["Box"], net_arch=dict(pi=[], vf=[4])) for _ in range(2))
    with th.no_grad():
        mixed.action_net.weight.copy_(plain.action_net.weight @ th.linalg.inv(mixing.double()))
        mixed.action_net.bias.copy_(plain.action_net.bias - mixed.action_net.weight @ offset.double())
    batch = training_batch(plain)
    batch = replace(batch, observations=batch.observations.mul(3).round())
    batch_mixed = replace(batch, observations=batch.observations @ mixing.t() + offset)
    th.testing.assert_close(log_prob_of(plain, batch), log_prob_of(mixed, batch_mixed))
    before = distribution_of(plain, batch).distribution.mean

    assert take_step(plain, batch).trials == take_step(mixed, batch_mixed).trials
    after, after_mixed = distribution_of(plain, batch).distribution, distribution_of(mixed, batch_mixed).distribution
    assert (after.mean - before).abs().max() > 0.01
    th.testing.assert_close(after_mixed.mean, after.mean, rtol=1e-4, atol=1e-5)
    th.testing.assert_close(after_mixed.stddev, after.stddev, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("scale", [1e-30, 1e-10, 1e10, 1e30])
@each_space
def test_in_single_precision_the_scale_of_the_advantages_does_not_matter(action_space: spaces.Space, scale: float) -> None:
    moves = []
    for factor in (1.0, scale):
        th.manual_seed(0)
        policy = MlpPolicy(spaces.Box(-10, 10, (3,)), action_space, lambda _: 0.0, net_arch=[4], ortho_init=False)
        batch = training_batch(policy)
        batch = replace(batch, advantages=(batch.advantages * factor).float())
        parameters = policy_step.policy_parameters(policy, batch)
        before = flatten(parameters)
        record = take_step(policy, batch, DAMPED)
        assert record.accepted
        moves.append(flatten(parameters) - before)
    assert (moves[1] - moves[0]).norm() <= 1e-3 * moves[0].norm()


# --- What is promised of any step ---


@each_kind
@pytest.mark.parametrize("radius", [1e-4, 0.01, 0.3])
def test_divergence_stays_within_the_radius_and_the_surrogate_rises(
    action_space: spaces.Space, kwargs: dict, radius: float
) -> None:
    policy = double_policy(action_space, **kwargs)
    batch = training_batch(policy)
    old_log_prob, before = log_prob_of(policy, batch), state_of(policy)
    record = take_step(policy, batch, replace(DAMPED, radius=radius, max_trials=20))
    assert record.accepted
    ratio = th.exp(log_prob_of(policy, batch) - old_log_prob)
    assert record.objective_before == pytest.approx(batch.advantages.mean().item())
    assert record.objective_after == pytest.approx((ratio * batch.advantages).mean().item())
    assert record.objective_after > record.objective_before
    assert record.divergence <= radius
    if action_space is not ACTION_SPACES["Box"]:
        new = distribution_of(policy, batch)
        policy.load_state_dict(before)
        weighted = list(actions_and_weights(distribution_of(policy, batch), len(batch)))
        old = distribution_of(policy, batch)
        expected = sum((weight * (old.log_prob(a) - new.log_prob(a))).mean().item() for a, weight in weighted)
        assert record.divergence == pytest.approx(expected, rel=1e-6)


def test_divergence_of_gaussians_is_the_sum_over_actions_of_the_closed_form() -> None:
    policy = double_policy(ACTION_SPACES["Box"])
    batch = training_batch(policy)
    old = distribution_of(policy, batch).distribution
    record = take_step(policy, batch, DAMPED)
    new = distribution_of(policy, batch).distribution
    ratio, distance = (old.stddev / new.stddev) ** 2, ((old.mean - new.mean) / new.stddev) ** 2
    expected = (0.5 * (ratio + distance - 1 - ratio.log())).sum(dim=1).mean().item()
    assert record.divergence == pytest.approx(expected, rel=1e-9)
    assert 0.5 * DAMPED.radius < record.divergence <= DAMPED.radius


@each_kind
def test_only_what_the_policy_depends_on_moves(action_space: spaces.Space, kwargs: dict) -> None:
    policy = double_policy(action_space, **kwargs)
    batch = training_batch(policy)
    of_policy = {id(parameter) for parameter in policy_step.policy_parameters(policy, batch)}
    allowed = {name for name, parameter in policy.named_parameters(remove_duplicate=False) if id(parameter) in of_policy}
    before = state_of(policy)
    assert take_step(policy, batch, DAMPED).accepted
    assert moved(before, policy) == allowed
    assert not any("value_net" in name for name in allowed)


# --- No step ---


@each_kind
def test_without_advantages_no_bit_changes(action_space: spaces.Space, kwargs: dict) -> None:
    policy = double_policy(action_space, **kwargs)
    batch = training_batch(policy)
    batch = replace(batch, advantages=th.zeros_like(batch.advantages))
    before = state_of(policy)
    assert take_step(policy, batch, DAMPED) == StepRecord(False, 0.0, 0.0, 0.0, 0, 0.0, CGStatus.ZERO_GRADIENT, 0)
    assert not moved(before, policy)


@each_kind
def test_a_failed_search_restores_every_bit(action_space: spaces.Space, kwargs: dict) -> None:
    policy = double_policy(action_space, **kwargs)
    batch = training_batch(policy)
    before, objective = state_of(policy), batch.advantages.mean().item()
    # So long a step that no shorter trial is near: the numbers overflow
    record = take_step(policy, batch, replace(DAMPED, radius=1e30, max_trials=3))
    assert (record.accepted, record.trials, record.divergence) == (False, 3, 0.0)
    assert record.objective_after == record.objective_before == pytest.approx(objective)
    assert not moved(before, policy)


@each_kind
@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_advantages_that_are_not_finite_are_an_error_before_anything_moves(
    action_space: spaces.Space, kwargs: dict, bad: float
) -> None:
    policy = double_policy(action_space, **kwargs)
    batch = training_batch(policy)
    batch.advantages[3] = bad
    before = state_of(policy)
    with pytest.raises(NumericalError, match="gradient of the policy"):
        take_step(policy, batch, DAMPED)
    assert not moved(before, policy)


def test_an_interrupted_search_restores_every_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    policy = double_policy(ACTION_SPACES["Box"])
    batch = training_batch(policy)
    before = state_of(policy)

    def interrupt(*_: object) -> th.Tensor:
        assert moved(before, policy)
        raise KeyboardInterrupt

    monkeypatch.setattr(policy_step, "mean_kl", interrupt)
    with pytest.raises(KeyboardInterrupt):
        take_step(policy, batch, DAMPED)
    assert not moved(before, policy)
