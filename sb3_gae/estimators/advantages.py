r"""
Advantage estimators as pure functions of arrays (NumPy).

Shapes: ``T`` is the number of steps, ``N`` the number of environments; the first axis is always time.
A *done* step is the last one of its episode, terminated or truncated: nothing is propagated back across it.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

FloatArray = np.ndarray


def next_state_values(
    values: FloatArray,
    last_values: ArrayLike,
    terminated: np.ndarray,
    truncated: np.ndarray,
    bootstrap_values: FloatArray,
) -> FloatArray:
    r"""
    Value of the state that each step led to, :math:`V(s_{t+1})`.

    Zero after a termination, the value of the terminal observation after a truncation,
    and otherwise the value of the next stored state. A step that is both counts as terminated.

    :param values: :math:`V(s_t)`, shape (T, N)
    :param last_values: value of the state after the last step, shape (N,)
    :param terminated: whether the step ended its episode for good, shape (T, N)
    :param truncated: whether the step was the last before a time limit, shape (T, N)
    :param bootstrap_values: value of the terminal observation, read only where ``truncated``, shape (T, N)
    :return: shape (T, N)
    """
    result = np.concatenate([values[1:], np.asarray(last_values, dtype=values.dtype)[None]])
    np.copyto(result, bootstrap_values, where=truncated, casting="same_kind")
    result[terminated] = 0.0
    return result


def td_residuals(rewards: FloatArray, values: FloatArray, next_values: FloatArray, gamma: float) -> FloatArray:
    r"""
    Temporal-difference residuals :math:`\delta_t = r_t + \gamma V(s_{t+1}) - V(s_t)` (paper, eq. 10 f.).

    :param rewards: as the environment gave them, shape (T, N)
    :param values: :math:`V(s_t)`, shape (T, N)
    :param next_values: see :func:`next_state_values`, shape (T, N)
    :param gamma: discount factor
    :return: shape (T, N)
    """
    # A NumPy double would turn single-precision arrays into double
    return rewards + float(gamma) * next_values - values


def generalized_advantages(deltas: FloatArray, dones: np.ndarray, gamma: float, gae_lambda: float) -> FloatArray:
    r"""
    :math:`\hat A_t = \sum_l (\gamma\lambda)^l \delta_{t+l}`, the sum ending with the episode (paper, eq. 16).

    ``gae_lambda=0`` gives the residuals themselves (eq. 17), ``gae_lambda=1`` the discounted return
    less the value of the state (eq. 18).

    >>> deltas = np.array([[1.0], [1.0], [1.0]])  # three steps of one environment
    >>> dones = np.array([[False], [True], [False]])  # the second ends an episode
    >>> generalized_advantages(deltas, dones, gamma=1.0, gae_lambda=0.5).ravel()
    array([1.5, 1. , 1. ])

    :param deltas: see :func:`td_residuals`, shape (T, N)
    :param dones: whether the step was the last one of its episode, shape (T, N)
    :param gamma: discount factor
    :param gae_lambda: weight of longer estimates
    :return: shape (T, N)
    """
    return _decayed_suffix_sums(deltas, dones, np.asarray(gamma * gae_lambda, dtype=deltas.dtype))


def advantage_grid(
    rewards: FloatArray,
    values: FloatArray,
    next_values: FloatArray,
    dones: np.ndarray,
    gammas: Sequence[float] | FloatArray,
    lambdas: Sequence[float] | FloatArray,
) -> FloatArray:
    r"""
    Advantages of one rollout for every pair of :math:`\gamma` and :math:`\lambda`, in one pass over time.

    :param rewards: shape (T, N)
    :param values: :math:`V(s_t)`, held fixed over the grid, shape (T, N)
    :param next_values: see :func:`next_state_values`, shape (T, N)
    :param dones: whether the step was the last one of its episode, shape (T, N)
    :param gammas: discount factors, shape (G,)
    :param lambdas: weights of longer estimates, shape (L,)
    :return: shape (G, L, T, N); a view whose memory runs over time first
    """
    gamma = np.asarray(gammas, dtype=values.dtype)[:, None, None]
    decay = gamma * np.asarray(lambdas, dtype=values.dtype)[:, None]
    deltas = rewards[:, None, None] + gamma * next_values[:, None, None] - values[:, None, None]
    return np.moveaxis(_decayed_suffix_sums(deltas, dones, decay), 0, 2)


def discounted_returns(rewards: FloatArray, next_values: FloatArray, dones: np.ndarray, gamma: float) -> FloatArray:
    r"""
    Discounted sum of the rewards to the end of the episode, plus the discounted value of where it was cut off.

    These are the Monte-Carlo targets :math:`\hat V_t = \sum_l \gamma^l r_{t+l}` of the paper's value fit (section 5)
    wherever the episode terminates within the rollout.

    :param rewards: shape (T, N)
    :param next_values: see :func:`next_state_values`; read at done steps and at the last step, shape (T, N)
    :param dones: whether the step was the last one of its episode, shape (T, N)
    :param gamma: discount factor
    :return: shape (T, N)
    """
    cut = dones.copy()
    cut[-1] = True
    return _decayed_suffix_sums(rewards + float(gamma) * next_values * cut, dones, np.asarray(gamma, dtype=rewards.dtype))


def effective_horizon(gamma: ArrayLike, gae_lambda: ArrayLike) -> FloatArray:
    r"""
    Number of steps that the estimator looks ahead, :math:`1 / (1 - \gamma\lambda)` (paper, section 4).

    >>> float(effective_horizon(0.99, 0.96).round(1))
    20.2

    :param gamma: discount factor
    :param gae_lambda: weight of longer estimates
    :return: in steps, with the arguments' broadcast shape; infinite where both are 1
    """
    with np.errstate(divide="ignore"):
        return 1.0 / (1.0 - np.multiply(gamma, gae_lambda))


def _decayed_suffix_sums(terms: FloatArray, dones: np.ndarray, decay: np.ndarray) -> FloatArray:
    """
    ``sums[t] = terms[t] + decay * sums[t + 1]``, starting anew after each done step.

    :param terms: shape (T, ..., N)
    :param dones: shape (T, N)
    :param decay: broadcastable against the shape (..., N)
    :return: shape of ``terms`` after broadcasting with ``decay``
    """
    n_steps = terms.shape[0]
    sums = np.empty((n_steps, *np.broadcast_shapes(terms.shape[1:], decay.shape)), dtype=terms.dtype)
    sums[-1] = terms[-1]
    some_done = np.any(dones, axis=-1).tolist()
    for t in range(n_steps - 2, -1, -1):
        np.multiply(sums[t + 1], decay, out=sums[t])
        if some_done[t]:
            sums[t][..., dones[t]] = 0.0
        sums[t] += terms[t]
    return sums
