"""How late the consequences of an action come: the response function of the paper (section 4), as pure functions of arrays."""

import numpy as np

from sb3_gae.checks import check_count
from sb3_gae.estimators.trajectory_groups import trajectory_indices


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
