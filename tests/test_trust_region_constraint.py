"""A trust-region step with a second constraint, on problems whose answer is known in closed form."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch as th
from hypothesis import given
from hypothesis import strategies as st
from quadratics import EXACT, Quadratic, never

from sb3_gae import NumericalError
from sb3_gae.update.trust_region import Constraint, LocalProblem, trust_region_step


class Constrained(Quadratic):
    r"""Another divergence :math:`\frac12\Delta^\top F\Delta`, of the last coordinates alone."""

    def __init__(self, radius: float, n_free: int = 3, **kwargs):
        super().__init__(**kwargs)
        n = len(self.gradient)
        factor = th.randn(n, n, generator=th.Generator().manual_seed(9), dtype=th.float64)
        self.coordinates = th.arange(n) >= n_free
        self.fisher = 5.0 * factor @ factor.t() * self.coordinates * self.coordinates[:, None]
        self.radius = radius

    def constraint(self, **changes) -> Constraint:
        given = Constraint(self.radius, lambda v: self.fisher @ v, self.coordinates, self.radius, self.divergence)
        return replace(given, **changes)

    def divergence(self) -> float:
        return 0.5 * self.moved().dot(self.fisher @ self.moved()).item()

    def constrained_problem(self, **changes) -> LocalProblem:
        return self.problem(constraint=self.constraint(**changes))


@given(st.integers(5, 12), st.integers(0, 1000), st.floats(-5, 2), st.floats(-5, 2), st.sampled_from([0.0, 1.0]))
def test_with_two_constraints_the_first_trial_is_the_longest_within_both_and_not_beyond_the_minimum(
    n: int, seed: int, log_radius: float, log_other: float, objective_curvature: float
) -> None:
    quadratic = Constrained(10**log_other, n=n, seed=seed, objective_curvature=objective_curvature)
    settings = replace(EXACT, radius=10**log_radius, max_scale=1.0 if objective_curvature else math.inf)
    trust_region_step(quadratic.constrained_problem(), settings)
    first = quadratic.trials[0]
    metric = quadratic.hessian + settings.radius / quadratic.radius * quadratic.fisher
    direction = th.linalg.solve(metric, quadratic.gradient)
    th.testing.assert_close(first / first.norm(), direction / direction.norm(), rtol=1e-3, atol=1e-4)
    first_order = quadratic.gradient.dot(first).item()
    used = first.dot(quadratic.hessian @ first).item()
    limits = [
        0.5 * used / settings.radius,
        0.5 * first.dot(quadratic.fisher @ first).item() / quadratic.radius,
        math.sqrt(used / first_order * objective_curvature),
    ]
    assert max(limits) == pytest.approx(1.0)


def test_the_step_gains_more_than_one_over_root_two_of_the_best_within_both_constraints() -> None:
    """The best to first order, from the two multipliers by brute force."""
    quadratic = Constrained(1e-3)
    trust_region_step(quadratic.constrained_problem(), EXACT)
    gain = quadratic.gradient.dot(quadratic.trials[0]).item()
    best = 0.0
    for weight in np.geomspace(1e-4, 1e6, 2001):
        direction = th.linalg.solve(quadratic.hessian + weight * quadratic.fisher, quadratic.gradient)
        to_radius, to_other = (
            math.sqrt(2.0 * radius / direction.dot(matrix @ direction).item())
            for radius, matrix in ((EXACT.radius, quadratic.hessian), (quadratic.radius, quadratic.fisher))
        )
        best = max(best, min(to_radius, to_other) * quadratic.gradient.dot(direction).item())
    assert best / math.sqrt(2.0) < gain <= best * (1 + 1e-9)


def test_the_limit_holds_for_the_true_divergence_whatever_the_model_says() -> None:
    quadratic = Constrained(1e-3, n_free=0)
    # Four times what the model takes it for
    record = trust_region_step(
        quadratic.constrained_problem(divergence=lambda: 4.0 * quadratic.divergence()), replace(EXACT, radius=10.0)
    )
    assert record.accepted and record.trials > 1
    assert 0.3 * quadratic.radius < 4.0 * quadratic.divergence() <= quadratic.radius


@pytest.mark.parametrize(("excess", "second"), [(1.05, 0.99 / math.sqrt(1.05)), (4.0, 0.8), (math.inf, 0.8), (math.nan, 0.8)])
def test_a_step_that_takes_the_second_divergence_too_far_is_shortened_as_for_the_first(excess: float, second: float) -> None:
    quadratic = Constrained(1e-3)
    divergences = iter([excess * quadratic.radius, 0.0])
    problem = quadratic.constrained_problem(divergence=lambda: next(divergences))
    record = trust_region_step(problem, replace(EXACT, radius=10.0))
    assert (record.trials, record.length) == (2, pytest.approx(second))


@pytest.mark.parametrize("bad", [math.inf, math.nan, 1.0])
def test_a_second_divergence_that_is_too_large_for_every_trial_leaves_every_bit(bad: float) -> None:
    quadratic = Constrained(1e-3)
    assert not trust_region_step(quadratic.constrained_problem(divergence=lambda: bad), EXACT).accepted
    assert quadratic.untouched()


def test_a_second_divergence_that_a_step_does_not_change_sets_no_limit() -> None:
    quadratic, free = Constrained(1e-9, n_free=6), Quadratic()
    trust_region_step(quadratic.constrained_problem(), EXACT)
    trust_region_step(free.problem(), EXACT)
    th.testing.assert_close(quadratic.trials[0], free.trials[0], rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("damping", [0.01, 1.0])
def test_damping_turns_the_direction_and_leaves_both_radii(damping: float) -> None:
    quadratic = Constrained(1e-3)
    settings = replace(EXACT, cg_damping=damping, radius=10.0)
    trust_region_step(quadratic.constrained_problem(), settings)
    first = quadratic.trials[0]
    weight = settings.radius / quadratic.radius
    metric = quadratic.hessian + weight * quadratic.fisher + damping * th.eye(6, dtype=th.float64)
    direction = th.linalg.solve(metric, quadratic.gradient)
    th.testing.assert_close(first / first.norm(), direction / direction.norm(), rtol=1e-3, atol=1e-4)
    assert max(
        0.5 * first.dot(quadratic.hessian @ first).item() / settings.radius,
        0.5 * first.dot(quadratic.fisher @ first).item() / quadratic.radius,
    ) == pytest.approx(1.0)


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_product_of_the_second_constraint_that_is_not_finite_is_an_error(bad: float) -> None:
    quadratic = Constrained(1e-3)
    problem = quadratic.constrained_problem(curvature=lambda vector: th.full_like(vector, bad))
    for damping in (0.0, 0.1):
        with pytest.raises(NumericalError, match="curvature product of the test contains NaN or infinity"):
            trust_region_step(replace(problem, evaluate=never), replace(EXACT, cg_damping=damping))
    assert quadratic.untouched()
