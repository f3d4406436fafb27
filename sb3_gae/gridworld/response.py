r"""
How the reward of a step follows from an action l steps before it, exactly (paper, section 4).

The response function :math:`\chi(l; s,a) = E[r_{t+l}|s_t=s, a_t=a] - E[r_{t+l}|s_t=s]` splits the advantage by delay:
:math:`A^{\pi,\gamma}(s,a) = \sum_l \gamma^l \chi(l; s,a)`. For rewards shaped by :math:`V`, which are the residuals
:math:`\delta`, the same sum gives the same advantage, but if :math:`V = V^{\pi,\gamma}` all of it comes at l = 0.
"""

import numpy as np

from sb3_gae.checks import check_count
from sb3_gae.gridworld.exact import TabularPolicy


def response_function(policy: TabularPolicy, n_lags: int, values: np.ndarray | None = None, gamma: float = 1.0) -> np.ndarray:
    r"""
    :math:`\chi(l; s, a)` for l = 0 ... ``n_lags`` - 1.

    :param policy: in its MDP
    :param n_lags: how many delays
    :param values: potential :math:`V` that the rewards are shaped with, shape (S,); None for the rewards themselves
    :param gamma: discount factor of the shaping; without ``values`` it plays no part
    :return: shape (n_lags, S, A); zero in terminal states
    :raises ValueError: if ``n_lags`` is not positive, a shape does not fit, or ``gamma`` is out of range
    """
    check_count("n_lags", n_lags)
    signal = policy.mdp.rewards if values is None else policy.deltas(values, gamma)
    by_action = policy.over_next_states(signal)
    by_state = policy.over_actions(by_action)
    result = np.empty((n_lags, *by_action.shape))
    for lag in range(n_lags):
        result[lag] = by_action - by_state[:, None]
        # One step further on: given the action, and given the state alone
        by_action, by_state = policy.over_next_states(by_state), policy.chain @ by_state
    result[:, policy.mdp.terminal] = 0.0
    return result


def lagged_gradients(policy: TabularPolicy, n_lags: int, values: np.ndarray | None = None, gamma: float = 1.0) -> np.ndarray:
    r"""
    :math:`g_l = E[\sum_t \nabla_\theta\log\pi(a_t|s_t)\, r_{t+l}]` for l = 0 ... ``n_lags`` - 1.

    Weighted with :math:`\gamma^l` they add up to the true gradient; those of the shaped rewards, weighted
    with :math:`(\gamma\lambda)^l`, to the expected gradient of GAE.

    :param policy: in its MDP
    :param n_lags: how many delays
    :param values: potential :math:`V` that the rewards are shaped with, shape (S,); None for the rewards themselves
    :param gamma: discount factor of the shaping; without ``values`` it plays no part
    :return: shape (n_lags, S, A)
    :raises ValueError: if ``n_lags`` is not positive, a shape does not fit, or ``gamma`` is out of range
    """
    return np.stack([policy.gradient_of(response) for response in response_function(policy, n_lags, values, gamma)])
