"""Many environments of one :class:`~sb3_gae.envs.MujocoTask`, stepped by one native call."""

import copy
import warnings
from collections.abc import Callable, Iterable, Sequence
from typing import Any, cast

import gymnasium as gym
import mujoco
import numpy as np
from mujoco.rollout import Rollout
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvStepReturn

from sb3_gae.envs.mujoco_env import MujocoTaskEnv
from sb3_gae.envs.mujoco_task import MujocoTask, is_physical, total_reward
from sb3_gae.vec_env.batched_vec_env import BatchedVecEnv, make_envs
from sb3_gae.vec_env.likeness import are_equal, serialized
from sb3_gae.vec_env.wrappers import foreign_wrapper

# Where the batch stands; all else is scratch, or belongs to the environments
_STATE = ("_physics", "_lengths", "_returns", "_was_reset", "numerical_failures")


class MujocoVecEnv(BatchedVecEnv):
    """
    Takes the place of ``DummyVecEnv`` and gives the same trajectories, faster.

    .. code-block:: python

        env = make_vec_env("GaeBiped-v0", n_envs=64, vec_env_cls=MujocoVecEnv)

    The environments that the functions make are kept: each draws its own initial states, and attributes, methods
    and pictures are asked of them, with the present state handed to them first. Between resets they are not stepped.
    They share the first one's ``task`` and ``model``, so that whoever changes them changes them for all.

    :param env_fns: each makes an environment whose innermost is a :class:`~sb3_gae.envs.MujocoTaskEnv` with its own ``step``
    :param n_threads: that step the physics; None for as many as there are cores
    :raises ValueError: if there is no environment or one of them comes twice, is of another kind, has a wrapper that
        would have to see each step, or differs from the first; or if ``n_threads`` is less than 1
    """

    def __init__(self, env_fns: Sequence[Callable[[], gym.Env]], n_threads: int | None = None):
        envs = make_envs(env_fns)
        self._bases = [_base_of(env) for env in envs]
        if not have_common_task(envs):
            raise ValueError("All environments of a MujocoVecEnv must be of one task with the same arguments.")
        self.task = self._bases[0].task
        model = self.task.model
        super().__init__(envs, self.task.observation_space, self.task.action_space, n_threads)
        for base in self._bases[1:]:
            base.share_task(self.task)
        self._pool = Rollout(nthread=self.n_threads if self.n_threads > 1 else 0)
        self._models, self._datas = [model] * self.num_envs, [mujoco.MjData(model) for _ in range(self.n_threads)]
        n_state, frame_skip = self._bases[0].physics_state.shape[1], self.task.frame_skip
        self._physics = np.zeros((self.num_envs, n_state))
        self._new_physics = np.zeros((self.num_envs, frame_skip, n_state))
        self._sensor_data = np.zeros((self.num_envs, frame_skip, model.nsensordata))
        self._controls = np.zeros((self.num_envs, frame_skip, model.nu))

    def step_async(self, actions: np.ndarray) -> None:
        """
        :param actions: of the action space, shape (N, ...)
        :raises gymnasium.error.ResetNeeded: if there was no ``reset`` before
        :raises ValueError: if the shape is wrong
        """
        self._controls[:] = self.task.controls(self._check_actions(actions))[:, None]

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
        failed = self._failures()
        states = self.task.states(self._new_physics[:, -1], self._controls[:, -1], self._sensor_data[:, -1])
        if failed is not None:
            self._go_back(failed)
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
        return self._finish_step(observations, rewards, terminated, failed, terms)

    def _failures(self) -> np.ndarray | None:
        """Whether each environment's numbers blew up in this step, shape (N,); None if they did nowhere."""
        # Not in the last physics step alone: numbers that blew up before it may have been cut to something finite
        sound = is_physical(self._new_physics.reshape(self.num_envs, -1))
        # After a warning of MuJoCo the native call takes no more physics steps, and time stands still
        sound &= (np.diff(self._new_physics[:, :, 0], axis=1) > 0.0).all(axis=1)
        return None if sound.all() else ~sound

    def _go_back(self, failed: np.ndarray) -> None:
        """To the state before the step, with what the sensors say of it."""
        self._new_physics[failed, -1] = self._physics[failed]
        for env in np.flatnonzero(failed).tolist():
            base = self._bases[env]
            base.data.ctrl[:] = self._controls[env, -1]
            base.physics_state = self._physics[env]
            self._sensor_data[env, -1] = base.data.sensordata

    def _restart_envs(self, indices: np.ndarray, seeds: Sequence[int | None], options: Sequence[dict[str, Any]]) -> np.ndarray:
        observations = []
        for env, seed, its_options in zip(indices.tolist(), seeds, options, strict=True):
            maybe_options = {"options": its_options} if its_options else {}
            observation, self.reset_infos[env] = self.envs[env].reset(seed=seed, **maybe_options)
            self._physics[env] = self._bases[env].physics_state[0]
            observations.append(observation)
        return np.stack(observations)

    def state_dict(self) -> dict[str, Any]:
        """
        :return: what the next steps depend on, beside the state of the environments themselves
        """
        return {name: copy.deepcopy(getattr(self, name)) for name in _STATE}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """
        :param state: what :meth:`state_dict` returned, in this process or an earlier one
        """
        for name in _STATE:
            setattr(self, name, copy.deepcopy(state[name]))

    def close(self) -> None:
        self._pool.close()
        super().close()

    def get_images(self) -> list[np.ndarray | None]:
        if self.render_mode != "rgb_array":
            warnings.warn(f"The render mode is {self.render_mode}, but this method needs `rgb_array`.", stacklevel=2)
            return [None] * self.num_envs
        self._show(range(self.num_envs))
        return [cast(np.ndarray, env.render()) for env in self.envs]

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        self._show(self._get_indices(indices))
        return super().get_attr(attr_name, indices)

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

    def _show(self, indices: Iterable[int]) -> None:
        """Hand the present state to the environments that are about to be asked something."""
        if self._was_reset:
            for env in indices:
                self._bases[env].physics_state = self._physics[env]


