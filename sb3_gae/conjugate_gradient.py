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
) -> CGResult:
    """
    Solve ``A x = b`` from ``x = 0``.

    Starting from zero makes every iterate an ascent direction of ``b``, which a truncated solve needs,
    and the tolerance is relative to ``b`` because gradients come in all scales.

    :param operator: product with ``A``, (n,) -> (n,)
    :param rhs: ``b``, shape (n,)
    :param max_steps: largest number of products
    :param relative_tolerance: end when the residual's norm is at most this times the norm of ``b``
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
    direction = residual.clone()
    residual_square = residual.dot(residual)
    status, steps = CGStatus.MAX_STEPS, 0
    for _ in range(max_steps):
        product = operator(direction)
        curvature = direction.dot(product)
        if not th.isfinite(curvature):
            status = CGStatus.NON_FINITE
            break
        if curvature <= 0.0:
            status = CGStatus.NON_POSITIVE_CURVATURE
            break
        step = residual_square / curvature
        solution.add_(direction * step)
        residual.sub_(product * step)
        steps += 1
        previous_square, residual_square = residual_square, residual.dot(residual)
        if residual_square <= relative_tolerance**2:
            status = CGStatus.CONVERGED
            break
        direction = residual + direction * (residual_square / previous_square)
    return CGResult(solution * rhs_norm, (target - residual) * rhs_norm, status, steps)
