"""gymnasium's MuJoCo tasks, stepped by EnvPool."""

from collections.abc import Callable
from typing import Any

import gymnasium as gym
from stable_baselines3.common.monitor import Monitor

from sb3_gae import EnvPoolVecEnv

EnvFns = list[Callable[[], gym.Env]]


def functions(task: str, n_envs: int, max_episode_steps: int = 8, **kwargs: Any) -> EnvFns:
    """As ``make_vec_env`` has them."""
    return [lambda: Monitor(gym.make(task, max_episode_steps=max_episode_steps, **kwargs))] * n_envs


def pool(task: str, n_envs: int = 2, seed: int = 0, **kwargs: Any) -> EnvPoolVecEnv:
    env = EnvPoolVecEnv(functions(task, n_envs, **kwargs), 1)
    env.seed(seed)
    return env
