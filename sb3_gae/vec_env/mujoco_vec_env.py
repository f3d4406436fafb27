"""Many environments of one :class:`~sb3_gae.envs.MujocoTask`, stepped by one native call."""

import os
import warnings
from collections.abc import Callable, Sequence
from typing import Any, cast

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium.wrappers import OrderEnforcing, PassiveEnvChecker, TimeLimit
from mujoco.rollout import Rollout
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvStepReturn

from sb3_gae.envs.mujoco_env import MujocoTaskEnv
from sb3_gae.envs.mujoco_task import MujocoTask, is_physical, total_reward
from sb3_gae.vec_env.monitoring import find_monitor, record_episode
from sb3_gae.vec_env.step_infos import StepInfos

# These either do nothing to a step or are done here for the whole batch
_KNOWN_WRAPPERS = (Monitor, OrderEnforcing, PassiveEnvChecker, TimeLimit)


class MujocoVecEnv(VecEnv):
    """
    Takes the place of ``DummyVecEnv`` and gives the same trajectories, faster.

    .. code-block:: python

        env = make_vec_env("GaeBiped-v0", n_envs=64, vec_env_cls=MujocoVecEnv)

    The environments that the functions make are kept: each draws its own initial states, and attributes, methods
    and pictures are asked of them, with the present state handed to them first. Between resets they are not stepped.
    They share the first one's ``task``, so that whoever changes it changes it for all of them.

    :param env_fns: each makes an environment whose innermost is a :class:`~sb3_gae.envs.MujocoTaskEnv`
    :param n_threads: that step the physics; None for as many as there are cores
    :raises ValueError: if there is no environment or one of them comes twice, is of another kind, has a wrapper that
        would have to see each step, or differs from the first; or if ``n_threads`` is less than 1
    """

    def __init__(self, env_fns: Sequence[Callable[[], gym.Env]], n_threads: int | None = None):
        if n_threads is not None and n_threads < 1:
            raise ValueError(f"`n_threads` must be at least 1 or None, got {n_threads}.")
        self.envs = [make() for make in env_fns]
        self._bases = [_base_of(env) for env in self.envs]
        if not self.envs or len({id(base) for base in self._bases}) != len(self.envs):
            raise ValueError("`env_fns` must make at least one environment, and a new one each.")
        self._limits = np.array([_time_limit(env) for env in self.envs])
        self._monitors = [find_monitor(env) for env in self.envs]
        self._was_reset = False
        self.task = self._bases[0].task
        expected = _settings_of(self.task)
        if any(_settings_of(base.task) != expected for base in self._bases[1:]):
            raise ValueError("All environments of a MujocoVecEnv must be of one task with the same arguments.")
        for base in self._bases:
            base.task = self.task
        n_envs, model = len(self.envs), self.task.model
        super().__init__(n_envs, self.task.observation_space, self.task.action_space)
        self.metadata = self.envs[0].metadata
        #: steps whose numbers blew up, since the beginning
        self.numerical_failures = 0
        n_threads = min(n_envs, n_threads or _n_cores())
        self._pool = Rollout(nthread=n_threads if n_threads > 1 else 0)
        self._models, self._datas = [model] * n_envs, [mujoco.MjData(model) for _ in range(n_threads)]
        n_state = self._bases[0].physics_state.shape[1]
        self._physics = np.zeros((n_envs, n_state))
        self._new_physics = np.zeros((n_envs, self.task.frame_skip, n_state))
        self._sensor_data = np.zeros((n_envs, self.task.frame_skip, model.nsensordata))
        self._controls = np.zeros((n_envs, self.task.frame_skip, model.nu))
        self._lengths = np.zeros(n_envs, dtype=np.int64)
        self._returns = np.zeros(n_envs)

    def reset(self) -> np.ndarray:
        observations = np.stack([self._reset_env(env, self._seeds[env], self._options[env]) for env in range(self.num_envs)])
        self._was_reset = True
        self._reset_seeds()
        self._reset_options()
        return observations

    def step_async(self, actions: np.ndarray) -> None:
        if not self._was_reset:
            raise gym.error.ResetNeeded("Call `reset` before `step`.")
        actions = np.asarray(actions)
        if actions.shape != (expected := (self.num_envs, *(self.action_space.shape or ()))):
            raise ValueError(f"`actions` must have shape {expected}, got {actions.shape}.")
        self._controls[:] = self.task.controls(actions)[:, None]

    def step_wait(self) -> VecEnvStepReturn:
        self._pool.rollout(
            self._models,
            self._datas,
            self._physics,
            self._controls,
            skip_checks=True,
            nstep=self.task.frame_skip,
            state=self._new_physics,
            sensordata=self._sensor_data,
        )
        # Not the last one alone: numbers that blew up in the middle may have been cut to something finite
        sound = is_physical(self._new_physics.reshape(self.num_envs, -1))
        failed = None if sound.all() else ~sound
        states = self.task.states(self._new_physics[:, -1], self._controls[:, -1], self._sensor_data[:, -1])
        if failed is not None:
            self._new_physics[failed, -1] = self._physics[failed]
            self._sensor_data[failed] = 0.0
        self._physics[:] = self._new_physics[:, -1]
        # Copies: what a task returns may be a part of arrays that the next step writes to
        terms = {name: np.array(term, dtype=np.float64) for name, term in self.task.reward_terms(states).items()}
        terminated = np.array(self.task.terminated(states), dtype=bool)
        observations = np.array(self.task.observations(states))
        if failed is not None:
            terminated[failed] = False
            for term in terms.values():
                term[failed] = 0.0
        rewards = np.asarray(total_reward(terms), dtype=np.float64)
        self._lengths += 1
        self._returns += rewards
        dones = terminated | (self._lengths >= self._limits)
        if failed is not None:
            dones |= failed
        infos = StepInfos(self.num_envs, terms | {"TimeLimit.truncated": dones & ~terminated})
        for env in np.flatnonzero(dones).tolist():
            if failed is not None and failed[env]:
                infos[env]["numerical_failure"] = True
                self._count_failure()
            self._end_episode(env, observations, infos[env])
        return observations, rewards.astype(np.float32), dones, cast(list[dict[str, Any]], infos)

    def _end_episode(self, env: int, observations: np.ndarray, info: dict[str, Any]) -> None:
        info["terminal_observation"] = observations[env].copy()
        if (monitor := self._monitors[env]) is not None:
            record_episode(monitor, float(self._returns[env]), int(self._lengths[env]), info)
        observations[env] = self._reset_env(env, None, {})

    def _reset_env(self, env: int, seed: int | None, options: dict[str, Any]) -> np.ndarray:
        maybe_options = {"options": options} if options else {}
        observation, self.reset_infos[env] = self.envs[env].reset(seed=seed, **maybe_options)
        self._physics[env] = self._bases[env].physics_state[0]
        self._lengths[env], self._returns[env] = 0, 0.0
        return observation

    def _count_failure(self) -> None:
        if self.numerical_failures == 0:
            warnings.warn(
                "The physics of an environment gave numbers that are not finite; its episode was cut before them. "
                "Smaller actions or a shorter timestep may help. Further failures are only counted.",
                stacklevel=2,
            )
        self.numerical_failures += 1

    def close(self) -> None:
        self._pool.close()
        for env in self.envs:
            env.close()

    def get_images(self) -> list[np.ndarray | None]:
        if self.render_mode != "rgb_array":
            warnings.warn(f"The render mode is {self.render_mode}, but this method needs `rgb_array`.", stacklevel=2)
            return [None] * self.num_envs
        self._show(range(self.num_envs))
        return [cast(np.ndarray, env.render()) for env in self.envs]

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        chosen = list(self._get_indices(indices))
        self._show(chosen)
        return [self.envs[env].get_wrapper_attr(attr_name) for env in chosen]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        for env in self._get_indices(indices):
            setattr(self.envs[env], attr_name, value)

    def env_method(self, method_name: str, *args: Any, indices: VecEnvIndices = None, **kwargs: Any) -> list[Any]:
        chosen = list(self._get_indices(indices))
        self._show(chosen)
        results = [self.envs[env].get_wrapper_attr(method_name)(*args, **kwargs) for env in chosen]
        for env in chosen:
            # The method may have moved the environment
            self._physics[env] = self._bases[env].physics_state[0]
            if method_name == "reset":
                self._lengths[env], self._returns[env] = 0, 0.0
        return results

    def env_is_wrapped(self, wrapper_class: type[gym.Wrapper], indices: VecEnvIndices = None) -> list[bool]:
        from stable_baselines3.common.env_util import is_wrapped  # a cycle at the top: env_util imports vec_env

        return [is_wrapped(self.envs[env], wrapper_class) for env in self._get_indices(indices)]

    def _show(self, indices: Sequence[int] | range) -> None:
        """Hand the present state to the environments that are about to be asked something."""
        if self._was_reset:
            for env in indices:
                self._bases[env].physics_state = self._physics[env]


