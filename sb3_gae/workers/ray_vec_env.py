"""Environments on Ray workers, behind SB3's ``VecEnv``."""

import functools
import itertools
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvObs, VecEnvStepReturn

from sb3_gae.checks import check_count
from sb3_gae.errors import WorkersLostError
from sb3_gae.rollout.collection import RolloutPlan, Step
from sb3_gae.vec_env.choice import batched_vec_env
from sb3_gae.workers.crew import Crew
from sb3_gae.workers.rollout_worker import ShareOrder, portable_policy, weights_of
from sb3_gae.workers.share import Share, batch_steps, joined
from sb3_gae.workers.wrappers import SentWrapper, learn_from_shares, normalizer_of, wrappers_around, wrappers_to_send


class CollectionRecord(NamedTuple):
    """
    What the last batch took.

    :param seconds: from the order to the last share
    :param worker_seconds: that the slowest worker needed of them
    :param weights_bytes: that went to each worker
    :param shares_bytes: of the arrays that came back
    :param states_bytes: of the environments, that came back with them
    """

    seconds: float
    worker_seconds: float
    weights_bytes: int
    shares_bytes: int
    states_bytes: int


class RayVecEnv(VecEnv):
    """
    Takes the place of ``SubprocVecEnv``; with :class:`~sb3_gae.TRPOGAE` each worker collects its share of a batch by itself.

    .. code-block:: python

        env = make_vec_env("GaeQuadruped-v0", 256, vec_env_cls=RayVecEnv, vec_env_kwargs={"n_workers": 2})
        model = TRPOGAE("MlpPolicy", VecNormalize(env), n_steps=782)

    Weights go out once a batch and arrays come back. The random numbers of a share depend on the training's seed and the
    number of the worker, so that the result is the same wherever workers run. A worker that is lost is replaced, and its
    share is collected again from where its environments stood.

    Other algorithms take its steps one by one, each of which is a message to every worker. ``VecNormalize`` and
    ``VecTransposeImage`` can be put around it; other wrappers belong into ``vec_env_cls``.

    :param env_fns: each makes an environment
    :param n_workers: that share them, the first ones taking one more where they do not divide
    :param vec_env_cls: makes the batch of a worker of its functions; None for what steps them fastest
    :param cpus_per_worker: that Ray reserves for each worker, and threads that it uses
    :raises ImportError: if Ray is not installed
    :raises ValueError: if a number is out of range, or there are more workers than functions
    :raises WorkersLostError: if Ray has no place for the workers
    """

    def __init__(
        self,
        env_fns: Sequence[Callable[[], gym.Env]],
        n_workers: int,
        vec_env_cls: Callable[..., VecEnv] | None = None,
        cpus_per_worker: int = 1,
    ):
        check_count("n_workers", n_workers)
        check_count("cpus_per_worker", cpus_per_worker)
        if n_workers > len(env_fns):
            raise ValueError(f"`n_workers` = {n_workers} must not be more than the environments, which are {len(env_fns)}.")
        make = vec_env_cls or functools.partial(batched_vec_env, n_threads=cpus_per_worker)
        makers = [functools.partial(make, part) for part in parts_of(env_fns, n_workers)]
        self._crew = Crew(makers, cpus_per_worker)
        sizes, observation_spaces, action_spaces = zip(*self._crew.descriptions, strict=True)
        # Where the environments of each worker begin, and where those of the last end
        self._borders = np.cumsum([0, *sizes]).tolist()
        # Of each worker; None where nobody knows
        self._states: list[bytes | None] | None = None
        super().__init__(sum(sizes), observation_spaces[0], action_spaces[0])
        self._policy: ActorCriticPolicy | None = None
        self._policy_content = b""
        self._actions: np.ndarray | None = None
        #: None before the first batch
        self.last_collection: CollectionRecord | None = None

    @property
    def n_workers(self) -> int:
        """Number of workers."""
        return len(self._borders) - 1

    def reset(self) -> VecEnvObs:
        arguments = [(self._seeds[envs], self._options[envs]) for envs in self._slices]
        answers = self._crew.ask("reset", arguments, replaced=self._go_on_where_it_stood)
        self._reset_seeds()
        self._reset_options()
        self.reset_infos = [info for _, infos, _ in answers for info in infos]
        self._states = [state for *_, state in answers]
        return joined([observations for observations, *_ in answers])

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = np.asarray(actions)

    def step_wait(self) -> VecEnvStepReturn:
        assert self._actions is not None, "Call `step_async` first."
        # No longer what the workers' environments are
        self._states = None
        answers = self._crew.ask("step", [(self._actions[envs],) for envs in self._slices])
        observations, rewards, dones, infos, reset_infos = zip(*answers, strict=True)
        self.reset_infos = [info for part in reset_infos for info in part]
        return joined(observations), np.concatenate(rewards), np.concatenate(dones), [info for part in infos for info in part]

    def collect_rollout(self, policy: ActorCriticPolicy, env: VecEnv, plan: RolloutPlan) -> Iterator[Step]:
        """
        :param policy: in evaluation mode
        :param env: these environments in their wrappers
        :param plan: how many steps to take
        :return: the steps of all workers, in the order of the environments. After the last of them the statistics of
            ``VecNormalize`` know the batch
        :raises NumericalError: if an observation, action or reward is not finite
        :raises ValueError: if a wrapper cannot be there
        :raises WorkersLostError: if Ray is gone, or a worker is lost again and again
        """
        wrappers = wrappers_around(env)
        normalize = normalizer_of(wrappers)
        with_moments = normalize is not None and normalize.training and normalize.norm_obs
        shares = self._collect_shares(policy, plan, wrappers_to_send(wrappers), with_moments)
        rewards = [share.rewards if normalize is None else normalize.normalize_reward(share.rewards) for share in shares]
        yield from batch_steps(policy, shares, rewards)
        if normalize is not None:
            learn_from_shares(normalize, shares)

    def _collect_shares(
        self, policy: ActorCriticPolicy, plan: RolloutPlan, wrappers: list[SentWrapper], with_moments: bool
    ) -> list[Share]:
        start = time.perf_counter()
        before = th.get_rng_state()
        seed = int(th.randint(2**62, ()))
        try:
            self._send_policy(policy)
            if self._states is None:
                self._states = self._crew.ask("state", [()] * self.n_workers)
            weights = weights_of(policy)
            for_all = self._crew.share(weights)
            orders = [
                (ShareOrder(plan, share_seed(seed, worker), wrappers, with_moments, first_env), for_all)
                for worker, first_env in enumerate(self._borders[:-1])
            ]
            answers = self._crew.ask("collect", orders, replaced=self._go_on_where_it_stood)
        except WorkersLostError:
            # As if the batch had not begun, for a checkpoint
            th.set_rng_state(before)
            raise
        self._states = [state for _, state in answers]
        shares = [share for share, _ in answers]
        self.last_collection = CollectionRecord(
            seconds=time.perf_counter() - start,
            worker_seconds=max(share.seconds for share in shares),
            weights_bytes=sum(array.nbytes for array in weights.values()),
            shares_bytes=sum(share.n_bytes for share in shares),
            states_bytes=sum(len(state) for state in self._states if state is not None),
        )
        return shares

    def _send_policy(self, policy: ActorCriticPolicy) -> None:
        if policy is not self._policy:
            self._policy_content = portable_policy(policy)
            self._ask("take_policy", [(self._policy_content,)] * self.n_workers)
            self._policy = policy

    def _go_on_where_it_stood(self, worker: int) -> None:
        """Bring a new worker to where the one before it was at the beginning of the batch."""
        if self._policy is not None:
            self._crew.ask("take_policy", [(self._policy_content,)], workers=[worker])
        if self._states is None:
            return
        if (state := self._states[worker]) is not None:
            self._crew.ask("go_on_from", [(state,)], workers=[worker])
            return
        warnings.warn(
            f"The environments of worker {worker} could not say where they were: they begin new episodes, and the training is "
            "another one than without the loss.",
            stacklevel=2,
        )
        n_envs = self._borders[worker + 1] - self._borders[worker]
        seeds = th.randint(2**31, (n_envs,)).tolist()
        self._crew.ask("reset", [(seeds, [{}] * n_envs)], workers=[worker])

    def state_dict(self) -> list[bytes] | None:
        """
        :return: where the environments of each worker stand; None if some cannot say. Known without Ray at the end of a batch
        """
        if self._states is None:
            self._states = self._crew.ask("state", [()] * self.n_workers)
        states = [state for state in self._states if state is not None]
        return states if len(states) == self.n_workers else None

    def load_state_dict(self, states: list[bytes]) -> None:
        """
        :param states: what :meth:`state_dict` returned, in this process or an earlier one
        :raises ValueError: if it is of another number of workers
        """
        if len(states) != self.n_workers:
            raise ValueError(
                f"`n_workers` must be that of the checkpoint, {len(states)}, but is {self.n_workers}: other workers draw "
                "other random numbers."
            )
        self._crew.ask("go_on_from", [(state,) for state in states])
        self._states = list(states)

    def close(self) -> None:
        self._crew.close()

    def get_images(self) -> Sequence[np.ndarray | None]:
        return [image for part in self._ask("ask", [("get_images", (), {})] * self.n_workers) for image in part]

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        return self._ask_those(indices, "get_attr", attr_name)

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        self._states = None
        self._ask_those(indices, "set_attr", attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        self._states = None
        return self._ask_those(indices, "env_method", method_name, *method_args, **method_kwargs)

    def env_is_wrapped(self, wrapper_class: type[gym.Wrapper], indices: VecEnvIndices = None) -> list[bool]:
        return self._ask_those(indices, "env_is_wrapped", wrapper_class)

    def _ask(self, method: str, arguments: Sequence[tuple[Any, ...]], workers: Sequence[int] | None = None) -> list[Any]:
        """Replace a worker that was lost since the last batch, if it is known where it stood."""
        replaced = None if self._states is None else self._go_on_where_it_stood
        return self._crew.ask(method, arguments, replaced=replaced, workers=workers)

    @property
    def _slices(self) -> list[slice]:
        return [slice(start, end) for start, end in itertools.pairwise(self._borders)]

    def _ask_those(self, indices: VecEnvIndices, method: str, *args: Any, **kwargs: Any) -> list[Any]:
        """Each worker that has some of the environments, about these; in the order of the indices."""
        chosen = list(self._get_indices(indices))
        worker_of = np.searchsorted(self._borders, chosen, side="right") - 1
        workers = np.unique(worker_of).tolist()
        places = [np.flatnonzero(worker_of == worker).tolist() for worker in workers]
        local = [[chosen[place] - self._borders[worker] for place in own] for worker, own in zip(workers, places, strict=True)]
        parts = self._ask("ask", [(method, args, kwargs | {"indices": own}) for own in local], workers=workers)
        answers: list[Any] = [None] * len(chosen)
        for own, part in zip(places, parts, strict=True):
            for place, answer in zip(own, part or [None] * len(own), strict=True):
                answers[place] = answer
        return answers


def parts_of(env_fns: Sequence[Any], n_workers: int) -> list[list[Any]]:
    """
    :param env_fns: N functions
    :param n_workers: at most N
    :return: the functions of each worker, in order; the first ones have one more where they do not divide
    """
    size, n_larger = divmod(len(env_fns), n_workers)
    ends = [size * worker + min(worker, n_larger) for worker in range(n_workers + 1)]
    return [list(env_fns[start:end]) for start, end in itertools.pairwise(ends)]


def share_seed(seed: int, worker: int) -> int:
    """
    :param seed: of the batch
    :param worker: its number
    :return: of the worker's share
    """
    return int(np.random.SeedSequence([seed, worker]).generate_state(1, np.uint64)[0] % 2**63)


def env_on_workers(env: Any, n_workers: int) -> VecEnv:
    """
    :param env: an id, a function that makes an environment or a ``VecEnv``, of which each worker has one, or environments
        that are on workers already
    :param n_workers: number of workers
    :return: environments on workers
    :raises ValueError: if the number is out of range, or workers cannot make the environment
    :raises ImportError: if Ray is not installed
    :raises WorkersLostError: if Ray has no place for the workers
    """
    check_count("rollout_workers", n_workers)
    if isinstance(env, VecEnv) and isinstance(base := env.unwrapped, RayVecEnv):
        if base.n_workers != n_workers:
            raise ValueError(f"`rollout_workers` = {n_workers}, but `env` is on {base.n_workers} workers; leave it out.")
        return env
    if isinstance(env, str):
        env = functools.partial(gym.make, gym.spec(env))
    if isinstance(env, gym.Env | VecEnv) or not callable(env):
        raise ValueError(
            f"`rollout_workers` = {n_workers} needs an `env` that workers can make: an id, a function that makes an "
            f"environment or a VecEnv, or a RayVecEnv; got {type(env).__name__}."
        )
    return RayVecEnv([env] * n_workers, n_workers, vec_env_cls=_made_by_one)


def _made_by_one(env_fns: Sequence[Callable[[], Any]]) -> VecEnv:
    (make,) = env_fns
    env = make()
    if isinstance(env, VecEnv):
        return env
    monitored = env if _is_monitored(env) else Monitor(env)
    return batched_vec_env([lambda: monitored], n_threads=1)


def _is_monitored(env: gym.Env) -> bool:
    from stable_baselines3.common.env_util import is_wrapped  # a cycle at the top: env_util imports vec_env

    return is_wrapped(env, Monitor)
