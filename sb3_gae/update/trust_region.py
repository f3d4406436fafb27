r"""
One trust-region step: direction by conjugate gradient, length by the radius, then a search that checks the truth.

The policy step and the value step are both this; they differ in objective, divergence and radius.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch as th

from sb3_gae.errors import NumericalError
from sb3_gae.networks.parameters import assign, flatten
from sb3_gae.update.conjugate_gradient import CGResult, CGStatus, conjugate_gradient
from sb3_gae.update.curvature import CurvatureProduct


@dataclass(frozen=True)
class Constraint:
    r"""
    Another divergence that a step has to keep small.

    :param radius: largest :math:`\frac12 s^\top F s` of the step
    :param curvature: product with :math:`F`, the Hessian of the divergence, (n,) -> (n,)
    :param coordinates: those that the divergence depends on, True and False in shape (n,)
    :param limit: largest true divergence
    :param divergence: the true one, at whatever the parameters then are
    """

    radius: float
    curvature: CurvatureProduct
    coordinates: th.Tensor
    limit: float
    divergence: Callable[[], float]

    def weight(self, radius: float) -> float:
        """
        :param radius: of the problem's own trust region
        :return: what a product with :math:`F` is to be multiplied by, to count as much as one with the problem's curvature
        """
        return radius / self.radius


@dataclass(frozen=True)
class LocalProblem:
    """
    What is known about an objective to be increased, at the present parameters.

    :param name: for messages
    :param parameters: what the step may move, n scalars in all
    :param objective: its value now
    :param gradient: of the objective, shape (n,)
    :param curvature: product with the Hessian of the divergence from the present parameters, (n,) -> (n,)
    :param precondition: given a vector (n,) and the damping, about the inverse of the damped curvature times the
        vector; None if no such approximation is at hand
    :param evaluate: the objective, and the divergence from where the step began, at whatever the parameters then are
    :param constraint: on another divergence, None for none
    """

    name: str
    parameters: Sequence[th.Tensor]
    objective: float
    gradient: th.Tensor
    curvature: CurvatureProduct
    evaluate: Callable[[], tuple[float, float]]
    precondition: Callable[[th.Tensor, float], th.Tensor] | None = None
    constraint: Constraint | None = None


@dataclass(frozen=True)
class TrustRegionSettings:
    """
    :param radius: largest divergence that a step may cause
    :param cg_max_steps: largest number of curvature products for the direction
    :param cg_damping: multiple of the identity that is added to the curvature while solving for the direction
    :param cg_progress_tolerance: the solver ends when a product brings less than this part of what all have brought
    :param shrinking_factor: each further trial is this times as long; the second may be longer, see ``_shortening``
    :param max_trials: number of lengths that are tried
    :param max_scale: longest step as a multiple of the solution of the linear system; 1 for an objective
        whose own curvature is the metric, as in least squares, where more would pass the minimum. With a second
        constraint the solution is of another system: then of the minimiser along the direction
    """

    radius: float
    cg_max_steps: int
    cg_damping: float
    cg_progress_tolerance: float = 0.0
    shrinking_factor: float = 0.8
    max_trials: int = 10
    max_scale: float = math.inf


@dataclass(frozen=True)
class StepRecord:
    """
    What was done, not what was tried: after a rejected step ``divergence`` is 0 and the objective is as before.

    :param accepted: whether the parameters moved; if not, they are bit for bit what they were
    :param objective_before: at the start
    :param objective_after: at the end
    :param divergence: from the start to the end
    :param trials: number of lengths tried
    :param length: of the step that was taken, as a part of the first one tried
    :param cg_status: how the solver ended
    :param cg_steps: curvature products that entered the direction
    """

    accepted: bool
    objective_before: float
    objective_after: float
    divergence: float
    trials: int
    length: float
    cg_status: CGStatus
    cg_steps: int


def trust_region_step(problem: LocalProblem, settings: TrustRegionSettings) -> StepRecord:
    """
    Move the parameters to increase the objective within the radius, or leave them untouched.

    :param problem: objective and divergence around the present parameters
    :param settings: radius, solver and search
    :return: what was done
    :raises NumericalError: if the gradient or a curvature product is not finite; no parameter has moved then
    """
    solved = _direction(problem, settings)
    if solved.status is CGStatus.NON_FINITE:
        what = "gradient" if not th.isfinite(problem.gradient).all() else "curvature product"
        raise NumericalError(f"The {what} of the {problem.name} contains NaN or infinity; the step was not taken.")
    scale = _longest_scale(problem, settings, solved)
    if scale == 0.0:
        return _rejected(problem, solved, trials=0)
    return _line_search(problem, settings, scale * solved.solution, solved)


def _direction(problem: LocalProblem, settings: TrustRegionSettings) -> CGResult:
    damping, precondition = settings.cg_damping, problem.precondition
    if precondition is None and problem.constraint is not None:
        precondition = _scaling(problem, settings, problem.constraint.coordinates)
    return conjugate_gradient(
        lambda vector: _metric(problem, settings, vector) + damping * vector,
        problem.gradient,
        settings.cg_max_steps,
        progress_tolerance=settings.cg_progress_tolerance,
        # Without damping the approximation may be singular where the curvature is not
        preconditioner=None if precondition is None or damping == 0.0 else lambda vector: precondition(vector, damping),
    )


def _metric(problem: LocalProblem, settings: TrustRegionSettings, vector: th.Tensor) -> th.Tensor:
    r"""
    The product with :math:`H`, or with :math:`H + (\epsilon/\delta) F` where there is another constraint.

    The ellipsoid :math:`\frac12 s^\top(H/\epsilon + F/\delta)s \le 1` lies within both trust regions, and what they have
    in common lies within :math:`\sqrt2` times it. So the best step in it gains at least :math:`1/\sqrt2` of what the best
    one within both would, to first order. :math:`F` has no damping of its own: it would be blown up by the weight, and
    that of :math:`H` is enough for the solver.
    """
    if problem.constraint is None:
        return problem.curvature(vector)
    return problem.curvature(vector) + problem.constraint.weight(settings.radius) * problem.constraint.curvature(vector)


def _scaling(
    problem: LocalProblem, settings: TrustRegionSettings, coordinates: th.Tensor
) -> Callable[[th.Tensor, float], th.Tensor]:
    """
    The least that a preconditioner can do: divide by one number what the constraint holds, and by another the rest. Its
    weight makes the former thousands of times as stiff, and conjugate gradient would have to find that out.
    """
    stiffness = th.ones_like(problem.gradient)
    for part in (coordinates, ~coordinates):
        slope = problem.gradient * part
        slope /= slope.abs().max().clamp_min(th.finfo(slope.dtype).tiny)
        if (square := slope.dot(slope)) > 0.0:
            stiffness[part] = (slope.dot(_metric(problem, settings, slope)) / square).clamp_min(0.0)

    return lambda vector, damping: vector / (stiffness + damping)


def _longest_scale(problem: LocalProblem, settings: TrustRegionSettings, solved: CGResult) -> float:
    """The longest multiple of the solution that keeps to every radius and does not pass the minimum."""
    if problem.constraint is None:
        return min(_radius_scale(solved, settings), settings.max_scale)
    solution = solved.solution.cpu().double()
    curvature, constrained, slope = (
        float(solution.dot(vector.cpu().double()))
        for vector in (problem.curvature(solved.solution), problem.constraint.curvature(solved.solution), problem.gradient)
    )
    if not curvature > 0.0:
        return 0.0
    to_constraint = math.sqrt(2.0 * problem.constraint.radius / constrained) if constrained > 0.0 else math.inf
    return min(math.sqrt(2.0 * settings.radius / curvature), to_constraint, settings.max_scale * slope / curvature)


def _radius_scale(solved: CGResult, settings: TrustRegionSettings) -> float:
    r"""
    The :math:`\alpha` with :math:`\frac12 (\alpha s)^\top H (\alpha s)` equal to the radius.

    :math:`H` is without the damping: that belongs to the solver, not to the constraint.
    """
    # In double precision: the squares of a solution of 1e-30 or 1e30 would leave the range of single precision
    solution, product = solved.solution.cpu().double(), solved.product.cpu().double()
    curvature = float(solution.dot(product - settings.cg_damping * solution))
    if not curvature > 0.0:
        return 0.0
    return math.sqrt(2.0 * settings.radius / curvature)


def _line_search(problem: LocalProblem, settings: TrustRegionSettings, step: th.Tensor, solved: CGResult) -> StepRecord:
    """Try ever shorter steps until one increases the objective within the radius."""
    origin = flatten(problem.parameters)
    accepted, length = False, 1.0
    try:
        for trial in range(settings.max_trials):
            assign(problem.parameters, origin + length * step)
            objective, divergence = problem.evaluate()
            # NaN compares false and so is rejected
            improved = math.isfinite(objective) and objective > problem.objective
            room = _room(problem, settings, divergence) if improved else 0.0
            accepted = room >= 1.0
            if accepted:
                return StepRecord(
                    True, problem.objective, objective, divergence, trial + 1, length, solved.status, solved.steps
                )
            length *= _shortening(settings, room) if improved and trial == 0 else settings.shrinking_factor
    finally:
        # Also when a trial raises or is interrupted: nobody gets to see parameters that were only tried
        if not accepted:
            assign(problem.parameters, origin)
    return _rejected(problem, solved, trials=settings.max_trials)


def _room(problem: LocalProblem, settings: TrustRegionSettings, divergence: float) -> float:
    """How many times the true divergence, or that of the constraint if it is nearer, would fit into what is allowed."""
    pairs = [(settings.radius, divergence)]
    if problem.constraint is not None:
        pairs.append((problem.constraint.limit, problem.constraint.divergence()))
    if any(math.isnan(used) for _, used in pairs):
        return 0.0
    # Rounding may leave a divergence of next to nothing below zero
    return min(allowed / used if used > 0.0 else math.inf for allowed, used in pairs)


def _shortening(settings: TrustRegionSettings, room: float) -> float:
    """
    How to shorten a good step that is only too long. The divergence is all but quadratic in the length, so a step that
    overshoots by a little need not lose a fifth of its length.
    """
    return max(settings.shrinking_factor, 0.99 * math.sqrt(room))


def _rejected(problem: LocalProblem, solved: CGResult, trials: int) -> StepRecord:
    return StepRecord(False, problem.objective, problem.objective, 0.0, trials, 0.0, solved.status, solved.steps)
