"""Gymnasium's MuJoCo tasks, stepped in batches by EnvPool."""

import functools
import warnings
from collections.abc import Callable, Sequence
from types import ModuleType
from typing import Any, NoReturn

import gymnasium as gym
import numpy as np
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvStepReturn

from sb3_gae.envs.mujoco_task import is_physical
from sb3_gae.vec_env.batched_vec_env import BatchedVecEnv, make_envs
from sb3_gae.vec_env.likeness import are_equal, serialized
from sb3_gae.vec_env.monitoring import begin_episode
from sb3_gae.vec_env.wrappers import foreign_wrapper

# Where EnvPool calls a number of the info otherwise than gymnasium does
_INFO_NAMES = {
    "HalfCheetah-v5": {"reward_run": "reward_forward"},
    "Swimmer-v5": {"reward_fwd": "reward_forward"},
    "Humanoid-v5": {
        "reward_linvel": "reward_forward",
        "reward_quadctrl": "reward_ctrl",
        "reward_alive": "reward_survive",
        "reward_impact": "reward_contact",
    },
}
# These say which environment a row is of, and how long its episode is by EnvPool's own count
_NO_INFO = ("env_id", "players", "elapsed_step")

# Arguments of gymnasium's environments that do not touch a trajectory
_OF_PICTURES = ("render_mode", "width", "height", "camera_id", "camera_name", "default_camera_config", "max_geom")

# What of a gymnasium environment shows or moves its state, which here never moves, or changes its physics, which are EnvPool's
_OF_THE_STATE = ("data", "state_vector", "set_state", "do_simulation", "reset_model", "step", "reset", "model", "unwrapped")

# EnvPool's own time limit, which we have no use for: it cannot tell a limit from an end that comes in the same step
_NEVER = np.iinfo(np.int32).max


class EnvPoolVecEnv(BatchedVecEnv):
    """
    Takes the place of ``DummyVecEnv`` for gymnasium's MuJoCo tasks, version 5.

    .. code-block:: python

        env = make_vec_env("HalfCheetah-v5", n_envs=64, vec_env_cls=EnvPoolVecEnv)

    EnvPool has its own build of MuJoCo and its own random numbers: trajectories are those of gymnasium up to
    the last digits, from starts of the same distribution. An episode that has ended is begun anew at once, by a reset of its
    own, so that the step which EnvPool would otherwise spend on that is no part of a batch.

    The gymnasium environments that the functions make stand beside the pool with their wrappers and never move.
    Attributes are theirs, so are the methods of ``Monitor``; methods that would have to know the present state are
    refused, and there are no pictures.

    :param env_fns: each makes a gymnasium MuJoCo environment of version 5 with its default arguments, and leaves it so
    :param n_threads: that step the physics; None for as many as there are cores
    :raises ImportError: if EnvPool is not installed
    :raises ValueError: if there is no environment or one of them comes twice, is of another kind, has a wrapper that
        would have to see each step, or differs from the first; or if ``n_threads`` is less than 1
    """

    def __init__(self, env_fns: Sequence[Callable[[], gym.Env]], n_threads: int | None = None):
        if (envpool := _envpool()) is None:
            raise ImportError('EnvPoolVecEnv needs EnvPool: pip install "sb3-gae[fast]"')
        envs = make_envs(env_fns)
        for env in envs:
            if not can_pool(env):
                raise ValueError(
                    "EnvPoolVecEnv steps gymnasium's MuJoCo tasks of version 5 as `gym.make` makes them by default, "
                    f"got {env}; use DummyVecEnv for it."
                )
        if len(ids := {env.spec.id for env in envs if env.spec}) > 1:
            raise ValueError(f"All environments of an EnvPoolVecEnv must be of one task, got {', '.join(sorted(ids))}.")
        (self._task_id,) = ids
        super().__init__(envs, envs[0].observation_space, envs[0].action_space, n_threads)
        self._make_pool = envpool.make_gymnasium
        self._pool: Any = None
        self._info_names = _INFO_NAMES.get(self._task_id, {})
        self._last_observations = np.zeros((self.num_envs, *self.observation_space.shape))  # type: ignore[misc]

    def step_async(self, actions: np.ndarray) -> None:
        """
        :param actions: of the action space, shape (N, ...)
        :raises gymnasium.error.ResetNeeded: if there was no ``reset`` before
        :raises ValueError: if the shape is wrong
        """
        actions = self._check_actions(actions)
        self._pool.send(actions)

    def step_wait(self) -> VecEnvStepReturn:
        observations, rewards, terminated, _, info = self._pool.recv()
        observations, rewards = observations.copy(), rewards.astype(np.float64)
        columns = self._columns(info)
        sound = is_physical(observations) & np.isfinite(rewards)
        failed = None if sound.all() else ~sound
        if failed is not None:
            observations[failed] = self._last_observations[failed]
            rewards[failed], terminated = 0.0, terminated & sound
            columns = {name: np.where(failed, 0, column) for name, column in columns.items()}
        result = self._finish_step(observations, rewards, terminated, failed, columns)
        self._last_observations[:] = observations
        return result

    def _restart_envs(self, indices: np.ndarray, seeds: Sequence[int | None], options: Sequence[dict[str, Any]]) -> np.ndarray:
        if self._pool is None or any(seed is not None for seed in seeds):
            self._seed_pool(seeds)
        for env in indices.tolist():
            if (monitor := self._monitors[env]) is not None:
                begin_episode(monitor)
        observations, info = self._pool.reset(indices)
        columns = self._columns(info)
        for row, env in enumerate(indices.tolist()):
            self.reset_infos[env] = {name: column[row].item() for name, column in columns.items()}
        self._last_observations[indices] = observations
        return observations

    def _seed_pool(self, seeds: Sequence[int | None]) -> None:
        """EnvPool takes seeds only when it begins."""
        fresh = np.random.SeedSequence().generate_state(self.num_envs).tolist()
        given = [spare if seed is None else seed for seed, spare in zip(seeds, fresh, strict=True)]
        self._pool = self._make_pool(
            self._task_id,
            num_envs=self.num_envs,
            num_threads=self.n_threads,
            env_seed=[seed % _NEVER for seed in given],
            max_episode_steps=_NEVER,
        )

    def _columns(self, info: dict[str, Any]) -> dict[str, np.ndarray]:
        return {self._info_names.get(name, name): column for name, column in info.items() if name not in _NO_INFO}

    def close(self) -> None:
        self._pool, self._was_reset = None, False
        super().close()

    def get_images(self) -> list[np.ndarray | None]:
        warnings.warn("EnvPoolVecEnv has no pictures; use DummyVecEnv for them.", stacklevel=2)
        return [None] * self.num_envs

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """
        :param attr_name: of the gymnasium environments
        :param indices: of those that are asked, None for all
        :return: the value in each of them
        :raises NotImplementedError: if it shows or moves the state, which EnvPool keeps to itself
        """
        if attr_name in _OF_THE_STATE:
            self._refuse(attr_name)
        return super().get_attr(attr_name, indices)

    def env_method(self, method_name: str, *args: Any, indices: VecEnvIndices = None, **kwargs: Any) -> list[Any]:
        """
        :param method_name: of ``Monitor``
        :param args: of the method
        :param indices: of the environments that are asked, None for all
        :param kwargs: of the method
        :return: what it returns in each of them
        :raises NotImplementedError: if it is not one that ``Monitor`` adds to a wrapper's: it may have to know the state
        """
        chosen = list(self._get_indices(indices))
        monitors = [self._monitors[env] for env in chosen]
        if hasattr(gym.Wrapper, method_name) or not all(hasattr(monitor, method_name) for monitor in monitors):
            self._refuse(method_name)
        return [getattr(monitor, method_name)(*args, **kwargs) for monitor in monitors]

    @staticmethod
    def _refuse(name: str) -> NoReturn:
        raise NotImplementedError(
            f"EnvPool keeps the state of these environments to itself, so nobody can be asked for {name!r}; use DummyVecEnv."
        )


