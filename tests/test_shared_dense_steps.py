"""Value fits that move parameters of the policy, too, against dense matrices."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch as th
from oracles import ACTION_SPACES, double_policy, fisher_matrix, jacobian, state_of, training_batch
from shared_fits import DEFAULTS, EXACT, each_kind, fit, groups_of, policy_of, values_of
from stable_baselines3.common.policies import ActorCriticPolicy

from sb3_gae import SharedMlpPolicy
from sb3_gae.batch import TrainingBatch
from sb3_gae.networks.parameters import flatten
from sb3_gae.update import shared_parameters, trust_region, value_step
from sb3_gae.update.conjugate_gradient import conjugate_gradient
from sb3_gae.update.kronecker import KroneckerPreconditioner
from sb3_gae.update.trust_region import TrustRegionSettings


def dense_step(
    policy: ActorCriticPolicy,
    batch: TrainingBatch,
    limit: float,
    settings: TrustRegionSettings,
    subset: th.Tensor | None = None,
) -> th.Tensor:
    """The problem with two ellipsoids, solved by NumPy for the parameters of the value alone and then the shared ones."""
    groups = groups_of(policy, batch)
    everything = slice(None) if subset is None else subset
    rows = jacobian(lambda: policy.predict_values(batch.observations), [*groups.of_value, *groups.of_both])
    errors = batch.value_targets - values_of(policy, batch)
    variance = errors.square().mean()
    gradient = (rows.t() @ errors / len(batch) / variance).numpy()
    curvature_rows = rows[everything]
    hessian = (curvature_rows.t() @ curvature_rows / len(curvature_rows) / variance).numpy()
    fisher = np.zeros_like(hessian)
    n_own = sum(parameter.numel() for parameter in groups.of_value)
    fisher[n_own:, n_own:] = fisher_matrix(policy, batch.observations[everything], groups.of_both).numpy()
    damping = settings.cg_damping / batch.value_targets.square().mean().item()
    metric = hessian + settings.radius / limit * fisher + damping * np.eye(len(hessian))
    step = np.linalg.solve(metric, gradient)
    curvature = step @ hessian @ step
    longest = min(
        math.sqrt(2.0 * settings.radius / curvature),
        math.sqrt(2.0 * limit / (step @ fisher @ step)),
        settings.max_scale * (gradient @ step) / curvature,
    )
    return th.as_tensor(longest * step)


def assert_step_is(
    expected: th.Tensor, policy: ActorCriticPolicy, batch: TrainingBatch, limit: float, settings: Any, subset: Any = None
) -> None:
    groups = groups_of(policy, batch)
    parameters = [*groups.of_value, *groups.of_both]
    before = flatten(parameters)
    (record,) = fit(policy, batch, limit, settings, subset=subset).steps
    assert record.accepted
    assert (flatten(parameters) - before - expected * record.length).norm() <= 2e-4 * record.length * expected.norm()


@each_kind
@pytest.mark.parametrize(
    ("radius", "limit"),
    [(1e-3, 1e-2), (0.5, 1e-5), (0.05, 1e-3), (1e6, 1e4)],
    ids=["values on the radius", "policy on the limit", "both near", "minimum within both"],
)
def test_steps_are_those_of_dense_matrices(kind: str, radius: float, limit: float) -> None:
    policy = policy_of(kind)
    batch = training_batch(policy)
    settings = replace(EXACT, radius=radius)
    assert_step_is(dense_step(policy, batch, limit, settings), policy, batch, limit, settings)


@pytest.mark.parametrize("kind", ["all layers", "convolution"])
def test_both_curvatures_may_come_from_a_subset(kind: str) -> None:
    policy, subset = policy_of(kind), th.tensor([1, 2, 3, 5, 8, 13, 21])
    batch = training_batch(policy)
    settings = replace(EXACT, radius=1e-3)
    expected = dense_step(policy, batch, 1e-3, settings, subset)
    assert not th.allclose(expected, dense_step(policy, batch, 1e-3, settings), rtol=0.01)
    assert_step_is(expected, policy, batch, 1e-3, settings, subset)


@pytest.mark.parametrize("kind", ["all layers", "first layer"])
@pytest.mark.parametrize("limit", [1e-2, None], ids=["joint", "frozen"])
def test_dense_and_autograd_steps_are_the_same(kind: str, limit: float | None, monkeypatch: pytest.MonkeyPatch) -> None:
    policies = [policy_of(kind), policy_of(kind)]
    batch = training_batch(policies[0])
    # Far from the radius: on it rounding would decide which trial is accepted
    settings = replace(EXACT, cg_damping=1.0, radius=10.0)
    fast = fit(policies[0], batch, limit, settings, n_steps=3)
    let_everything_be_differentiated_twice(monkeypatch)
    slow = fit(policies[1], batch, limit, settings, n_steps=3)
    assert len(fast.steps) == len(slow.steps) == 3
    for one, other in zip(policies[0].parameters(), policies[1].parameters(), strict=True):
        th.testing.assert_close(one, other, rtol=1e-3, atol=1e-4)


def let_everything_be_differentiated_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(value_step, "has_dense_value", lambda policy, parameters: False)
    monkeypatch.setattr(shared_parameters, "has_dense_policy", lambda policy, parameters: False)


@pytest.mark.parametrize("seed", range(3))
def test_each_preconditioner_brings_a_few_products_nearer_to_the_solution(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    problems = []
    real = value_step.trust_region_step
    monkeypatch.setattr(value_step, "trust_region_step", lambda *args: (problems.append(args), real(*args))[1])
    arguments: dict[str, Any] = dict(n_inputs=8, policy_class=SharedMlpPolicy, net_arch=[24, 16], seed=seed)
    policy = double_policy(ACTION_SPACES["Box"], **arguments)
    batch, start = training_batch(policy, 600), state_of(policy)
    fit(policy, batch, 1e-4, DEFAULTS)
    # The products are those of the parameters before the step
    policy.load_state_dict(start)
    ((problem, _),) = problems
    coordinates, damping = problem.constraint.coordinates, 1e-2

    def operator(vector: th.Tensor) -> th.Tensor:
        return trust_region._metric(problem, DEFAULTS, vector) + damping * vector

    def gap(precondition: Any, n_products: int = 3) -> float:
        """How far the quadratic is from its maximum, as a part of that."""
        by = None if precondition is None else lambda vector: precondition(vector, damping)
        error = conjugate_gradient(operator, problem.gradient, n_products, preconditioner=by).solution - solution
        return float(error.dot(operator(error)) / solution.dot(problem.gradient))

    solution = conjugate_gradient(operator, problem.gradient, 500, relative_tolerance=1e-12).solution
    scaling = trust_region._scaling(problem, DEFAULTS, coordinates)
    assert gap(problem.precondition) < 0.5 * gap(scaling)
    assert gap(scaling) < 0.1 * gap(None)


def test_the_preconditioner_of_one_layer_knows_what_another_network_adds() -> None:
    """Values and logits of one layer each, on the same features: the sum of their curvatures is inverted exactly."""
    policy = double_policy(ACTION_SPACES["Box"], net_arch=dict(pi=[3], vf=[]))
    observations = training_batch(policy).observations
    network = value_step.dense_value_network(policy, observations)
    network.forward()
    features = th.cat([policy.extract_features(observations), th.ones(network.batch_size, 1)], dim=1)
    curvature = features.t() @ features / network.batch_size
    (linear, _) = network.layers[0]
    preconditioner = KroneckerPreconditioner(network, th.ones(network.batch_size, 1).double(), {linear: th.tensor([[2.5]])})
    vector = th.randn(4).double()
    solution = th.linalg.solve(3.0 * (1.0 + 2.5) * curvature + 0.1 * th.eye(4), vector)
    th.testing.assert_close(preconditioner(vector, 3.0, 0.1), solution)
