"""One trust-region step on problems whose answer is known in closed form, and what is left when it fails."""

import math
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch as th
from hypothesis import given
from hypothesis import strategies as st
from quadratics import EXACT, Quadratic, never

from sb3_gae import NumericalError
from sb3_gae.networks.parameters import assign, flatten
from sb3_gae.update.conjugate_gradient import CGStatus
from sb3_gae.update.trust_region import StepRecord, trust_region_step


def bad_from(trial: int, *values: float) -> Callable[[Quadratic], Callable[[], tuple[float, float]]]:
    """An evaluation that returns ``values`` from a trial on."""
    return lambda quadratic: lambda: values if len(quadratic.trials) >= trial else quadratic.evaluate()  # type: ignore[return-value]


# --- The step ---


@given(st.integers(5, 12), st.integers(0, 1000), st.floats(-6, 3))
def test_first_trial_is_the_closed_form_and_lies_on_the_radius(n: int, seed: int, log_radius: float) -> None:
    quadratic, radius = Quadratic(n, seed), 10**log_radius
    trust_region_step(quadratic.problem(), replace(EXACT, radius=radius))
    first = quadratic.trials[0]
    assert 0.5 * first.dot(quadratic.hessian @ first).item() == pytest.approx(radius, rel=1e-9)
    th.testing.assert_close(first, quadratic.closed_form(radius), rtol=1e-4, atol=1e-5 * first.norm().item())


def test_a_linear_objective_gains_all_that_the_radius_allows() -> None:
    quadratic = Quadratic()

    def evaluate() -> tuple[float, float]:
        objective, divergence = quadratic.evaluate()
        return objective, divergence * (1 - 1e-9)  # so that rounding cannot push it over the radius

    record = trust_region_step(quadratic.problem(evaluate=evaluate), EXACT)
    assert record.accepted
    assert record.trials == 1
    assert record.divergence == pytest.approx(EXACT.radius)
    best = math.sqrt(2.0 * EXACT.radius * quadratic.gradient.dot(quadratic.natural_gradient()).item())
    assert record.objective_after - record.objective_before == pytest.approx(best)


@pytest.mark.parametrize("steps", [1, 2, 3])
def test_a_truncated_solve_still_ends_on_the_radius(steps: int) -> None:
    quadratic = Quadratic()
    record = trust_region_step(quadratic.problem(), replace(EXACT, cg_max_steps=steps))
    first = quadratic.trials[0]
    assert (record.cg_status, record.cg_steps) == (CGStatus.MAX_STEPS, steps)
    assert 0.5 * first.dot(quadratic.hessian @ first).item() == pytest.approx(EXACT.radius, rel=1e-9)
    assert quadratic.gradient.dot(first) > 0


@pytest.mark.parametrize("damping", [0.01, 1.0, 100.0])
def test_damping_turns_the_direction_and_leaves_the_radius(damping: float) -> None:
    quadratic = Quadratic()
    trust_region_step(quadratic.problem(), replace(EXACT, cg_damping=damping))
    first = quadratic.trials[0]
    damped = th.linalg.solve(quadratic.hessian + damping * th.eye(6, dtype=th.float64), quadratic.gradient)
    th.testing.assert_close(first / first.norm(), damped / damped.norm(), rtol=1e-4, atol=1e-5)
    assert 0.5 * first.dot(quadratic.hessian @ first).item() == pytest.approx(EXACT.radius, rel=1e-6)


@pytest.mark.parametrize("dtype", [th.float32, th.float64])
@pytest.mark.parametrize("scale", [1e-30, 1e-10, 1.0, 1e10, 1e30])
def test_the_scale_of_the_gradient_does_not_matter(scale: float, dtype: th.dtype) -> None:
    quadratic, unit = Quadratic(scale=scale), Quadratic()
    hessian = quadratic.hessian.to(dtype)
    problem = quadratic.problem(
        parameters=[parameter.to(dtype) for parameter in quadratic.parameters],
        gradient=quadratic.gradient.to(dtype),
        curvature=lambda vector: hessian @ vector,
        evaluate=lambda: (8.0, 0.0),
    )
    origin = flatten(problem.parameters)
    record = trust_region_step(problem, EXACT)
    assert record.accepted
    expected = unit.closed_form(EXACT.radius)
    th.testing.assert_close((flatten(problem.parameters) - origin).double(), expected, rtol=1e-3, atol=1e-5)