def can_batch(env: gym.Env) -> bool:
    """
    :param env: an environment in its wrappers
    :return: whether :class:`MujocoVecEnv` can step it
    """
    return isinstance(env.unwrapped, MujocoTaskEnv) and _foreign_wrapper(env) is None


def _foreign_wrapper(env: gym.Env) -> gym.Wrapper | None:
    while isinstance(env, gym.Wrapper):
        if not isinstance(env, _KNOWN_WRAPPERS):
            return env
        env = env.env
    return None


def _base_of(env: gym.Env) -> MujocoTaskEnv:
    base = env.unwrapped
    if not isinstance(base, MujocoTaskEnv):
        raise ValueError(f"MujocoVecEnv steps environments of a MujocoTask, got {base}; use DummyVecEnv for it.")
    if (wrapper := _foreign_wrapper(env)) is not None:
        name = type(wrapper).__name__
        raise ValueError(f"MujocoVecEnv cannot show each step to the wrapper {name}; use DummyVecEnv, or leave it out.")
    return base


def _time_limit(env: gym.Env) -> int:
    """The shortest, if there are several."""
    limit = int(np.iinfo(np.int64).max)
    while isinstance(env, gym.Wrapper):
        if isinstance(env, TimeLimit):
            limit = min(limit, env._max_episode_steps)
        env = env.env
    return limit


def _settings_of(task: MujocoTask) -> dict[str, Any]:
    """The class, the model and the plain settings of a task, to be compared."""
    plain = {name: value for name, value in vars(task).items() if isinstance(value, int | float | str | bool)}
    model = np.empty(mujoco.mj_sizeModel(task.model), dtype=np.uint8)
    mujoco.mj_saveModel(task.model, None, model)
    return plain | {"class": type(task), "model": model.tobytes()}


def _n_cores() -> int:
    """That this process may use, where the system tells."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
