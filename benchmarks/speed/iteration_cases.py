"""
Batched stepping, rollouts and whole iterations. The peer steps gymnasium environments in a DummyVecEnv, as many of them as
ours, but 32 for the biped's iterations, with which it was fastest. The limit is the physics alone.
"""

import functools
import importlib.util
from collections.abc import Callable, Iterator
from functools import partial

import numpy as np
from sb3_contrib import TRPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from benchmarks.rollout_speed import Learner, make_learner, physics_alone
from benchmarks.speed.case import LIMIT, OURS, PEER, Case, Prepared
from benchmarks.speed.plan import Plan
from sb3_gae import TRPOGAE
from sb3_gae.vec_env.choice import batched_vec_env

BIPED, CHEETAH = "GaeBiped-v0", "HalfCheetah-v5"
#: of each environment, so that most bipeds are still up, as they are in training
STEPS = 49
PEER_ENVS, CHEETAH_ENVS = 32, 8


def tasks() -> tuple[str, ...]:
    """:return: tasks whose environments are stepped in batches with what is installed"""
    return (BIPED, CHEETAH) if importlib.util.find_spec("envpool") else (BIPED,)


def stepping_cases(plan: Plan) -> Iterator[Case]:
    """
    :param plan: with the sizes
    :return: one step of all environments, against their number
    """
    for task in tasks():
        for n_envs in plan.n_envs:
            for who in (OURS, PEER, LIMIT):
                prepare = partial(_physics, task, n_envs, plan.threads, STEPS, STEPS) if who == LIMIT else (
                    partial(_stepping, who, task, n_envs, plan.threads)
                )  # fmt: skip
                yield Case(f"stepping, {task}", "environments", n_envs, who, prepare)


def iteration_cases(plan: Plan) -> Iterator[Case]:
    """
    :param plan: with the sizes
    :return: rollouts against batch and number of environments, iterations against batch
    """
    for size in _sizes(plan):
        for part, work in _WORK.items():
            if part in size.parts:
                yield from _contenders(f"{part}, {size.task}", work, size, plan.threads)


class _Size:
    """One size of the rollouts and iterations of a task."""

    def __init__(self, task: str, varied: str, n_envs: int, n_steps: int, peer_envs: int, parts: tuple[str, ...]):
        self.task, self.varied, self.parts = task, varied, parts
        self.n_envs, self.n_steps, self.batch = n_envs, n_steps, n_envs * n_steps
        self.peer_envs = peer_envs
        self.value = self.batch if varied == "batch" else n_envs


def _sizes(plan: Plan) -> Iterator[_Size]:
    both = ("rollout", "iteration")
    for n_steps in plan.biped_steps:
        yield _Size(BIPED, "batch", plan.biped_envs, n_steps, PEER_ENVS, both)
    for n_steps in plan.cheetah_steps if CHEETAH in tasks() else ():
        yield _Size(CHEETAH, "batch", CHEETAH_ENVS, n_steps, CHEETAH_ENVS, both)
    for task in tasks():
        for n_envs in plan.n_envs:
            yield _Size(task, "environments", n_envs, plan.width_batch // n_envs, n_envs, ("rollout",))


def _contenders(part: str, work: Callable[[Learner], None], size: _Size, threads: int) -> Iterator[Case]:
    learners = {OURS: (TRPOGAE, size.n_envs), PEER: (TRPO, size.peer_envs)}
    for who, (algorithm, n_envs) in learners.items():
        prepare = partial(_learning, work, algorithm, size.task, n_envs, size.batch, threads)
        yield Case(part, size.varied, size.value, who, prepare)
    prepare = partial(_physics, size.task, size.n_envs, threads, size.n_steps, 1)
    yield Case(part, size.varied, size.value, LIMIT, prepare)


_WORK: dict[str, Callable[[Learner], None]] = {"rollout": Learner.collect, "iteration": Learner.iterate}


@functools.lru_cache(maxsize=2)
def _learner(algorithm: type, task: str, n_envs: int, batch: int, threads: int) -> Learner:
    if algorithm is TRPO:
        return make_learner(algorithm, task, n_envs, batch)
    return make_learner(algorithm, task, n_envs, batch, vec_env_cls=batched_vec_env, vec_env_kwargs={"n_threads": threads})


def _learning(work: Callable[[Learner], None], algorithm: type, task: str, n_envs: int, batch: int, threads: int) -> Prepared:
    learner = _learner(algorithm, task, n_envs, batch, threads)
    return Prepared(lambda: work(learner))


@functools.lru_cache(maxsize=2)
def _batched(task: str, n_envs: int, threads: int) -> VecEnv:
    return make_vec_env(task, n_envs, seed=0, vec_env_cls=batched_vec_env, vec_env_kwargs={"n_threads": threads})  # type: ignore[arg-type]


def _physics(task: str, n_envs: int, threads: int, n_steps: int, repeats: int) -> Prepared:
    return Prepared(physics_alone(_batched(task, n_envs, threads), task, n_steps), repeats=repeats)


def _stepping(who: str, task: str, n_envs: int, threads: int) -> Prepared:
    env = _batched(task, n_envs, threads) if who == OURS else make_vec_env(task, n_envs, seed=0, vec_env_cls=DummyVecEnv)
    space = env.action_space
    actions = np.random.default_rng(0).uniform(space.low, space.high, (STEPS, n_envs, *space.shape)).astype(space.dtype)  # type: ignore[attr-defined,misc]

    def steps() -> None:
        for action in actions:
            env.step(action)

    return Prepared(steps, lambda: env.reset(), repeats=STEPS)
