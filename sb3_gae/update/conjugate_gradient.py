"""Conjugate gradient for symmetric positive definite operators that are known only through their products."""

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

import torch as th


class CGStatus(Enum):
    """How the solver ended."""

    CONVERGED = "converged"
    MAX_STEPS = "maximum steps"
    NON_POSITIVE_CURVATURE = "non-positive curvature"
    ZERO_GRADIENT = "zero gradient"
    NON_FINITE = "non-finite product"


@dataclass(frozen=True)
class CGResult:
    """
    :param solution: the last iterate for which the curvature was positive, shape (n,)
    :param product: the operator applied to ``solution``, at no further cost, shape (n,)
    :param status: how the solver ended
    :param steps: number of products that entered the solution
    """

    solution: th.Tensor
    product: th.Tensor
    status: CGStatus
    steps: int


def conjugate_gradient(
    operator: Callable[[th.Tensor], th.Tensor],
    rhs: th.Tensor,
    max_steps: int,
    relative_tolerance: float = 1e-6,
    progress_tolerance: float = 0.0,
    preconditioner: Callable[[th.Tensor], th.Tensor] | None = None,
) -> CGResult:
    """
    Solve ``A x = b`` from ``x = 0``.

    Starting from zero makes every iterate an ascent direction of ``b``, which a truncated solve needs,
    and the tolerances are relative because gradients come in all scales.

    :param operator: product with ``A``, (n,) -> (n,)
    :param rhs: ``b``, shape (n,)
    :param max_steps: largest number of products
    :param relative_tolerance: end when the residual's norm is at most this times the norm of ``b``
    :param progress_tolerance: end when a step adds at most this part of what all have added to the quadratic
        ``b.x - x.Ax / 2`` (the rule of Martens 2010): further steps then follow noise in the curvature
    :param preconditioner: product with a symmetric positive definite approximation of the inverse of ``A``
    :return: the solution and how it was reached
    """
    solution = th.zeros_like(rhs)
    largest = rhs.abs().max()
    if not th.isfinite(largest):
        return CGResult(solution, solution, CGStatus.NON_FINITE, 0)
    if largest == 0.0:
        return CGResult(solution, solution, CGStatus.ZERO_GRADIENT, 0)
    # Solve for b / |b|: the squares of a gradient of 1e-30 would underflow
    rhs_norm = largest * (rhs / largest).norm()
    target = rhs / rhs_norm
    residual = target.clone()
    preconditioned = residual if preconditioner is None else preconditioner(residual)
    direction = preconditioned.clone()
    slope = residual.dot(preconditioned)
    status, steps, steepest, total_gain = CGStatus.MAX_STEPS, 0, 0.0, 0.0
    for _ in range(max_steps):
        product = operator(direction)
        curvature = direction.dot(product)
        if not th.isfinite(curvature):
            status = CGStatus.NON_FINITE
            break
        # Curvature that is zero but for rounding counts as zero: a step of its inverse would lead anywhere
        direction_square = direction.dot(direction)
        steepest = max(steepest, float(curvature / direction_square))
        if curvature <= th.finfo(rhs.dtype).eps * steepest * direction_square:
            status = CGStatus.NON_POSITIVE_CURVATURE
            break
        step = slope / curvature
        solution.add_(direction * step)
        residual.sub_(product * step)
        steps += 1
        gain = float(0.5 * step * slope)
        total_gain += gain
        if residual.norm() <= relative_tolerance or gain <= progress_tolerance * total_gain:
            status = CGStatus.CONVERGED
            break
        preconditioned = residual if preconditioner is None else preconditioner(residual)
        previous_slope, slope = slope, residual.dot(preconditioned)
        direction = preconditioned + direction * (slope / previous_slope)
    return CGResult(solution * rhs_norm, (target - residual) * rhs_norm, status, steps)
