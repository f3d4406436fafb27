r"""
Unbiased estimates of squared norms and variances of a mean vector, from sums over independent groups (NumPy).

A squared norm of a noisy mean is too large by the variance of the noise. Products of *different* groups have
independent noise and so are right on average:
:math:`\|\mu\|^2 \approx \sum_{j\ne k}\langle X_j, X_k\rangle / \sum_{j\ne k} n_j n_k`, where :math:`X_j` is the sum over
group j and :math:`n_j` its weight. With two groups this is the inner product of two halves; the noise of the estimate, where
noise dominates, falls by a factor :math:`\sqrt{2(G-1)/G}` with G groups, which at 16 is within 4 % of its limit.

Shapes: ``G`` groups, ``K`` vectors (such as one for each :math:`\lambda`), ``P`` components. Weights are numbers of
what the mean is to be taken over: steps, or episodes. Where the weights are fixed the estimates are unbiased; where
they are random, as numbers of steps in whole episodes are, they are so up to terms of order 1/n like any ratio.
Standard errors are those of the jackknife over groups. For a squared norm that is lost in noise they are too large,
by up to :math:`\sqrt2` (Efron & Stein 1981: the jackknife counts the quadratic part of a statistic twice).
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike


class Estimate(NamedTuple):
    """
    :param value: shape (K,); a squared norm may come out negative where noise dominates
    :param standard_error: shape (K,); not a number with only two groups
    """

    value: np.ndarray
    standard_error: np.ndarray


class GradientErrors(NamedTuple):
    r"""
    Estimated errors of a batch's policy gradient, for each of K kinds of advantages.

    :param bias_squared: squared norm of the expected difference from the reference
    :param variance: trace of the covariance of the batch's mean gradient
    :param squared_norm: squared norm of the expected gradient
    :param inner_product: of the expected gradient with the expected reference, see :func:`gradient_errors`
    """

    bias_squared: Estimate
    variance: Estimate
    squared_norm: Estimate
    inner_product: Estimate


def squared_norm(sums: np.ndarray, weights: ArrayLike, duals: np.ndarray | None = None) -> Estimate:
    r"""
    Squared norm of the expected mean.

    :param sums: of each group, shape (G, K, P)
    :param weights: of each group, shape (G,), or (G, K) where they differ between vectors
    :param duals: what to take the products with: :math:`MX` for each vector :math:`X` of ``sums`` if squared norms are
        :math:`X^\top MX`; None for the vectors themselves, shape (G, K, P)
    :return: units of ``sums`` over ``weights``, squared
    :raises ValueError: if there are fewer than two groups, or a shape does not fit
    """
    return _jackknife(*_products(sums, weights, duals), _cross_products)


def mean_variance(sums: np.ndarray, weights: ArrayLike, duals: np.ndarray | None = None) -> Estimate:
    r"""
    Variance of the mean over all groups, summed over components:
    :math:`\sum_j \|X_j - n_j\hat\mu\|^2 / (n^2 - \sum_j n_j^2)`. With two equal halves,
    :math:`\frac14\|\hat\mu_A - \hat\mu_B\|^2`.

    :param sums: of each group, shape (G, K, P)
    :param weights: of each group, shape (G,), or (G, K) where they differ between vectors
    :param duals: see :func:`squared_norm`
    :return: units of ``sums`` over ``weights``, squared
    :raises ValueError: if there are fewer than two groups, or a shape does not fit
    """
    products, checked = _products(sums, weights, duals)
    whole = checked.sum(axis=0)
    # The mean over a part of the groups is the noisier the less there is of it
    return _jackknife(products, checked, lambda part, kept: _spread(part, kept) * kept.sum(axis=0) / whole)


def gradient_errors(
    sums: np.ndarray,
    weights: ArrayLike,
    reference: int = -1,
    duals: np.ndarray | None = None,
    steps: np.ndarray | None = None,
) -> GradientErrors:
    r"""
    Bias and variance of gradients that differ in their advantages, from one batch.

    With advantages for several :math:`\lambda` and that for :math:`\lambda = 1` as the reference, the bias is that of GAE.

    :param sums: policy gradients summed over each group, shape (G, K, P)
    :param weights: steps (or episodes) of each group, for errors of the mean over steps (or episodes), shape (G,)
    :param reference: index of the vector that is unbiased
    :param duals: for the squared norms, see :func:`squared_norm`
    :param steps: where the gradients lead, for their inner products with the reference; None for the gradients themselves.
        With a preconditioner :math:`M`, :math:`Mg` for each gradient, shape (G, K, P)
    :return: of the whole batch, each of shape (K,)
    :raises ValueError: if there are fewer than two groups, or a shape does not fit
    """
    sums = np.asarray(sums, dtype=np.float64)
    duals = sums if duals is None else np.asarray(duals, dtype=np.float64)
    steps = sums if steps is None else np.asarray(steps, dtype=np.float64)
    of_reference = np.broadcast_to(sums[:, [reference]], sums.shape)
    return GradientErrors(
        bias_squared=squared_norm(sums - of_reference, weights, duals - duals[:, [reference]]),
        variance=mean_variance(sums, weights, duals),
        squared_norm=squared_norm(sums, weights, duals),
        inner_product=squared_norm(of_reference, weights, steps),
    )


def _products(sums: np.ndarray, weights: ArrayLike, duals: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """Inner products between groups, shape (K, G, G), which is all that is needed of the vectors; and weights, (G, K)."""
    sums, weights = np.asarray(sums, dtype=np.float64), np.asarray(weights, dtype=np.float64)
    duals = sums if duals is None else np.asarray(duals, dtype=np.float64)
    if sums.ndim != 3 or len(sums) < 2:
        raise ValueError(f"`sums` must have the shape (G, K, P) with at least two groups, got {sums.shape}.")
    if weights.shape not in ((len(sums),), sums.shape[:2]) or not (weights > 0.0).all():
        raise ValueError(
            f"`weights` must be positive numbers of shape {(len(sums),)} or {sums.shape[:2]}, got the shape {weights.shape}."
        )
    if duals.shape != sums.shape:
        raise ValueError(f"`duals` must have the shape of `sums`, {sums.shape}, got {duals.shape}.")
    return sums.swapaxes(0, 1) @ duals.transpose(1, 2, 0), np.broadcast_to(weights.reshape(len(sums), -1), sums.shape[:2])


def _cross_products(products: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Mean product of different groups, in units of their weights: shapes (K, G, G) and (G, K) to (K,)."""
    of_different = products.sum(axis=(1, 2)) - np.trace(products, axis1=1, axis2=2)
    return of_different / (np.square(weights.sum(axis=0)) - np.square(weights).sum(axis=0))


def _spread(products: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Variance of the mean from distances between the groups' means and their own: (K, G, G) and (G, K) to (K,)."""
    whole, squares = weights.sum(axis=0), np.square(weights).sum(axis=0)
    with_mean = np.einsum("kjl,jk->k", products, weights) / whole
    of_mean = products.sum(axis=(1, 2)) * squares / np.square(whole)
    spread = np.trace(products, axis1=1, axis2=2) - 2.0 * with_mean + of_mean
    return np.maximum(spread, 0.0) / (np.square(whole) - squares)


def _jackknife(
    products: np.ndarray, weights: np.ndarray, estimate: Callable[[np.ndarray, np.ndarray], np.ndarray]
) -> Estimate:
    n_groups, value = len(weights), estimate(products, weights)
    if n_groups == 2:
        return Estimate(value, np.full_like(value, np.nan))
    kept = [np.delete(np.arange(n_groups), group) for group in range(n_groups)]
    without = np.stack([estimate(products[:, part][:, :, part], weights[part]) for part in kept])
    squares = np.square(without - without.mean(axis=0)).sum(axis=0)
    return Estimate(value, np.sqrt(squares * (n_groups - 1) / n_groups))
