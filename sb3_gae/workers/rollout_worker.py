"""What runs in a worker's process. It knows nothing of Ray."""

import contextlib
import io
import os
import pickle
import random
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import cloudpickle
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common import monitor
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.vec_env import VecEnv, VecNormalize, is_vecenv_wrapped

from sb3_gae.rollout.collection import Observations, RolloutPlan
from sb3_gae.saving.environment_state import EnvironmentState, environment_state, restore_environment
from sb3_gae.workers.share import Share, collect_share
from sb3_gae.workers.wrappers import ObservationWatch, SentWrapper, seen_through, wrap

#: parameters and buffers of the policy by name
Weights = dict[str, np.ndarray]


class ShareOrder(NamedTuple):
    """
    :param plan: how many steps to take
    :param seed: for all random numbers of the share but those that the environments keep themselves
    :param wrappers: what :func:`~sb3_gae.workers.wrappers.wrappers_to_send` returned
    :param with_moments: whether statistics are kept of the observations
    :param first_env: number of the worker's first environment in the whole batch
    """

    plan: RolloutPlan
    seed: int
    wrappers: list[SentWrapper]
    with_moments: bool
    first_env: int


class WorkerState(NamedTuple):
    """
    Where the environments of a worker stand.

    :param environment: of the environments themselves
    :param observations: the last ones, as the environments gave them, shape (n, ...), or a dictionary of such
    :param episode_starts: whether they stand at the beginning of an episode, shape (n,)
    """

    environment: EnvironmentState
    observations: Observations
    episode_starts: np.ndarray


