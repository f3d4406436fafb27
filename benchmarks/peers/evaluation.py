"""How an agent is evaluated: the same episodes for each."""

import time
from collections.abc import Callable
from typing import NamedTuple

import gymnasium as gym
import numpy as np

from benchmarks.peers.protocol import EPISODES, FIRST_EVALUATION_SEED

#: of raw observations, shape (n, ...), to actions as the environments take them
Act = Callable[[np.ndarray], np.ndarray]


class Evaluation(NamedTuple):
    """
    :param returns: of the episodes, undiscounted and of raw rewards
    :param lengths: of the episodes
    :param seconds: that it took
    """

    returns: np.ndarray
    lengths: np.ndarray
    seconds: float


class Evaluator:
    """
    Environments of its own that begin each evaluation with the same seeds.

    :param task: id of the environment
    :param episodes: of an evaluation
    """

    def __init__(self, task: str, episodes: int = EPISODES):
        self._envs = [gym.make(task) for _ in range(episodes)]

    def play(self, act: Act) -> Evaluation:
        """
        :param act: the agent, without noise
        :return: one whole episode of each environment
        """
        start = time.perf_counter()
        observations = [env.reset(seed=FIRST_EVALUATION_SEED + i)[0] for i, env in enumerate(self._envs)]
        returns, lengths = np.zeros(len(self._envs)), np.zeros(len(self._envs), dtype=int)
        left = list(range(len(self._envs)))
        while left:
            actions = act(np.stack([observations[i] for i in left]))
            ended = set()
            for i, action in zip(left, actions, strict=True):
                observations[i], reward, terminated, truncated, _ = self._envs[i].step(action)
                returns[i] += float(reward)
                lengths[i] += 1
                if terminated or truncated:
                    ended.add(i)
            left = [i for i in left if i not in ended]
        return Evaluation(returns, lengths, time.perf_counter() - start)

    def close(self) -> None:
        """Close the environments."""
        for env in self._envs:
            env.close()