def test_least_squares_ends_in_its_minimum_when_that_is_within_the_radius() -> None:
    # Its own curvature is the metric; without a limit the step would run on to the radius
    quadratic = Quadratic(objective_curvature=1.0)
    record = trust_region_step(quadratic.problem(), replace(EXACT, radius=1e6, max_scale=1.0))
    assert (record.accepted, record.trials) == (True, 1)
    minimiser = quadratic.natural_gradient()
    th.testing.assert_close(quadratic.moved(), minimiser, rtol=1e-4, atol=1e-5)
    assert record.divergence == pytest.approx(0.5 * minimiser.dot(quadratic.hessian @ minimiser).item())


def test_least_squares_ends_on_the_radius_when_its_minimum_is_beyond() -> None:
    quadratic = Quadratic(objective_curvature=1.0)
    trust_region_step(quadratic.problem(), replace(EXACT, radius=1e-4, max_scale=1.0))
    first = quadratic.trials[0]
    th.testing.assert_close(first, quadratic.closed_form(1e-4), rtol=1e-4, atol=1e-6)


# --- The search ---


@pytest.mark.parametrize("rejected", [1, 2, 5])
def test_each_trial_is_shorter_by_the_factor_and_the_first_good_one_is_kept(rejected: int) -> None:
    quadratic = Quadratic()
    problem = quadratic.problem(
        evaluate=lambda: (quadratic.evaluate()[0], 0.0 if len(quadratic.trials) > rejected else math.inf)
    )
    record = trust_region_step(problem, replace(EXACT, shrinking_factor=0.5))
    assert (record.accepted, record.trials) == (True, rejected + 1)
    assert len(quadratic.trials) == rejected + 1
    for trial, move in enumerate(quadratic.trials):
        th.testing.assert_close(move, 0.5**trial * quadratic.trials[0], rtol=1e-9, atol=1e-12)
    assert th.equal(quadratic.moved(), quadratic.trials[-1])
    assert record.objective_after == pytest.approx(7.0 + quadratic.gradient.dot(quadratic.moved()).item())


def test_a_divergence_over_the_radius_is_rejected_and_on_it_accepted() -> None:
    for excess, trials in [(0.0, 1), (1e-12, 2)]:
        quadratic = Quadratic()
        divergences = iter([EXACT.radius + excess, 0.0])
        problem = quadratic.problem(evaluate=lambda: (8.0, next(divergences)))  # noqa: B023
        assert trust_region_step(problem, EXACT).trials == trials


@pytest.mark.parametrize(("excess", "second"), [(1.05, 0.99 / math.sqrt(1.05)), (4.0, 0.8), (math.inf, 0.8)])
def test_a_step_that_is_only_a_little_too_long_is_shortened_to_just_within_the_radius(excess: float, second: float) -> None:
    quadratic = Quadratic()
    divergences = iter([excess * EXACT.radius, 2 * EXACT.radius, 0.0])
    problem = quadratic.problem(evaluate=lambda: (quadratic.evaluate()[0], next(divergences)))
    record = trust_region_step(problem, replace(EXACT, shrinking_factor=0.8))
    assert (record.trials, record.length) == (3, pytest.approx(0.8 * second))
    th.testing.assert_close(quadratic.moved(), 0.8 * second * quadratic.trials[0], rtol=1e-9, atol=1e-12)


def test_an_objective_that_does_not_rise_is_rejected() -> None:
    for objective in (7.0, 6.0, -math.inf, math.inf):
        quadratic = Quadratic()
        record = trust_region_step(quadratic.problem(evaluate=lambda: (objective, 0.0)), EXACT)  # noqa: B023
        assert not record.accepted
        assert quadratic.untouched()


@pytest.mark.parametrize("values", [(math.nan, 0.0), (8.0, math.nan), (math.nan, math.nan), (8.0, math.inf)])
def test_trials_that_are_not_finite_are_rejected(values: tuple[float, float]) -> None:
    quadratic = Quadratic()
    record = trust_region_step(quadratic.problem(evaluate=bad_from(0, *values)(quadratic)), EXACT)
    assert not record.accepted
    assert quadratic.untouched()


