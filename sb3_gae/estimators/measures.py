"""How good a value function and an advantage estimate are, as pure functions of arrays (NumPy)."""

from typing import NamedTuple

import numpy as np

from sb3_gae.checks import check_count
from sb3_gae.estimators.advantages import generalized_advantages, td_residuals
from sb3_gae.estimators.trajectory_groups import trajectory_indices


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


def lagged_signal(
    signal: np.ndarray, dones: np.ndarray, n_lags: int, mask: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    r"""
    The signal :math:`x_{t+l}` seen from each step t, for l = 0 ... ``n_lags`` - 1; zero beyond the end of the episode.

    A time limit counts as an end. Where the rollout itself cuts episodes, steps whose lag reaches past its end are
    unknown, and so for that lag are all steps as late, those of finished episodes included: to keep only
    these would prefer episodes that end early.

    :param signal: :math:`x_t`, rewards or residuals, shape (T, N)
    :param dones: whether the step was the last one of its episode, shape (T, N)
    :param n_lags: L
    :param mask: which steps belong to the batch, None for all, shape (T, N)
    :return: the signal, 0 where unknown, and whether it is known, both of shape (L, T, N)
    :raises ValueError: if ``n_lags`` is not positive
    """
    check_count("n_lags", n_lags)
    trajectories = trajectory_indices(dones, mask)
    belongs = trajectories >= 0
    n_steps = len(signal)
    open_ended = belongs & ~dones
    open_ended[:-1] &= ~belongs[1:]
    # Rows from here on are unknown at lag 0; past the array where nothing is cut
    horizon = int(np.flatnonzero(open_ended.any(axis=1))[0]) + 1 if open_ended.any() else n_steps + n_lags
    lagged = np.zeros((n_lags, *signal.shape), dtype=np.float64)
    known = np.repeat(belongs[None], n_lags, axis=0)
    for lag in range(n_lags):
        known[lag, max(0, horizon - lag) :] = False
        if lag < n_steps:
            same = belongs[: n_steps - lag] & (trajectories[lag:] == trajectories[: n_steps - lag])
            lagged[lag, : n_steps - lag] = np.where(same, signal[lag:], 0.0)
    return np.where(known, lagged, 0.0), known


def tabular_response(lagged: np.ndarray, known: np.ndarray, states: np.ndarray, actions: np.ndarray) -> np.ndarray:
    r"""
    :math:`\chi(l; s,a) = E[x_{t+l}|s_t=s, a_t=a] - E[x_{t+l}|s_t=s]` (paper, section 4), by averages over a rollout.

    :param lagged: see :func:`lagged_signal`, shape (L, T, N)
    :param known: likewise, shape (L, T, N)
    :param states: whole numbers from 0 on, shape (T, N)
    :param actions: whole numbers from 0 on, shape (T, N)
    :return: shape (L, S, A) with the largest numbers that occur; not a number where an action was never taken
    """
    n_states, n_actions = int(states.max()) + 1, int(actions.max()) + 1
    result = np.empty((len(lagged), n_states, n_actions))
    for lag, (signal, counted) in enumerate(zip(lagged, known, strict=True)):
        cells = states[counted] * n_actions + actions[counted]
        shape = dict(minlength=n_states * n_actions)
        sums = np.bincount(cells, weights=signal[counted], **shape).reshape(n_states, n_actions)
        counts = np.bincount(cells, **shape).reshape(n_states, n_actions)
        with np.errstate(invalid="ignore"):
            result[lag] = sums / counts - sums.sum(axis=1, keepdims=True) / counts.sum(axis=1, keepdims=True)
    return result
