"""What all batches of environments have in common: where episodes end, and what SB3 is told of it."""

import os
import warnings
from abc import abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, cast

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvStepReturn

from sb3_gae.checks import check_count
from sb3_gae.vec_env.monitoring import record_episode
from sb3_gae.vec_env.step_infos import StepInfos
from sb3_gae.vec_env.wrappers import find_monitor, refuse_foreign_wrapper, time_limit


def make_envs(env_fns: Sequence[Callable[[], gym.Env]]) -> list[gym.Env]:
    """
    :param env_fns: each makes an environment
    :return: the environments in their wrappers
    :raises ValueError: if there is none, or one of them comes twice or has a wrapper that would have to see each step
    """
    envs = [make() for make in env_fns]
    if not envs or len({id(env.unwrapped) for env in envs}) != len(envs):
        raise ValueError("`env_fns` must make at least one environment, and a new one each.")
    for env in envs:
        refuse_foreign_wrapper(env)
    return envs


class BatchedVecEnv(VecEnv):
    """
    Environments whose steps are computed for all at once. Time limits, monitors and resets are seen to here.

    :param envs: what :func:`make_envs` made
    :param observation_space: of one environment
    :param action_space: of one environment
    :param n_threads: that step the physics; None for as many as there are cores
    :raises ValueError: if ``n_threads`` is no whole number of at least 1
    """

    def __init__(
        self,
        envs: Sequence[gym.Env],
        observation_space: spaces.Space,
        action_space: spaces.Space,
        n_threads: int | None,
    ):
        if n_threads is not None:
            check_count("n_threads", n_threads)
        self.envs = list(envs)
        self._was_reset = False
        super().__init__(len(self.envs), observation_space, action_space)
        self.metadata = self.envs[0].metadata
        #: threads that step the physics
        self.n_threads = min(self.num_envs, n_threads or _n_cores())
        #: steps whose numbers blew up, since the beginning
        self.numerical_failures = 0
        self._limits = np.array([time_limit(env) for env in self.envs])
        self._monitors = [find_monitor(env) for env in self.envs]
        self._lengths = np.zeros(self.num_envs, dtype=np.int64)
        self._returns = np.zeros(self.num_envs)

    def reset(self) -> np.ndarray:
        observations = self._restart(np.arange(self.num_envs), self._seeds, self._options)
        self._was_reset = True
        self._reset_seeds()
        self._reset_options()
        return observations

    @abstractmethod
    def _restart_envs(self, indices: np.ndarray, seeds: Sequence[int | None], options: Sequence[dict[str, Any]]) -> np.ndarray:
        """
        Begin an episode in some environments, and keep what they say of it in ``reset_infos``.

        :param indices: of K environments
        :param seeds: for each of them, None to go on with its own random numbers
        :param options: for each of them
        :return: first observations, shape (K, ...)
        """

    def _restart(self, indices: np.ndarray, seeds: Sequence[int | None], options: Sequence[dict[str, Any]]) -> np.ndarray:
        observations = self._restart_envs(indices, seeds, options)
        self._lengths[indices], self._returns[indices] = 0, 0.0
        return observations

    def _check_actions(self, actions: np.ndarray) -> np.ndarray:
        if not self._was_reset:
            raise gym.error.ResetNeeded("Call `reset` before `step`.")
        actions = np.asarray(actions)
        if actions.shape != (expected := (self.num_envs, *(self.action_space.shape or ()))):
            raise ValueError(f"`actions` must have shape {expected}, got {actions.shape}.")
        return actions

    def _finish_step(
        self,
        observations: np.ndarray,
        rewards: np.ndarray,
        terminated: np.ndarray,
        failed: np.ndarray | None,
        columns: dict[str, np.ndarray],
    ) -> VecEnvStepReturn:
        """
        End the episodes that are over and begin new ones.

        :param observations: after the step, shape (N, ...); first ones of new episodes are written into it
        :param rewards: shape (N,), in float64
        :param terminated: whether the task ended, shape (N,)
        :param failed: whether the numbers blew up, shape (N,), which cuts an episode; None if they did nowhere
        :param columns: what the infos say, by name, each of shape (N,)
        :return: what ``step_wait`` has to
        """
        self._lengths += 1
        self._returns += rewards
        dones = terminated | (self._lengths >= self._limits)
        if failed is not None:
            dones |= failed
        infos = StepInfos(self.num_envs, columns | {"TimeLimit.truncated": dones & ~terminated})
        ended = np.flatnonzero(dones)
        for env in ended.tolist():
            if failed is not None and failed[env]:
                infos[env]["numerical_failure"] = True
                self._count_failure()
            infos[env]["terminal_observation"] = observations[env].copy()
            if (monitor := self._monitors[env]) is not None:
                record_episode(monitor, float(self._returns[env]), int(self._lengths[env]), infos[env])
        if ended.size:
            observations[ended] = self._restart(ended, [None] * ended.size, [{}] * ended.size)
        return observations, rewards.astype(np.float32), dones, cast(list[dict[str, Any]], infos)

    def _count_failure(self) -> None:
        if self.numerical_failures == 0:
            warnings.warn(
                "The physics of an environment gave numbers that are not finite; its episode was cut before them. "
                "Smaller actions or a shorter timestep may help. Further failures are only counted.",
                stacklevel=2,
            )
        self.numerical_failures += 1

    def close(self) -> None:
        for env in self.envs:
            env.close()

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        return [self.envs[env].get_wrapper_attr(attr_name) for env in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        for env in self._get_indices(indices):
            setattr(self.envs[env], attr_name, value)

    def env_is_wrapped(self, wrapper_class: type[gym.Wrapper], indices: VecEnvIndices = None) -> list[bool]:
        from stable_baselines3.common.env_util import is_wrapped  # a cycle at the top: env_util imports vec_env

        return [is_wrapped(self.envs[env], wrapper_class) for env in self._get_indices(indices)]


def _n_cores() -> int:
    """That this process may use, where the system tells."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