def can_pool(env: gym.Env) -> bool:
    """
    :param env: an environment in its wrappers
    :return: whether :class:`EnvPoolVecEnv` can step it, and EnvPool is there to do so
    """
    spec = env.spec
    if spec is None or not type(env.unwrapped).__module__.startswith("gymnasium.envs.mujoco.") or not spec.id.endswith("-v5"):
        return False
    as_registered = gym.spec(spec.id)
    own_arguments = {name: value for name, value in spec.kwargs.items() if name not in _OF_PICTURES}
    if own_arguments != as_registered.kwargs or spec.entry_point != as_registered.entry_point:
        return False
    if foreign_wrapper(env) is not None or (envpool := _envpool()) is None or spec.id not in envpool.list_all_envs():
        return False
    return _is_as_made(env.unwrapped, spec.id)


def _is_as_made(base: Any, task_id: str) -> bool:
    """Whether nobody has changed a setting, a method or the physics since."""
    settings, model = _as_made(task_id)
    own = vars(base)
    return (
        all(name in own and are_equal(own[name], value) for name, value in settings.items())
        and not any(callable(getattr(type(base), name, None)) for name in own)
        and serialized(base.model) == model
    )


@functools.cache
def _as_made(task_id: str) -> tuple[dict[str, Any], bytes]:
    """Settings that are numbers or such, and the physics."""
    env = gym.make(task_id)
    base: Any = env.unwrapped
    plain = (bool, int, float, str, tuple, np.ndarray)
    settings = {
        name: value
        for name, value in vars(base).items()
        # What it was made with has been looked at, and a camera may be among that
        if isinstance(value, plain) and name not in _OF_PICTURES and not name.startswith("_ezpickle")
    }
    model = serialized(base.model)
    env.close()
    return settings, model


def _envpool() -> ModuleType | None:
    try:
        import envpool
    except ImportError:
        return None
    return envpool
