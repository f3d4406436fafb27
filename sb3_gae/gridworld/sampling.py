"""Episodes drawn from a tabular policy, as arrays that the functions in :mod:`sb3_gae.estimators.advantages` take."""

from typing import NamedTuple

import numpy as np

from sb3_gae.checks import check_count, check_number
from sb3_gae.estimators.advantages import discounted_returns, generalized_advantages, td_residuals
from sb3_gae.gridworld.exact import TabularPolicy


class Episodes(NamedTuple):
    """
    Episodes side by side, padded to the length of the longest: T steps of N episodes.

    Padding repeats the last state, with rewards of 0; nothing that comes after a done step reaches back across it.

    :param states: shape (T, N)
    :param actions: shape (T, N)
    :param rewards: shape (T, N)
    :param next_states: that each step led to, shape (T, N)
    :param terminated: whether the step ended its episode, shape (T, N)
    :param truncated: whether the step was the last because of ``max_steps``, shape (T, N)
    :param mask: whether the step is one at all and not padding, shape (T, N)
    """

    states: np.ndarray
    actions: np.ndarray
    rewards: np.ndarray
    next_states: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray
    mask: np.ndarray

    @property
    def dones(self) -> np.ndarray:
        """Whether each step was the last of its episode, shape (T, N)."""
        return self.terminated | self.truncated

    @property
    def returns(self) -> np.ndarray:
        """Undiscounted sum of the rewards of each episode, shape (N,)."""
        return self.rewards.sum(axis=0)


def sample_episodes(
    policy: TabularPolicy, n_episodes: int, generator: np.random.Generator, max_steps: int | None = None
) -> Episodes:
    """
    Play whole episodes. The exact results hold for episodes that are never cut.

    :param policy: in its MDP
    :param n_episodes: N
    :param generator: source of all randomness
    :param max_steps: cut episodes that take longer; None for never
    :return: see :class:`Episodes`
    :raises ValueError: if a count is not positive
    """
    check_count("n_episodes", n_episodes)
    if max_steps is not None:
        check_count("max_steps", max_steps)
    mdp = policy.mdp
    steps: list[tuple[np.ndarray, ...]] = []
    states = _draw(np.broadcast_to(mdp.start, (n_episodes, mdp.n_states)), generator)
    running = np.ones(n_episodes, dtype=bool)
    while running.any():
        actions, next_states, rewards = np.zeros(n_episodes, dtype=np.int64), states.copy(), np.zeros(n_episodes)
        actions[running] = _draw(policy.probabilities[states[running]], generator)
        next_states[running] = _draw(mdp.transitions[states[running], actions[running]], generator)
        rewards[running] = mdp.rewards[states[running], actions[running], next_states[running]]
        terminated = running & mdp.terminal[next_states]
        truncated = running & ~terminated & (len(steps) + 1 == max_steps)
        steps.append((states, actions, rewards, next_states, terminated, truncated, running))
        states, running = next_states, running & ~terminated & ~truncated
    return Episodes(*(np.stack(arrays) for arrays in zip(*steps, strict=True)))


def episode_deltas(policy: TabularPolicy, episodes: Episodes, values: np.ndarray, gamma: float) -> np.ndarray:
    """
    :param policy: that played the episodes
    :param episodes: T steps of N episodes
    :param values: any value function, shape (S,)
    :param gamma: discount factor in [0, 1]
    :return: temporal-difference residuals, shape (T, N); zero in padding
    :raises ValueError: if ``gamma`` is out of range
    """
    check_number("gamma", gamma, 0.0, 1.0)
    known = np.where(policy.mdp.terminal, 0.0, values)
    deltas = td_residuals(episodes.rewards, known[episodes.states], known[episodes.next_states], gamma)
    return np.where(episodes.mask, deltas, 0.0)


def episode_advantages(
    policy: TabularPolicy, episodes: Episodes, values: np.ndarray, gamma: float, gae_lambda: float
) -> np.ndarray:
    """
    :param policy: that played the episodes
    :param episodes: T steps of N episodes
    :param values: any value function, shape (S,)
    :param gamma: discount factor in [0, 1]
    :param gae_lambda: weight of longer estimates in [0, 1]
    :return: advantages by the package's own estimator, shape (T, N); zero in padding
    :raises ValueError: if a factor is out of range
    """
    check_number("gae_lambda", gae_lambda, 0.0, 1.0)
    deltas = episode_deltas(policy, episodes, values, gamma)
    return np.where(episodes.mask, generalized_advantages(deltas, episodes.dones, gamma, gae_lambda), 0.0)


def episode_gradients(policy: TabularPolicy, episodes: Episodes, signal: np.ndarray) -> np.ndarray:
    r"""
    :math:`\sum_t x_t \nabla_\theta\log\pi(a_t|s_t)` of each episode; their mean estimates the policy gradient.

    :param policy: that played the episodes
    :param episodes: T steps of N episodes
    :param signal: :math:`x`, such as :func:`episode_advantages`; 0 in padding, shape (T, N)
    :return: shape (N, S, A)
    """
    n_episodes, (n_states, n_actions) = episodes.states.shape[1], policy.logits.shape
    cells = (np.arange(n_episodes) * n_states + episodes.states) * n_actions + episodes.actions
    sums = np.bincount(cells.ravel(), weights=signal.ravel(), minlength=n_episodes * n_states * n_actions)
    sums = sums.reshape(n_episodes, n_states, n_actions)
    return sums - policy.probabilities * sums.sum(axis=2, keepdims=True)


def fitted_values(policy: TabularPolicy, episodes: Episodes, gamma: float) -> np.ndarray:
    """
    A learnt value function: the mean discounted return after every visit to a state, 0 where there was none.

    :param policy: that played the episodes
    :param episodes: never cut, T steps of N episodes
    :param gamma: discount factor in [0, 1]
    :return: shape (S,)
    :raises ValueError: if ``gamma`` is out of range
    """
    check_number("gamma", gamma, 0.0, 1.0)
    returns = discounted_returns(episodes.rewards, np.zeros_like(episodes.rewards), episodes.dones, gamma)
    states = episodes.states[episodes.mask]
    sums = np.bincount(states, weights=returns[episodes.mask], minlength=policy.mdp.n_states)
    return sums / np.maximum(np.bincount(states, minlength=policy.mdp.n_states), 1)


def _draw(probabilities: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """An index for each row of probabilities, shape (N, n) to (N,)."""
    cumulative = probabilities.cumsum(axis=1)
    # Scaled by the sum, so that rounding never leaves a gap at the end that no outcome covers
    return (generator.random((len(cumulative), 1)) * cumulative[:, -1:] >= cumulative).sum(axis=1)
