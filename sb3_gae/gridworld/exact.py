r"""
What a softmax policy does in a tabular MDP, exactly: values, the policy gradient, mean and variance of its estimates.

Everything is the solution of linear systems in the matrix :math:`M(s,s') = \sum_a \pi(a|s) P(s'|s,a)`, in double
precision. Rows of terminal states are zero in :math:`M`, so that values there are zero without further ado.

The gradient of one episode, :math:`G = \sum_t \hat A_t \nabla_\theta \log\pi(a_t|s_t)`, sums over the steps without
:math:`\gamma^t`, as sampled batches do (paper, eq. 9). Its expectation for an unbiased :math:`\hat A` is the paper's
:math:`g^\gamma` (eq. 6) and is what "the true gradient" means here. For :math:`\gamma = 1` it is the gradient of
the expected return; for smaller :math:`\gamma` it is that of no objective, as visits later in the episode are not discounted.
"""

from collections.abc import Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np

from sb3_gae.checks import check_number, check_unit_interval
from sb3_gae.gridworld.model import TabularMDP


class GradientMoments(NamedTuple):
    r"""
    Exact moments of the estimator over episodes.

    :param mean: :math:`E[G]`, shape (S, A)
    :param variance: trace of the covariance of :math:`G`, one episode's gradient; over n for the mean of n episodes
    :param advantage_mean: :math:`E[\hat A_t | s_t, a_t]`, shape (S, A)
    :param advantage_variance: variance of :math:`\hat A_t` given :math:`s_t, a_t`, shape (S, A)
    """

    mean: np.ndarray
    variance: float
    advantage_mean: np.ndarray
    advantage_variance: np.ndarray


class LambdaCurve(NamedTuple):
    r"""
    Exact quality of the gradient estimate for each :math:`\lambda` of a grid; each array has shape (L,).

    :param gae_lambda: the grid
    :param bias_angle: between expected and true gradient, in radians; not a number where either vanishes
    :param bias_squared: squared norm of expected less true gradient
    :param variance: trace of the covariance of one episode's gradient
    """

    gae_lambda: np.ndarray
    bias_angle: np.ndarray
    bias_squared: np.ndarray
    variance: np.ndarray


