r"""Errors of a value function, exactly: the truth behind :func:`~sb3_gae.estimators.measures.value_errors`."""

from typing import NamedTuple

import numpy as np

from sb3_gae.gridworld.exact import TabularPolicy


class ExactValueErrors(NamedTuple):
    r"""
    Expectations over the steps of episodes. The first three are what a rollout shows; the others are not seen there.

    :param explained_variance: of the discounted returns by the values
    :param monte_carlo_error: :math:`E[(V(s_t) - \hat R_t)^2]`
    :param td_error: :math:`E[\delta_t^2]`
    :param bellman_error: :math:`E[E[\delta_t|s_t]^2]`, the TD error less the noise of one step
    :param value_error: :math:`E[(V - V^{\pi,\gamma})(s_t)^2]`, the Monte-Carlo error less the noise of the returns
    :param return_variance: variance of the discounted returns, a scale to measure the others on
    """

    explained_variance: float
    monte_carlo_error: float
    td_error: float
    bellman_error: float
    value_error: float
    return_variance: float


def exact_value_errors(policy: TabularPolicy, values: np.ndarray, gamma: float) -> ExactValueErrors:
    r"""
    The policy gradient's own measure is ``policy.lambda_curve(values, gamma, [0.0]).bias_squared``.

    :param policy: in its MDP
    :param values: any :math:`V`, shape (S,); what it says of terminal states counts as 0
    :param gamma: discount factor in [0, 1]
    :return: see :class:`ExactValueErrors`
    :raises ValueError: if the shape does not fit, or ``gamma`` is out of range
    """
    frequencies = np.where(policy.mdp.terminal, 0.0, policy.visits) / policy.mean_length
    deltas = policy.deltas(values, gamma)
    wrong = values - policy.values(gamma)
    residual_mean, residual_square = _return_moments(policy, values, gamma)
    return_mean, return_square = _return_moments(policy, np.zeros(policy.mdp.n_states), gamma)
    return_variance = frequencies @ return_square - (frequencies @ return_mean) ** 2
    residual_variance = frequencies @ residual_square - (frequencies @ residual_mean) ** 2
    expected_deltas = policy.over_actions(policy.over_next_states(deltas))
    return ExactValueErrors(
        explained_variance=float(1.0 - residual_variance / return_variance) if return_variance > 0.0 else float("nan"),
        monte_carlo_error=float(frequencies @ residual_square),
        td_error=float(frequencies @ policy.over_actions(policy.over_next_states(np.square(deltas)))),
        bellman_error=float(frequencies @ np.square(expected_deltas)),
        value_error=float(frequencies @ np.square(wrong)),
        return_variance=float(return_variance),
    )


def _return_moments(policy: TabularPolicy, values: np.ndarray, gamma: float) -> tuple[np.ndarray, np.ndarray]:
    r"""
    Mean and mean square of :math:`\hat R_t - V(s_t)` given :math:`s_t`, shape (S,) each. It obeys
    :math:`x_t = \delta_t + \gamma x_{t+1}`, and so does its square with what is known of the mean.
    """
    deltas = policy.deltas(values, gamma)
    mean = policy.discounted_sums(policy.over_actions(policy.over_next_states(deltas)), gamma)
    squares = np.square(deltas) + 2.0 * gamma * deltas * mean
    return mean, policy.discounted_sums(policy.over_actions(policy.over_next_states(squares)), gamma**2)
