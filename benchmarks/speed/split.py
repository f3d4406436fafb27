"""Where the seconds of one iteration go, by wrapping functions with timers in one run."""

from pathlib import Path
from statistics import median
from typing import Any

import torch as th
from stable_baselines3.common.vec_env import VecNormalize

from benchmarks.rollout_speed import Learner, make_learner, physics_of
from benchmarks.speed import results
from benchmarks.speed.iteration_cases import BIPED, CHEETAH, CHEETAH_ENVS, tasks
from benchmarks.speed.stopwatch import POLICY_STEP, ROLLOUT, UPDATE, VALUE_FIT, Section, Stopwatch
from sb3_gae import TRPOGAE, on_policy_algorithm
from sb3_gae.rollout import collection
from sb3_gae.rollout.collection import ActionSampler
from sb3_gae.update import trust_region
from sb3_gae.update.kronecker import KroneckerPreconditioner
from sb3_gae.update.policy_step import DenseFisher
from sb3_gae.update.value_step import _DenseValues
from sb3_gae.vec_env.choice import batched_vec_env

#: environments and steps of each, as in the shipped settings
SHAPES = {BIPED: (256, 196), CHEETAH: (CHEETAH_ENVS, 256)}
QUICK_SHAPES = {BIPED: (32, 16), CHEETAH: (CHEETAH_ENVS, 32)}


def watch(stopwatch: Stopwatch, learner: Learner) -> None:
    """
    Wrap what an iteration of the learner goes through.

    :param stopwatch: that times it
    :param learner: of ours, with normalised observations and environments that are stepped in batches
    """
    model: Any = learner.model
    env = model.env
    assert isinstance(env, VecNormalize)
    base: Any = env.unwrapped
    physics, calls = physics_of(base)
    stopwatch.watch(Section(ROLLOUT, "bookkeeping"), model, "collect_rollouts")
    stopwatch.watch(Section(ROLLOUT, "normalisation"), collection, "step_environments")
    stopwatch.watch(Section(ROLLOUT, "rewards and endings"), base, "step_async", "step_wait")
    stopwatch.watch(Section(ROLLOUT, "resets"), base, "_restart_envs")
    stopwatch.watch(Section(ROLLOUT, "physics"), physics, *calls)
    stopwatch.watch(Section(ROLLOUT, "policy"), ActionSampler, "__call__")
    stopwatch.watch(Section(ROLLOUT, "policy"), on_policy_algorithm, "evaluate_rollout")
    stopwatch.watch(Section(ROLLOUT, "advantages"), model, "_estimate_advantages")
    stopwatch.watch(Section(UPDATE, "other"), model, "train")
    stopwatch.watch(Section(POLICY_STEP, "gradient"), model, "_step_policy")
    stopwatch.watch(Section(VALUE_FIT, "gradient"), model, "_fit_value")
    # Of the policy step or of the value fit, whichever calls them
    stopwatch.watch(Section("", "curvature products"), DenseFisher, "__init__")
    stopwatch.watch(Section("", "curvature products"), _DenseValues, "curvature")
    stopwatch.watch(Section("", "curvature products"), trust_region, "_direction")
    stopwatch.watch(Section("", "preconditioner"), KroneckerPreconditioner, "__init__", "__call__")
    stopwatch.watch(Section("", "line search"), trust_region, "_line_search")


def split(task: str, n_envs: int, n_steps: int, threads: int, rounds: int) -> list[dict[str, Any]]:
    """
    :param task: id of the environment
    :param n_envs: environments that are stepped at once
    :param n_steps: of each of them in a rollout
    :param threads: of torch, and of the physics
    :param rounds: iterations, after one to warm up
    :return: a row for each section with its median seconds
    """
    th.set_num_threads(threads)
    env_kwargs: dict[str, Any] = {"vec_env_cls": batched_vec_env, "vec_env_kwargs": {"n_threads": threads}}
    learner = make_learner(TRPOGAE, task, n_envs, n_envs * n_steps, **env_kwargs)
    stopwatch, found = Stopwatch(), []
    watch(stopwatch, learner)
    try:
        for _ in range(rounds + 1):
            stopwatch.seconds.clear()
            learner.iterate()
            found.append(dict(stopwatch.seconds))
    finally:
        stopwatch.release()
    common = {"task": task, "batch": n_envs * n_steps, "rounds": rounds}
    sections = dict.fromkeys(section for times in found[1:] for section in times)
    return [
        common | section._asdict() | {"seconds": float(f"{median(times.get(section, 0.0) for times in found[1:]):.4g}")}
        for section in sections
    ]


def profile(output: Path, quick: bool, threads: int) -> None:
    """
    :param output: file of results, to be written
    :param quick: whether to do next to nothing
    :param threads: of torch, and of the physics
    """
    shapes = QUICK_SHAPES if quick else SHAPES
    rows = [row for task in tasks() for row in split(task, *shapes[task], threads, rounds=2 if quick else 9)]
    results.write(output, rows, quick=quick, threads=threads)
