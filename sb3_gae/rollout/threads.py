"""How many threads torch should use for what."""

from collections.abc import Iterator
from contextlib import contextmanager

import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import ActorCriticPolicy

# Multiplications of one step below which dividing them up takes longer than doing them
_SMALL = 2e8


@contextmanager
def threads_for_steps(policy: ActorCriticPolicy, n_envs: int) -> Iterator[None]:
    """
    While the steps of a rollout are taken, let torch use one thread if the policy is small.

    Its other threads would wait for the next step by spinning, on the very cores that step the physics.

    :param policy: that is asked in each step
    :param n_envs: number of environments
    """
    observations = policy.observation_space
    is_vector = isinstance(observations, spaces.Box) and len(observations.shape) == 1
    is_small = is_vector and n_envs * sum(parameter.numel() for parameter in policy.parameters()) < _SMALL
    n_threads = th.get_num_threads()
    if not is_small or n_threads == 1:
        yield
        return
    th.set_num_threads(1)
    try:
        yield
    finally:
        th.set_num_threads(n_threads)
