"""What the wrappers around an environment say about its episodes, for a batch that is stepped past them."""

from collections.abc import Iterator

import gymnasium as gym
import numpy as np
from gymnasium.wrappers import OrderEnforcing, PassiveEnvChecker, TimeLimit
from stable_baselines3.common.monitor import Monitor

# These either do nothing to a step or are done for the whole batch
_KNOWN_WRAPPERS = (Monitor, OrderEnforcing, PassiveEnvChecker, TimeLimit)


def wrappers_of(env: gym.Env) -> Iterator[gym.Wrapper]:
    """
    :param env: an environment in its wrappers
    :return: the wrappers, the outermost first
    """
    while isinstance(env, gym.Wrapper):
        yield env
        env = env.env


def foreign_wrapper(env: gym.Env) -> gym.Wrapper | None:
    """
    :param env: an environment in its wrappers
    :return: the outermost wrapper that has to see every step, if there is one
    """
    return next((wrapper for wrapper in wrappers_of(env) if not _is_known(wrapper)), None)


def _is_known(wrapper: gym.Wrapper) -> bool:
    """A subclass is, too, as long as it leaves the steps alone, or is what rl-zoo3 puts in the place of ``TimeLimit``."""
    steps_as_known = any(isinstance(wrapper, known) and type(wrapper).step is known.step for known in _KNOWN_WRAPPERS)
    return steps_as_known or (isinstance(wrapper, TimeLimit) and type(wrapper).__module__ == "rl_zoo3.gym_patches")


def refuse_foreign_wrapper(env: gym.Env) -> None:
    """
    :param env: an environment in its wrappers
    :raises ValueError: if one of them has to see every step
    """
    if (wrapper := foreign_wrapper(env)) is not None:
        name = type(wrapper).__name__
        raise ValueError(f"A batch cannot show each step to the wrapper {name}; use DummyVecEnv, or leave it out.")


def find_monitor(env: gym.Env) -> Monitor | None:
    """
    :param env: an environment in its wrappers
    :return: the outermost ``Monitor``, if there is one
    """
    return next((wrapper for wrapper in wrappers_of(env) if isinstance(wrapper, Monitor)), None)


def time_limit(env: gym.Env) -> int:
    """
    :param env: an environment in its wrappers
    :return: steps after which an episode is cut: the shortest, if there are several limits
    """
    limits = [wrapper._max_episode_steps for wrapper in wrappers_of(env) if isinstance(wrapper, TimeLimit)]
    return min(limits, default=int(np.iinfo(np.int64).max))
