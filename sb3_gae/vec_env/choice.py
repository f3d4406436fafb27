"""Which ``VecEnv`` steps given environments fastest."""

from collections.abc import Callable, Sequence
from typing import Any

import gymnasium as gym
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from sb3_gae.vec_env.envpool_vec_env import EnvPoolVecEnv, can_pool
from sb3_gae.vec_env.mujoco_vec_env import MujocoVecEnv, can_batch, have_common_task


def batched_vec_env(env_fns: Sequence[Callable[[], gym.Env]], n_threads: int | None = None, **kwargs: Any) -> VecEnv:
    """
    To be given as ``vec_env_cls`` where one does not know whether the environments can be stepped in batches.

    :param env_fns: each makes an environment
    :param n_threads: that step a batch; None for as many as there are cores. ``DummyVecEnv`` has one whatever it is
    :param kwargs: passed on
    :return: :class:`MujocoVecEnv` or :class:`EnvPoolVecEnv` if one of them can step all, else SB3's ``DummyVecEnv``
    :raises ValueError: if there is no environment to make
    """
    if not env_fns:
        raise ValueError("`env_fns` must make at least one environment.")
    envs = [make() for make in env_fns]
    vec_env_class: Callable[..., VecEnv] = DummyVecEnv
    if all(can_batch(env) for env in envs) and have_common_task(envs):
        vec_env_class, kwargs = MujocoVecEnv, kwargs | {"n_threads": n_threads}
    elif all(can_pool(env) for env in envs) and len({env.spec.id for env in envs if env.spec}) == 1:
        vec_env_class, kwargs = EnvPoolVecEnv, kwargs | {"n_threads": n_threads}
    return vec_env_class([lambda env=env: env for env in envs], **kwargs)