def can_batch(env: gym.Env) -> bool:
    """
    :param env: an environment in its wrappers
    :return: whether :class:`MujocoVecEnv` can step it
    """
    return _steps_a_task(env.unwrapped) and foreign_wrapper(env) is None


def have_common_task(envs: Sequence[gym.Env]) -> bool:
    """
    :param envs: each of which :class:`MujocoVecEnv` can step
    :return: whether they are of one task with the same model and the same settings
    """
    first, *others = (cast(MujocoTaskEnv, env.unwrapped).task for env in envs)
    model = serialized(first.model)
    return all(
        type(task) is type(first) and are_equal(_settings_of(task), _settings_of(first)) and serialized(task.model) == model
        for task in others
    )


def _steps_a_task(base: gym.Env) -> bool:
    """A subclass with steps of its own would not be asked for them."""
    return isinstance(base, MujocoTaskEnv) and type(base).step is MujocoTaskEnv.step


def _base_of(env: gym.Env) -> MujocoTaskEnv:
    base = env.unwrapped
    if not isinstance(base, MujocoTaskEnv):
        raise ValueError(
            f"MujocoVecEnv steps environments of a MujocoTask, got {base}; use DummyVecEnv for it, "
            "or EnvPoolVecEnv for gymnasium's MuJoCo tasks."
        )
    if not _steps_a_task(base):
        raise ValueError(
            f"MujocoVecEnv would pass by the `step` of {type(base).__name__}; say it in the functions of its MujocoTask, "
            "or use DummyVecEnv."
        )
    return base


def _settings_of(task: MujocoTask) -> dict[str, Any]:
    return {name: value for name, value in vars(task).items() if name not in ("model", "_initial_data")}
