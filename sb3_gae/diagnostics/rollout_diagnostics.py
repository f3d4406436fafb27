r"""
What one rollout says of its policy gradient: error of each :math:`\lambda`, delay of its rewards, error of its values.

All of it is of the raw gradient of the batch, :math:`\hat g = \frac1B \sum_t \hat A_t \nabla_\theta\log\pi(a_t|s_t)` with the
policy that collected it, so before an update. Norms are squared and have the units of squared advantages.
They are estimated from products of independent groups of trajectories, see :mod:`sb3_gae.estimators.group_statistics`.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from stable_baselines3.common.policies import ActorCriticPolicy

from sb3_gae.checks import check_choice, check_count, check_number, check_unit_interval
from sb3_gae.diagnostics.policy_gradients import policy_gradients
from sb3_gae.estimators.advantages import advantage_grid, td_residuals
from sb3_gae.estimators.group_statistics import Estimate, gradient_errors, squared_norm
from sb3_gae.estimators.response import lagged_signal
from sb3_gae.estimators.trajectory_groups import trajectory_groups, trajectory_indices
from sb3_gae.rollout.evaluation import precision_of, training_batch
from sb3_gae.rollout.rollout_buffer import GAERolloutBuffer
from sb3_gae.update.natural_gradients import natural_gradients
from sb3_gae.update.policy_step import policy_parameters

#: of norms and inner products of policy gradients
METRICS = ("euclidean", "fisher")


class LambdaErrors(NamedTuple):
    r"""
    Estimated error of the batch's policy gradient with each :math:`\lambda` of a grid; each array has shape (L,).

    :param gae_lambda: the grid
    :param bias_squared: squared norm of the expected difference from :math:`\lambda = 1`; may come out below zero
    :param bias_squared_error: its standard error
    :param variance: trace of the covariance of the batch's mean gradient
    :param variance_error: its standard error
    :param squared_error: the sum of bias squared, none below zero, and variance: what a choice of :math:`\lambda` minimises
    :param squared_norm: of the expected gradient, to compare the errors with; may come out below zero
    :param inner_product: of the expected gradient with that of :math:`\lambda = 1`; may come out below zero
    """

    gae_lambda: np.ndarray
    bias_squared: np.ndarray
    bias_squared_error: np.ndarray
    variance: np.ndarray
    variance_error: np.ndarray
    squared_error: np.ndarray
    squared_norm: np.ndarray
    inner_product: np.ndarray

    @property
    def improvement(self) -> np.ndarray:
        r"""See :func:`expected_improvement`."""
        return expected_improvement(self.inner_product, self.squared_norm + self.variance)


class ResponseEstimate(NamedTuple):
    r"""
    Squared norms of the parts of the policy gradient by delay,
    :math:`g_l = E[\nabla_\theta\log\pi(a_t|s_t)\,r_{t+l}]`, for l = 0, 1, ...

    :param rewards: of the rewards as the environment gave them
    :param shaped_rewards: of the residuals :math:`\delta_{t+l}`; a good value function leaves little of them beyond l = 0
    """

    rewards: Estimate
    shaped_rewards: Estimate


def expected_improvement(inner_product: np.ndarray, squared_length: np.ndarray) -> np.ndarray:
    r"""
    What a step of unit length along the batch's gradient :math:`\hat g_\lambda` gains on average, to first order:
    :math:`\langle g, E\hat g_\lambda\rangle / \sqrt{E\|\hat g_\lambda\|^2}`.

    A trust region fixes the length of a step in the Fisher metric. So a gradient that is only too short, as a small
    :math:`\lambda` makes it, costs nothing, unlike in the squared error; what counts is how well it points.

    :param inner_product: of the expected gradient with an unbiased one's expectation
    :param squared_length: mean squared norm of the batch's gradient: that of its expectation, and its variance
    :return: same shape, in units of a gradient; zero where the length is
    """
    length = np.sqrt(np.maximum(squared_length, 0.0))
    return np.divide(inner_product, length, out=np.zeros_like(length), where=length > 0.0)


def has_several_trajectories(rollout_buffer: GAERolloutBuffer) -> bool:
    """
    :param rollout_buffer: full
    :return: whether it holds two trajectories or more, which every estimate here needs
    """
    return bool(trajectory_indices(rollout_buffer.dones, rollout_buffer.mask).max() > 0)


def lambda_errors(
    policy: ActorCriticPolicy,
    rollout_buffer: GAERolloutBuffer,
    lambdas: Sequence[float],
    gamma: float | None = None,
    n_groups: int = 16,
    metric: str = "euclidean",
) -> LambdaErrors:
    r"""
    Bias and variance of the policy gradient for each :math:`\lambda`, from the rollout alone.

    :math:`\lambda = 1` counts as unbiased. It is so for episodes that terminate; where a time limit or the rollout's end cuts
    them, it relies on the value of the last state, and so does this.

    :param policy: that collected the rollout, not updated since
    :param rollout_buffer: full
    :param lambdas: weights of longer estimates, each in [0, 1], shape (L,)
    :param gamma: discount factor, None for the buffer's own
    :param n_groups: of trajectories; more than 16 lower the noise little
    :param metric: ``"euclidean"`` for norms and products of the gradients themselves, or ``"fisher"`` for those of the
        trust-region steps that they lead to: norms are :math:`s^\top Fs` with :math:`s = (F + d)^{-1}g`, and the inner
        product is that of the step with the gradient of :math:`\lambda = 1`; see :mod:`sb3_gae.update.natural_gradients`
    :return: see :class:`LambdaErrors`
    :raises ValueError: if the buffer is not full, has a single trajectory, a factor is out of range, or the metric is unknown
    """
    check_unit_interval("lambdas", lambdas)
    check_choice("metric", metric, METRICS)
    gamma = _checked_gamma(rollout_buffer, gamma)
    rewards, values, next_values = _td_arrays(rollout_buffer)
    advantages = advantage_grid(rewards, values, next_values, rollout_buffer.dones, [gamma], [*lambdas, 1.0])[0]
    sums, groups = _gradient_sums(policy, rollout_buffer, advantages, n_groups)
    steps = duals = None
    if metric == "fisher":
        batch = training_batch(rollout_buffer, policy.action_space, precision_of(policy))
        steps, duals = natural_gradients(policy, policy_parameters(policy, batch), batch, sums)
    errors = gradient_errors(sums, np.bincount(groups), duals=duals, steps=steps)
    bias, variance, norm, product = (Estimate(*(array[:-1] for array in each)) for each in errors)
    return LambdaErrors(
        gae_lambda=np.asarray(lambdas, dtype=np.float64),
        bias_squared=bias.value,
        bias_squared_error=bias.standard_error,
        variance=variance.value,
        variance_error=variance.standard_error,
        squared_error=np.maximum(bias.value, 0.0) + variance.value,
        squared_norm=norm.value,
        inner_product=product.value,
    )


def policy_gradient_value_error(
    policy: ActorCriticPolicy, rollout_buffer: GAERolloutBuffer, gamma: float | None = None, n_groups: int = 16
) -> Estimate:
    r"""
    The value function's error as the policy gradient sees it,
    :math:`\|\gamma E[\nabla_\theta\log\pi(a_t|s_t)\,(V - V^{\pi,\gamma})(s_{t+1})]\|^2`.

    Of an error :math:`e = V - V^{\pi,\gamma}`, GAE's expected gradient keeps
    :math:`\gamma(1-\lambda)\sum_l(\gamma\lambda)^l E[\nabla_\theta\log\pi(a_t|s_t)\,e(s_{t+l+1})]`: only what the action has a
    hand in. An error that is the same wherever the actions lead does no harm, however large. This is the bias squared
    at :math:`\lambda = 0`, and is estimated as that.

    :param policy: that collected the rollout, not updated since
    :param rollout_buffer: full
    :param gamma: discount factor, None for the buffer's own
    :param n_groups: of trajectories
    :return: each array of shape (1,)
    :raises ValueError: if the buffer is not full, has a single trajectory, or ``gamma`` is out of range
    """
    errors = lambda_errors(policy, rollout_buffer, [0.0], gamma, n_groups)
    return Estimate(errors.bias_squared, errors.bias_squared_error)


def gradient_response(
    policy: ActorCriticPolicy,
    rollout_buffer: GAERolloutBuffer,
    n_lags: int,
    gamma: float | None = None,
    n_groups: int = 16,
) -> ResponseEstimate:
    r"""
    How late the rewards come that make up the policy gradient, before and after shaping by the value function.

    The response function :math:`\chi(l; s,a)` of the paper (section 4) needs many visits to the same state and action.
    Its products with the score, averaged over all steps, need none:
    :math:`g_l = E[\nabla_\theta\log\pi(a_t|s_t)\,\chi(l; s_t,a_t)]`.

    :param policy: that collected the rollout, not updated since
    :param rollout_buffer: full
    :param n_lags: how many delays, at most the number of steps
    :param gamma: discount factor of the shaping, None for the buffer's own
    :param n_groups: of trajectories
    :return: squared norms, each array of shape (n_lags,)
    :raises ValueError: if the buffer is not full, has a single trajectory, too few steps for ``n_lags``,
        or ``gamma`` is out of range
    """
    gamma = _checked_gamma(rollout_buffer, gamma)
    check_count("n_lags", n_lags)
    rewards, values, next_values = _td_arrays(rollout_buffer)
    deltas = td_residuals(rewards, values, next_values, gamma)
    dones, mask = rollout_buffer.dones, rollout_buffer.mask
    lagged, known = lagged_signal(rewards, dones, n_lags, mask)
    signals = np.concatenate([lagged, lagged_signal(deltas, dones, n_lags, mask)[0]])
    sums, groups = _gradient_sums(policy, rollout_buffer, signals, n_groups)
    steps = np.stack([np.bincount(groups, weights=each, minlength=len(sums)) for each in known[:, mask]], axis=1)
    if not steps.all():
        raise ValueError(f"`n_lags` must leave steps that can be followed so far in every group, got {n_lags}.")
    return ResponseEstimate(squared_norm(sums[:, :n_lags], steps), squared_norm(sums[:, n_lags:], steps))


def _gradient_sums(
    policy: ActorCriticPolicy, rollout_buffer: GAERolloutBuffer, signals: np.ndarray, n_groups: int
) -> tuple[np.ndarray, np.ndarray]:
    """Sums over groups, shape (G, K, P), for signals of shape (K, T, N); and the group of each step of the batch, (B,)."""
    mask = rollout_buffer.mask
    groups = trajectory_groups(rollout_buffer.dones, n_groups, mask)[mask]
    batch = training_batch(rollout_buffer, policy.action_space, precision_of(policy))
    parameters = policy_parameters(policy, batch)
    sums = policy_gradients(policy, parameters, batch.observations, batch.actions, signals[:, mask], groups)
    return sums, groups


def _td_arrays(rollout_buffer: GAERolloutBuffer) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    arrays = rollout_buffer.rewards, rollout_buffer.values, rollout_buffer.next_values
    rewards, values, next_values = (np.asarray(array, dtype=np.float64) for array in arrays)
    return rewards, values, next_values


def _checked_gamma(rollout_buffer: GAERolloutBuffer, gamma: float | None) -> float:
    if not rollout_buffer.full:
        raise ValueError("`rollout_buffer` must be full; collect a whole rollout first.")
    gamma = rollout_buffer.gamma if gamma is None else gamma
    check_number("gamma", gamma, 0.0, 1.0)
    return gamma
