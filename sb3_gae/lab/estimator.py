r"""The estimator at work: residuals, weights and their sum at one step of one sampled episode."""

from typing import NamedTuple

import numpy as np

from sb3_gae.gridworld import episode_deltas
from sb3_gae.lab.moment import Moment


class Trace(NamedTuple):
    r"""
    One episode of the batch, and the sum :math:`\hat A_t = \sum_l (\gamma\lambda)^l\delta_{t+l}` at one of its steps.

    :param states: visited, shape (T + 1,)
    :param actions: taken, shape (T,)
    :param rewards: shape (T,)
    :param deltas: :math:`\delta`, shape (T,)
    :param advantages: :math:`\hat A` of every step, shape (T,)
    :param true_advantages: :math:`A^{\pi,\gamma}` of every step, shape (T,)
    :param episode: its place in the batch
    :param start: the step t that the weights belong to
    :param weights: :math:`(\gamma\lambda)^l` of the residuals from step t on, shape (T - t,)
    """

    states: np.ndarray
    actions: np.ndarray
    rewards: np.ndarray
    deltas: np.ndarray
    advantages: np.ndarray
    true_advantages: np.ndarray
    episode: int
    start: int
    weights: np.ndarray


def trace(moment: Moment, episode: int = 0, start: int = 0) -> Trace:
    """
    :param moment: whose batch the episode is from
    :param episode: its place in the batch; the last one if there are fewer
    :param start: step t; the last one if the episode is shorter
    :return: see :class:`Trace`
    """
    controls, batch = moment.controls, moment.batch
    episode = min(episode, controls.batch_size - 1)
    steps = np.flatnonzero(batch.mask[:, episode])
    states, actions = batch.states[steps, episode], batch.actions[steps, episode]
    start = min(start, len(steps) - 1)
    deltas = episode_deltas(moment.policy, batch, moment.estimator_values, controls.gamma)
    return Trace(
        states=np.append(states, batch.next_states[steps[-1], episode]),
        actions=actions,
        rewards=batch.rewards[steps, episode],
        deltas=deltas[steps, episode],
        advantages=moment.advantages[steps, episode],
        true_advantages=moment.policy.advantages(controls.gamma)[states, actions],
        episode=episode,
        start=start,
        weights=(controls.gamma * controls.gae_lambda) ** np.arange(len(steps) - start),
    )