class RolloutWorker:
    """
    Environments of its own and a copy of the policy.

    :param make: makes the environments
    :param n_threads: of torch
    :param folder: in which relative paths begin, such as those of monitor files; left where it is if there is none here
    :param is_replacement: whether the worker takes the place of one that was lost, so that files go on where that one stopped
    """

    _env: VecEnv
    _episode_starts: np.ndarray

    def __init__(self, make: Callable[[], VecEnv], n_threads: int, folder: str, is_replacement: bool = False):
        self._make = make
        self._n_threads = n_threads
        self._folder = folder
        self._is_replacement = is_replacement
        self._policy: ActorCriticPolicy | None = None
        self._observations: Observations | None = None

    def start(self) -> tuple[int, spaces.Space, spaces.Space]:
        """
        Make the environments: not in the constructor, whose errors Ray would take for the loss of the worker.

        :return: number of environments, observation space and action space
        :raises ValueError: if the environments normalize, each worker's by themselves
        """
        th.set_num_threads(self._n_threads)
        with contextlib.suppress(OSError):
            os.chdir(self._folder)
        with _monitor_files_go_on() if self._is_replacement else contextlib.nullcontext():
            self._env = self._make()
        if is_vecenv_wrapped(self._env, VecNormalize):
            raise ValueError(
                "Workers must not normalize by themselves, as their statistics would differ; leave VecNormalize out of the "
                "function that makes environments, and put it around the RayVecEnv."
            )
        self._episode_starts = np.ones(self._env.num_envs, dtype=bool)
        return self._env.num_envs, self._env.observation_space, self._env.action_space

    def reset(
        self, seeds: Sequence[int | None], options: list[dict[str, Any]]
    ) -> tuple[Observations, list[dict], bytes | None]:
        """
        :param seeds: of each environment, None to go on with its own random numbers
        :param options: of each environment
        :return: first observations, what the environments say of the reset, and their state
        """
        if (given := [seed for seed in seeds if seed is not None]) and len(given) == len(seeds):
            # For environments that draw from the generators of the process
            _seed_process(given[0])
            self._env.unwrapped._seeds = list(seeds)
        self._env.set_options(options)
        self._observations = self._env.reset()  # type: ignore[assignment]
        self._episode_starts = np.ones(self._env.num_envs, dtype=bool)
        assert self._observations is not None
        return self._observations, list(self._env.unwrapped.reset_infos), self.state()

    def step(self, actions: np.ndarray) -> tuple[Observations, np.ndarray, np.ndarray, list[dict], list[dict]]:
        """
        :param actions: of each environment
        :return: what ``VecEnv.step`` does, and what environments said of their last reset
        """
        observations, rewards, dones, infos = self._env.step(actions)
        self._observations, self._episode_starts = observations, dones  # type: ignore[assignment]
        return observations, rewards, dones, list(infos), list(self._env.unwrapped.reset_infos)  # type: ignore[return-value]

    def take_policy(self, content: bytes) -> None:
        """
        :param content: what :func:`portable_policy` returned
        """
        self._policy = th.load(io.BytesIO(content), map_location="cpu", weights_only=False)

    def collect(self, order: ShareOrder, weights: Weights) -> tuple[Share, bytes | None]:
        """
        :param order: what to collect
        :param weights: of the policy, as it is for this batch
        :return: the share, and the state of the environments after it
        :raises NumericalError: if an observation, action or reward is not finite
        """
        assert self._policy is not None and self._observations is not None
        start = time.perf_counter()
        self._policy.load_state_dict({name: th.tensor(array) for name, array in weights.items()})
        self._policy.set_training_mode(False)
        _seed_process(order.seed)
        watch = ObservationWatch(self._env, order.with_moments)
        env = wrap(watch, order.wrappers)
        seen = seen_through(env, self._observations)
        share = collect_share(self._policy, env, seen, self._episode_starts, order.plan, order.first_env)
        self._observations, self._episode_starts = watch.observations, share.dones[-1]
        moments, state = watch.total(), self.state()
        return share._replace(moments=moments, seconds=time.perf_counter() - start), state

    def state(self) -> bytes | None:
        """
        :return: where the environments stand; None if they cannot say
        """
        environment = environment_state(self._env)
        if environment.envs is None or self._observations is None:
            return None
        return pickle.dumps(WorkerState(environment, self._observations, self._episode_starts))

    def go_on_from(self, content: bytes) -> None:
        """
        :param content: what :meth:`state` returned, in this process or another
        :raises ValueError: if the environments are made otherwise
        """
        state: WorkerState = pickle.loads(content)
        restore_environment(self._env, state.environment)
        self._observations, self._episode_starts = state.observations, state.episode_starts

    def ask(self, method: str, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """
        :param method: of ``VecEnv``
        :param args: of the method
        :param kwargs: of the method
        :return: what it does
        """
        return getattr(self._env, method)(*args, **kwargs)


def portable_policy(policy: ActorCriticPolicy) -> bytes:
    """
    :param policy: on any device
    :return: what a worker needs to have a copy, which is without an optimiser
    """
    twin = object.__new__(type(policy))
    vars(twin).update({name: value for name, value in vars(policy).items() if name != "optimizer"})
    memory = io.BytesIO()
    th.save(twin, memory, pickle_module=cloudpickle)
    return memory.getvalue()


def weights_of(policy: ActorCriticPolicy) -> Weights:
    """
    :param policy: on any device
    :return: its parameters and buffers
    """
    return {name: tensor.detach().cpu().numpy() for name, tensor in policy.state_dict().items()}


def _seed_process(seed: int) -> None:
    random.seed(seed)
    np.random.seed(seed % 2**32)
    th.manual_seed(seed)


@contextlib.contextmanager
def _monitor_files_go_on() -> Iterator[None]:
    """SB3's monitors would begin their files anew, and so delete the episodes of the worker before."""
    writer = monitor.ResultsWriter

    def appending(*args: Any, **kwargs: Any) -> monitor.ResultsWriter:
        return writer(*args, **kwargs | {"override_existing": False})

    monitor.ResultsWriter = appending  # type: ignore[assignment, misc]
    try:
        yield
    finally:
        monitor.ResultsWriter = writer  # type: ignore[misc]