def test_a_failed_search_restores_every_bit_and_records_that_nothing_happened() -> None:
    quadratic = Quadratic()
    # Numbers that an addition and subtraction of the step would not give back
    assign(quadratic.parameters, th.tensor([0.1, 1e-300, 1e300, -0.3, 5e-324, -0.0], dtype=th.float64))
    before = [parameter.clone() for parameter in quadratic.parameters]
    record = trust_region_step(quadratic.problem(evaluate=lambda: (6.0, 0.5)), replace(EXACT, max_trials=4))
    assert record == StepRecord(False, 7.0, 7.0, 0.0, 4, 0.0, CGStatus.CONVERGED, record.cg_steps)
    for parameter, copy in zip(quadratic.parameters, before, strict=True):
        assert th.equal(parameter, copy)
        assert th.equal(parameter.signbit(), copy.signbit())


@pytest.mark.parametrize("error", [RuntimeError, ValueError, KeyboardInterrupt, SystemExit])
@pytest.mark.parametrize("trial", [0, 2])
def test_whatever_is_raised_in_a_trial_passes_through_and_restores_the_parameters(
    error: type[BaseException], trial: int
) -> None:
    quadratic = Quadratic()

    def evaluate() -> tuple[float, float]:
        if len(quadratic.trials) == trial:
            assert not quadratic.untouched()
            raise error
        return quadratic.evaluate()[0], math.inf

    with pytest.raises(error):
        trust_region_step(quadratic.problem(evaluate=evaluate), EXACT)
    assert quadratic.untouched()


def test_the_record_of_an_accepted_step_is_what_is_there_now() -> None:
    quadratic = Quadratic()
    record = trust_region_step(quadratic.problem(), EXACT)
    objective, divergence = quadratic.evaluate()
    assert record == StepRecord(
        True, 7.0, objective, divergence, record.trials, record.length, CGStatus.CONVERGED, record.cg_steps
    )
    assert 0.0 < divergence <= EXACT.radius
    assert objective > 7.0
    assert 1 <= record.cg_steps <= 7


# --- No step ---


def test_a_zero_gradient_moves_nothing() -> None:
    quadratic = Quadratic(scale=0.0)
    record = trust_region_step(quadratic.problem(evaluate=never), EXACT)
    assert record == StepRecord(False, 7.0, 7.0, 0.0, 0, 0.0, CGStatus.ZERO_GRADIENT, 0)
    assert quadratic.untouched()


@pytest.mark.parametrize("factor", [0.0, -1.0], ids=["flat", "concave"])
def test_without_positive_curvature_nothing_moves(factor: float) -> None:
    quadratic = Quadratic()
    record = trust_region_step(quadratic.problem(curvature=lambda vector: factor * vector, evaluate=never), EXACT)
    assert record == StepRecord(False, 7.0, 7.0, 0.0, 0, 0.0, CGStatus.NON_POSITIVE_CURVATURE, 0)
    assert quadratic.untouched()


def test_no_solver_steps_move_nothing() -> None:
    quadratic = Quadratic()
    record = trust_region_step(quadratic.problem(evaluate=never), replace(EXACT, cg_max_steps=0))
    assert record == StepRecord(False, 7.0, 7.0, 0.0, 0, 0.0, CGStatus.MAX_STEPS, 0)
    assert quadratic.untouched()


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_a_gradient_that_is_not_finite_is_an_error_that_says_so(bad: float) -> None:
    quadratic = Quadratic()
    quadratic.gradient[1] = bad
    with pytest.raises(NumericalError, match="gradient of the test contains NaN or infinity"):
        trust_region_step(quadratic.problem(evaluate=never), EXACT)
    assert quadratic.untouched()


@pytest.mark.parametrize("bad", [math.nan, math.inf])
@pytest.mark.parametrize("good_products", [0, 2])
def test_a_curvature_product_that_is_not_finite_is_an_error_that_says_so(bad: float, good_products: int) -> None:
    quadratic, products = Quadratic(), []

    def curvature(vector: th.Tensor) -> th.Tensor:
        products.append(quadratic.hessian @ vector)
        return products[-1] if len(products) <= good_products else th.full_like(vector, bad)

    with pytest.raises(NumericalError, match="curvature product of the test contains NaN or infinity"):
        trust_region_step(quadratic.problem(curvature=curvature, evaluate=never), EXACT)
    assert quadratic.untouched()
