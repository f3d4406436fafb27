"""Speed as ratios of times in one process, the two in turn, so that a slow or busy machine changes them little."""

import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch as th
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.type_aliases import MaybeCallback
from stable_baselines3.common.vec_env import VecEnv

from benchmarks.update_speed import Update, ours, theirs
from sb3_gae import TRPOGAE
from sb3_gae.batch import standardized
from sb3_gae.rollout.collection import ActionSampler
from sb3_gae.rollout.evaluation import training_batch
from sb3_gae.vec_env.choice import batched_vec_env

BATCH = 12_288
N_ENVS, N_STEPS = 64, 64
#: one whose physics takes most of a rollout, and one whose physics takes little: there what is done around it shows
ROLLOUT_TASKS = ("GaeBiped-v0", "GaeCartPole-v0")
#: where a step costs what its Python does
N_FEW_ENVS, N_CALLS = 8, 100
N_GRIDS = 20
ROUNDS = 5
#: over all that is timed, so that a slow while of the machine is not in all rounds of anything
SWEEPS = 3


class Times(NamedTuple):
    """
    :param of: seconds of what is judged
    :param per: seconds of what it is compared with
    """

    of: float
    per: float


def speed_ratios() -> dict[str, float]:
    """
    :return: by name; the smaller the faster
    """
    th.set_num_threads(1)
    sweeps = [speed_times() for _ in range(SWEEPS)]
    # The least of each by itself: of ratios the least would be the one whose divisor was slowed down
    return {name: min(times[name].of for times in sweeps) / min(times[name].per for times in sweeps) for name in sweeps[0]}


def speed_times() -> dict[str, Times]:
    """:return: by name"""
    return (
        update_times()
        | {"16 advantages / 1": grid_times(), "actions / policy's own": actions_times()}
        | {f"rollout / steps, {task}": rollout_times(task) for task in ROLLOUT_TASKS}
    )


def update_times() -> dict[str, Times]:
    """
    :return: an update and that of sb3-contrib's TRPO on the same rollout; policy step and value fit and a forward and
        backward pass of both networks
    """
    model = ours(BATCH)
    update, peer = Update(model), Update(theirs(model))
    batch = training_batch(model.rollout_buffer, model.action_space)
    parameters = model._parameter_groups(batch)
    times = least_seconds(
        {
            "update": (update, update.rewind),
            "peer": (peer, peer.rewind),
            "policy": (lambda: model._step_policy(batch, parameters), update.rewind),
            "value": (lambda: model._fit_value(batch, parameters), update.rewind),
            "passes": (lambda: forward_and_backward(model), None),
        }
    )
    return {
        "update / sb3-contrib's": Times(times["update"], times["peer"]),
        "policy step / passes": Times(times["policy"], times["passes"]),
        "value fit / passes": Times(times["value"], times["passes"]),
    }


def grid_times() -> Times:
    """
    :return: grids of 16 advantages, and as many single passes. Not between updates: how much of the caches those leave is
        chance, and was as large a part of the ratio as the passes
    """
    buffer, lambdas = ours(BATCH).rollout_buffer, np.linspace(0.85, 1.0, 16)
    times = least_seconds(
        {
            "grid": (lambda: [buffer.advantage_grid([0.99], lambdas) for _ in range(N_GRIDS)], None),
            "single": (lambda: [buffer.advantage_grid([0.99], lambdas[:1]) for _ in range(N_GRIDS)], None),
        }
    )
    return Times(times["grid"], times["single"])


def rollout_times(task: str) -> Times:
    """
    :param task: id
    :return: a rollout, and stepping the same environments with given actions
    """
    collect, env = rollout(task)
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (N_STEPS, N_ENVS, *env.action_space.shape)).astype(np.float32)
    times = least_seconds(
        {
            "rollout": (collect, None),
            "steps": (lambda: [env.step(action) for action in actions], None),
        }
    )
    return Times(times["rollout"], times["steps"])


def rollout(task: str, seed: int = 0, callback: MaybeCallback = None) -> tuple[Callable[[], bool], VecEnv]:
    """
    :param task: id
    :param seed: of environments and policy
    :param callback: called at each step
    :return: collects a batch of a new agent, and the environments that it steps
    """
    env = make_vec_env(task, N_ENVS, seed=seed, vec_env_cls=batched_vec_env, vec_env_kwargs={"n_threads": 1})
    model = TRPOGAE("MlpPolicy", env, n_steps=N_STEPS, seed=seed, device="cpu")
    _, callbacks = model._setup_learn(N_ENVS * N_STEPS, callback)
    callbacks.on_training_start(locals(), globals())
    return lambda: model.collect_rollouts(model.env, callbacks, model.rollout_buffer, N_STEPS), env


def actions_times() -> Times:
    """
    :return: the actions of a few environments in each of a hundred steps, and those of the policy's own method
    """
    policy = ours(BATCH).policy
    observations = np.random.default_rng(0).standard_normal((N_FEW_ENVS, *policy.observation_space.shape)).astype(np.float32)
    sample, tensor = ActionSampler(policy), th.as_tensor(observations)

    @th.no_grad()
    def ask_policy() -> None:
        for _ in range(N_CALLS):
            policy._predict(tensor)

    times = least_seconds(
        {
            "actions": (lambda: [sample(observations, step) for step in range(N_CALLS)], None),
            "policy": (ask_policy, None),
        }
    )
    return Times(times["actions"], times["policy"])


def forward_and_backward(model: TRPOGAE) -> None:
    """What one step of plain gradient descent costs: the unit for the parts of an update."""
    buffer = model.rollout_buffer
    samples = buffer.batch()
    values, log_prob, _ = model.policy.evaluate_actions(samples.observations, samples.actions)
    loss = (standardized(samples.advantages) * log_prob).mean() + (values.flatten() - samples.returns).square().mean()
    th.autograd.grad(loss, [parameter for parameter in model.policy.parameters() if parameter.requires_grad])


def least_seconds(actions: dict[str, tuple[Callable[[], object], Callable[[], None] | None]]) -> dict[str, float]:
    """
    :param actions: what to time, and what puts things back before it
    :return: the least time of each in rounds of all of them, in seconds; noise only ever adds to it. They are the
        processor's, of all threads, since a busy machine would add its waiting to every round of what takes long
    """
    least = dict.fromkeys(actions, np.inf)
    for _ in range(ROUNDS):
        for name, (action, before) in actions.items():
            if before is not None:
                before()
            start = time.process_time()
            action()
            least[name] = min(least[name], time.process_time() - start)
    return least