class TabularPolicy:
    r"""
    :math:`\pi(a|s) = \mathrm{softmax}(\theta_s)_a` in an MDP.

    :param mdp: what it acts in
    :param logits: :math:`\theta`, shape (S, A); those of terminal states are never read
    :raises ValueError: if the shape does not fit, a logit is not finite, or episodes may go on forever
    """

    def __init__(self, mdp: TabularMDP, logits: np.ndarray):
        logits = np.asarray(logits, dtype=np.float64)
        if logits.shape != (mdp.n_states, mdp.n_actions):
            raise ValueError(f"`logits` must have the shape {(mdp.n_states, mdp.n_actions)}, got {logits.shape}.")
        if not np.isfinite(logits).all():
            raise ValueError("`logits` must be finite.")
        self.mdp = mdp
        self.logits = logits
        unnormalized = np.exp(logits - logits.max(axis=1, keepdims=True))
        self.probabilities = unnormalized / unnormalized.sum(axis=1, keepdims=True)
        self.joint = self.probabilities[:, :, None] * mdp.transitions
        self.chain = self.joint.sum(axis=1)
        if not _all_end(self.chain, mdp.terminal):
            raise ValueError("`logits` must let every state reach a terminal one; make them less extreme.")

    @cached_property
    def visits(self) -> np.ndarray:
        """Expected number of visits to each state in an episode, shape (S,); for a terminal one, the chance to end there."""
        return np.linalg.solve(np.eye(self.mdp.n_states) - self.chain.T, self.mdp.start)

    @property
    def mean_length(self) -> float:
        """Expected number of steps of an episode."""
        return float(self.visits[~self.mdp.terminal].sum())

    def discounted_sums(self, terms: np.ndarray, discount: float | np.ndarray) -> np.ndarray:
        r"""
        :math:`E[\sum_l \mathrm{discount}^l x(s_{t+l}) | s_t = s]`; for a discount that depends on the state, with the product
        of those of :math:`s_{t+1} ... s_{t+l}`.

        :param terms: :math:`x`, shape (S, ...)
        :param discount: in [0, 1], one for all states or shape (S,)
        :return: shape (S, ...)
        """
        flat = terms.reshape(self.mdp.n_states, -1)
        return np.linalg.solve(np.eye(self.mdp.n_states) - discount * self.chain, flat).reshape(terms.shape)

    def over_actions(self, terms: np.ndarray) -> np.ndarray:
        r"""
        :param terms: :math:`x(s,a)`, shape (S, A)
        :return: :math:`\sum_a \pi(a|s) x(s,a)`, shape (S,)
        """
        return np.einsum("sa,sa->s", self.probabilities, terms)

    def over_next_states(self, terms: np.ndarray) -> np.ndarray:
        r"""
        :param terms: :math:`x(s,a,s')`, or of :math:`s'` alone, shape (S, A, S) or (S,)
        :return: :math:`\sum_{s'} P(s'|s,a) x(s,a,s')`, shape (S, A)
        """
        return np.einsum("sat,sat->sa", self.mdp.transitions, np.broadcast_to(terms, self.mdp.transitions.shape))

    def deltas(self, values: np.ndarray, gamma: float) -> np.ndarray:
        r"""
        :math:`\delta = R(s,a,s') + \gamma V(s') - V(s)` of every transition (paper, eq. 10 f.).

        :param values: any :math:`V`, shape (S,); what it says of terminal states counts as 0
        :param gamma: discount factor in [0, 1]
        :return: shape (S, A, S); zero from terminal states
        :raises ValueError: if the shape does not fit, or ``gamma`` is out of range
        """
        check_number("gamma", gamma, 0.0, 1.0)
        values = np.asarray(values, dtype=np.float64)
        if values.shape != (self.mdp.n_states,):
            raise ValueError(f"`values` must have the shape {(self.mdp.n_states,)}, got {values.shape}.")
        known = np.where(self.mdp.terminal, 0.0, values)
        return np.where(self.mdp.terminal[:, None, None], 0.0, self.mdp.rewards + gamma * known - known[:, None, None])

    def values(self, gamma: float) -> np.ndarray:
        r"""
        :param gamma: discount factor in [0, 1]
        :return: :math:`V^{\pi,\gamma}` (paper, eq. 4), shape (S,)
        :raises ValueError: if ``gamma`` is out of range
        """
        check_number("gamma", gamma, 0.0, 1.0)
        return self.discounted_sums(self.over_actions(self.over_next_states(self.mdp.rewards)), gamma)

    def action_values(self, gamma: float) -> np.ndarray:
        r"""
        :param gamma: discount factor in [0, 1]
        :return: :math:`Q^{\pi,\gamma}` (paper, eq. 4), shape (S, A)
        :raises ValueError: if ``gamma`` is out of range
        """
        return self.over_next_states(self.mdp.rewards + gamma * self.values(gamma))

    def advantages(self, gamma: float) -> np.ndarray:
        r"""
        :param gamma: discount factor in [0, 1]
        :return: :math:`A^{\pi,\gamma} = Q^{\pi,\gamma} - V^{\pi,\gamma}` (paper, eq. 5), shape (S, A)
        :raises ValueError: if ``gamma`` is out of range
        """
        return self.action_values(gamma) - self.values(gamma)[:, None]

    def expected_return(self, gamma: float = 1.0) -> float:
        r"""
        :param gamma: discount factor in [0, 1]
        :return: expected sum of :math:`\gamma^t r_t` over an episode
        :raises ValueError: if ``gamma`` is out of range
        """
        return float(self.mdp.start @ self.values(gamma))

    def gradient_of(self, signal: np.ndarray) -> np.ndarray:
        r"""
        :math:`E[\sum_t x(s_t,a_t) \nabla_\theta\log\pi(a_t|s_t)]` over an episode.

        :param signal: :math:`x`, shape (S, A)
        :return: shape (S, A)
        """
        return self.visits[:, None] * self._scored(signal)

    def true_gradient(self, gamma: float) -> np.ndarray:
        r"""
        :math:`g^\gamma = E[\sum_t A^{\pi,\gamma}(s_t,a_t) \nabla_\theta\log\pi(a_t|s_t)]` (paper, eq. 6).

        :param gamma: discount factor in [0, 1]
        :return: shape (S, A)
        :raises ValueError: if ``gamma`` is out of range
        """
        return self.gradient_of(self.advantages(gamma))

    def expected_advantages(self, values: np.ndarray, gamma: float, gae_lambda: float | np.ndarray) -> np.ndarray:
        r"""
        :math:`E[\hat A_t^{GAE(\gamma,\lambda)} | s_t, a_t]` for any :math:`V`: the expected residual, and from the
        next state on the expected sum of residuals with discount :math:`\gamma\lambda`.

        :param values: any :math:`V`, shape (S,)
        :param gamma: discount factor in [0, 1]
        :param gae_lambda: weight of longer estimates in [0, 1]; of shape (S,) for one that depends on the state,
            :math:`\hat A_t = \delta_t + \gamma\lambda(s_{t+1})\hat A_{t+1}`
        :return: shape (S, A)
        :raises ValueError: if the shape does not fit, or a factor is out of range
        """
        decay = gamma * self._checked_lambda(gae_lambda)
        residuals = self.over_next_states(self.deltas(values, gamma))
        following = self.discounted_sums(self.over_actions(residuals), decay)
        return residuals + self.over_next_states(decay * following)

    def expected_gradient(self, values: np.ndarray, gamma: float, gae_lambda: float | np.ndarray) -> np.ndarray:
        r"""
        :math:`E[\sum_t \hat A_t \nabla_\theta\log\pi(a_t|s_t)]`; the true gradient if :math:`\lambda = 1`
        or :math:`V = V^{\pi,\gamma}`.

        :param values: any :math:`V`, shape (S,)
        :param gamma: discount factor in [0, 1]
        :param gae_lambda: as in :meth:`expected_advantages`
        :return: shape (S, A)
        :raises ValueError: if the shape does not fit, or a factor is out of range
        """
        return self.gradient_of(self.expected_advantages(values, gamma, gae_lambda))

    def gradient_moments(self, values: np.ndarray, gamma: float, gae_lambda: float | np.ndarray) -> GradientMoments:
        r"""
        Mean and variance of one episode's gradient, both exact.

        With :math:`c = \gamma\lambda(s_{t+1})`, what is summed from step t on obeys
        :math:`\hat A_t = \delta_t + c\hat A_{t+1}` and :math:`G_t = \hat A_t\psi_t + G_{t+1}`,
        :math:`\psi_t = \nabla_\theta\log\pi(a_t|s_t)`. Squaring these and taking expectations given :math:`s_t` leaves
        one linear system each for :math:`E[\hat A]`, :math:`E[\hat A^2]`, :math:`E[G]`, :math:`E[\hat A G]` and
        :math:`E[\|G\|^2]`, as the future depends on the past through the next state alone.

        :param values: any :math:`V`, shape (S,)
        :param gamma: discount factor in [0, 1]
        :param gae_lambda: as in :meth:`expected_advantages`
        :return: see :class:`GradientMoments`
        :raises ValueError: if the shape does not fit, or a factor is out of range
        """
        advantages = self.expected_advantages(values, gamma, gae_lambda)
        deltas, decay = self.deltas(values, gamma), gamma * self._checked_lambda(gae_lambda)
        known = np.square(deltas) + 2.0 * decay * deltas * self.over_actions(advantages)
        squares = self.discounted_sums(self.over_actions(self.over_next_states(known)), np.square(decay))
        squared_advantages = self.over_next_states(known + np.square(decay) * squares)

        gradients = self.discounted_sums(self._at_own_state(self._scored(advantages)), 1.0)
        products = self.discounted_sums(
            self._at_own_state(self._scored(squared_advantages))
            + np.einsum("sat,sat,tuv->suv", self.joint, deltas, gradients),
            decay,
        )
        score_norms = 1.0 - 2.0 * self.probabilities + np.square(self.probabilities).sum(axis=1, keepdims=True)
        cross = deltas * self._along_scores(gradients) + decay * self._along_scores(products)
        norms = self.over_actions(score_norms * squared_advantages + 2.0 * self.over_next_states(cross))
        mean = np.einsum("s,suv->uv", self.mdp.start, gradients)
        variance = self.mdp.start @ self.discounted_sums(norms, 1.0) - np.square(mean).sum()
        advantage_variance = np.maximum(squared_advantages - np.square(advantages), 0.0)
        return GradientMoments(mean, max(float(variance), 0.0), advantages, advantage_variance)

    def lambda_curve(self, values: np.ndarray, gamma: float, lambdas: Sequence[float] | np.ndarray) -> LambdaCurve:
        r"""
        Bias and variance of the gradient estimate over a grid of :math:`\lambda`.

        :param values: any :math:`V`, shape (S,)
        :param gamma: discount factor in [0, 1]
        :param lambdas: weights of longer estimates, each in [0, 1], shape (L,)
        :return: see :class:`LambdaCurve`
        :raises ValueError: if the shape does not fit, or a factor is out of range
        """
        truth = self.true_gradient(gamma)
        moments = [self.gradient_moments(values, gamma, float(gae_lambda)) for gae_lambda in lambdas]
        return LambdaCurve(
            gae_lambda=np.asarray(lambdas, dtype=np.float64),
            bias_angle=np.array([angle(each.mean, truth) for each in moments]),
            bias_squared=np.array([np.square(each.mean - truth).sum() for each in moments]),
            variance=np.array([each.variance for each in moments]),
        )

    def _checked_lambda(self, gae_lambda: float | np.ndarray) -> np.ndarray:
        r""":math:`\lambda` of the state that follows a step, shape (S,)."""
        if np.ndim(gae_lambda) == 0:
            check_number("gae_lambda", gae_lambda, 0.0, 1.0)
            return np.full(self.mdp.n_states, gae_lambda, dtype=np.float64)
        check_unit_interval("gae_lambda", gae_lambda)
        lambdas, shape = np.asarray(gae_lambda, dtype=np.float64), (self.mdp.n_states,)
        if lambdas.shape != shape:
            raise ValueError(f"`gae_lambda` must be a number or have the shape {shape}, got {lambdas.shape}.")
        return lambdas

    def _scored(self, signal: np.ndarray) -> np.ndarray:
        r""":math:`\sum_a \pi(a|s)\,x(s,a)\,\partial\log\pi(a|s)/\partial\theta(s,b)` for each s and b, shape (S, A)."""
        return self.probabilities * (signal - self.over_actions(signal)[:, None])

    def _at_own_state(self, gradients: np.ndarray) -> np.ndarray:
        """What step s contributes to the gradient, which has entries for the logits of s only: (S, A) to (S, S, A)."""
        result = np.zeros((self.mdp.n_states, *gradients.shape))
        states = np.arange(self.mdp.n_states)
        result[states, states] = gradients
        return result

    def _along_scores(self, gradients: np.ndarray) -> np.ndarray:
        r""":math:`\psi(s,a)\cdot x(s')` for vectors :math:`x(s')`, of shape (S, S, A), as an array of shape (S, A, S)."""
        return np.moveaxis(gradients - np.einsum("ub,tub->tu", self.probabilities, gradients)[:, :, None], 0, 2)


def angle(first: np.ndarray, second: np.ndarray) -> float:
    """
    Angle between two vectors; accurate also where it is small, which the arc cosine is not.

    :param first: any shape
    :param second: same shape
    :return: in radians; not a number if either is zero
    """
    norms = np.linalg.norm(first), np.linalg.norm(second)
    if 0.0 in norms:
        return float("nan")
    first, second = first / norms[0], second / norms[1]
    return float(2.0 * np.arctan2(np.linalg.norm(first - second), np.linalg.norm(first + second)))


def _all_end(chain: np.ndarray, terminal: np.ndarray) -> bool:
    """Whether every state can reach a terminal one."""
    reaching = terminal.astype(bool)
    for _ in range(len(chain)):
        reaching = reaching | (chain @ reaching.astype(np.float64) > 0.0)
    return bool(reaching.all())
