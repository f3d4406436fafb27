"""How good a value function is, as pure functions of arrays (NumPy)."""

from typing import NamedTuple

import numpy as np

from sb3_gae.estimators.advantages import generalized_advantages, td_residuals


def explained_variance(predictions: np.ndarray, targets: np.ndarray) -> float:
    r"""
    :math:`1 - \mathrm{Var}(y - \hat y) / \mathrm{Var}(y)`: 1 is perfect, 0 no better than a constant, below 0 worse.

    >>> explained_variance(np.array([1.0, 2.0, 3.0]), np.array([1.0, 2.0, 4.0]))
    0.857...

    :param predictions: any shape
    :param targets: same shape
    :return: not a number if the targets are constant, as in SB3
    """
    # In double precision: the squares of returns of 1e20 overflow single
    variance = np.var(targets, dtype=np.float64)
    return float("nan") if variance == 0 else float(1.0 - np.var(targets - predictions, dtype=np.float64) / variance)


class ValueErrors(NamedTuple):
    r"""
    How far a value function is off, by measures that see different things.

    :param explained_variance: of the discounted returns by the values; noise of the returns counts against them
    :param monte_carlo_error: mean of :math:`(V(s_t) - \hat R_t)^2`, the paper's objective of the fit (section 5),
        which an exact :math:`V` leaves at the variance of the returns
    :param td_error: mean of :math:`\delta_t^2`, which an exact :math:`V` leaves at the variance of one step
    """

    explained_variance: float
    monte_carlo_error: float
    td_error: float


def value_errors(
    rewards: np.ndarray,
    values: np.ndarray,
    next_values: np.ndarray,
    dones: np.ndarray,
    gamma: float,
    mask: np.ndarray | None = None,
) -> ValueErrors:
    r"""
    Errors of the values of one rollout. Where it is cut off, the returns go on with the values themselves.

    None of them tells noise from error. What of the error reaches the policy is the bias of the policy gradient
    at :math:`\lambda = 0`, see :func:`~sb3_gae.diagnostics.rollout_diagnostics.policy_gradient_value_error`.

    :param rewards: shape (T, N)
    :param values: :math:`V(s_t)`, shape (T, N)
    :param next_values: see :func:`~sb3_gae.estimators.advantages.next_state_values`, shape (T, N)
    :param dones: whether the step was the last one of its episode, shape (T, N)
    :param gamma: discount factor
    :param mask: which steps belong to the batch, None for all, shape (T, N)
    :return: see :class:`ValueErrors`
    """
    rewards, values, next_values = (np.asarray(array, dtype=np.float64) for array in (rewards, values, next_values))
    belongs = np.ones_like(dones, dtype=bool) if mask is None else mask
    deltas = td_residuals(rewards, values, next_values, gamma)
    residuals = generalized_advantages(deltas, dones, gamma, 1.0)[belongs]
    return ValueErrors(
        explained_variance=explained_variance(values[belongs], values[belongs] + residuals),
        monte_carlo_error=float(np.square(residuals).mean()),
        td_error=float(np.square(deltas[belongs]).mean()),
    )
