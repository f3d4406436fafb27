"""
How fast whole iterations are, rollout and update together, beside sb3-contrib's TRPO and beside the physics alone.

    python benchmarks/rollout_speed.py                   # the biped, HalfCheetah-v5 and Humanoid-v5, half an hour
    python benchmarks/rollout_speed.py --tasks GaeBiped-v0
    python benchmarks/rollout_speed.py --memory          # only the memory that a batch of 200 000 quadruped steps takes

One process, batches of 50 000 steps, networks 100-50-25 and running normalization of observations for both; the two
and the physics in turn, round by round. sb3-contrib's TRPO has its defaults otherwise and steps gymnasium
environments in a DummyVecEnv: it is run with several numbers of them, and its fastest counts.
"""

import argparse
import functools
import subprocess
import sys
import time
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import torch as th
from mujoco.rollout import Rollout
from sb3_contrib import TRPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_gae import TRPOGAE, MujocoVecEnv
from sb3_gae.presets import LOCOMOTION_NETWORKS
from sb3_gae.rollout.collection import ActionSampler
from sb3_gae.vec_env.choice import batched_vec_env

BATCH = 50_000
PEER_ENVS = (2, 8, 16, 32)
# Open-loop physics in pieces this long, so that most bodies are still up, as they are in training
OPEN_LOOP_STEPS = 49


class Task(NamedTuple):
    """
    :param env: id
    :param n_envs: that we step at once
    :param end_to_end: times sb3-contrib's speed that we aim at
    :param of_physics: part of the physics' own speed that we aim at
    :param whole_iteration: whether that is of the whole iteration, or of the rollout alone
    """

    env: str
    n_envs: int
    end_to_end: float
    of_physics: float
    whole_iteration: bool


TASKS = (
    Task("GaeBiped-v0", 256, 10.0, 0.25, True),
    Task("HalfCheetah-v5", 256, 4.0, 0.6, False),
    Task("Humanoid-v5", 64, 1.5, 0.8, False),
)


class Meter:
    """Adds up the time spent in calls of some methods of some objects."""

    def __init__(self) -> None:
        self.seconds = 0.0

    def watch(self, owner: Any, *names: str) -> None:
        for name in names:
            setattr(owner, name, self._timed(getattr(owner, name)))

    def _timed(self, call: Callable) -> Callable:
        @functools.wraps(call)
        def timed(*args: Any, **kwargs: Any) -> Any:
            start = time.perf_counter()
            try:
                return call(*args, **kwargs)
            finally:
                self.seconds += time.perf_counter() - start

        return timed


class Nothing(BaseCallback):
    def _on_step(self) -> bool:
        return True


class Learner:
    """One algorithm and the times of its iterations, in seconds, the first of them to warm up."""

    def __init__(self, model: OnPolicyAlgorithm):
        self.model = model
        self.rollouts: list[float] = []
        self.updates: list[float] = []
        _, self._callback = model._setup_learn(10**9, Nothing())
        self._callback.on_training_start(locals(), globals())

    @property
    def wholes(self) -> list[float]:
        return [rollout + update for rollout, update in zip(self.rollouts, self.updates, strict=True)]

    def collect(self) -> None:
        model = self.model
        assert model.env is not None
        model.collect_rollouts(model.env, self._callback, model.rollout_buffer, model.n_steps)

    def iterate(self) -> None:
        start = time.perf_counter()
        self.collect()
        collected = time.perf_counter()
        self.model.train()
        self.rollouts.append(collected - start)
        self.updates.append(time.perf_counter() - collected)


def make_learner(algorithm: type[OnPolicyAlgorithm], task: str, n_envs: int, batch: int = BATCH, **env_kwargs: Any) -> Learner:
    env = VecNormalize(make_vec_env(task, n_envs, seed=0, **env_kwargs), norm_reward=False)
    kwargs = {"n_steps": -(-batch // n_envs), "policy_kwargs": LOCOMOTION_NETWORKS, "seed": 0, "device": "cpu"}
    return Learner(algorithm("MlpPolicy", env, gamma=0.995, gae_lambda=0.97, **kwargs))  # type: ignore[call-arg]


def open_loop(env: MujocoVecEnv, n_steps: int) -> Callable[[], None]:
    """:return: takes so many steps of the physics alone, on the same model and threads, under random controls"""
    task, n_envs = env.task, env.num_envs
    env.reset()
    states, rng = env._physics.copy(), np.random.default_rng(0)
    bounds = task.model.actuator_ctrlrange
    controls = rng.uniform(bounds[:, 0], bounds[:, 1], (n_envs, OPEN_LOOP_STEPS * task.frame_skip, task.model.nu))
    pool = Rollout(nthread=env.n_threads if env.n_threads > 1 else 0)
    pieces, rest = divmod(n_steps, OPEN_LOOP_STEPS)
    controls_of_pieces = [controls] * pieces + ([controls[:, : rest * task.frame_skip].copy()] if rest else [])

    def steps() -> None:
        for piece in controls_of_pieces:
            pool.rollout([task.model] * n_envs, env._datas, states, piece)

    return steps


def random_actions(task: str, n_envs: int, n_threads: int, n_steps: int) -> Callable[[], None]:
    """:return: takes so many steps of EnvPool itself under random actions"""
    import envpool

    pool = envpool.make_gymnasium(task, num_envs=n_envs, num_threads=n_threads)
    pool.reset()
    space = gym.make(task).action_space
    actions = np.stack([space.sample() for _ in range(n_envs)]).astype(np.float64)

    def steps() -> None:
        for step in range(n_steps):
            pool.step(np.roll(actions, step, axis=0))

    return steps


def rate(steps: Callable[[], None], n_steps: int) -> float:
    """:return: how many of the steps are taken in a second"""
    start = time.perf_counter()
    steps()
    return n_steps / (time.perf_counter() - start)


def physics_alone(env: VecEnv, task: str, n_steps: int) -> Callable[[], None]:
    """:return: takes so many steps of each environment of a batch, without all that is around the physics"""
    base: Any = env.unwrapped
    if isinstance(base, MujocoVecEnv):
        return open_loop(base, n_steps)
    return random_actions(task, base.num_envs, base.n_threads, n_steps)


def physics_of(env: VecEnv) -> tuple[Any, tuple[str, ...]]:
    """:return: the object whose native calls are the physics, and their names"""
    base = env.unwrapped
    return (base._pool, ("rollout",)) if isinstance(base, MujocoVecEnv) else (base._pool, ("send", "recv"))


def compare(task: Task, rounds: int) -> bool:
    ours = make_learner(TRPOGAE, task.env, task.n_envs, vec_env_cls=batched_vec_env)
    peers = {n_envs: make_learner(TRPO, task.env, n_envs) for n_envs in PEER_ENVS}
    assert ours.model.env is not None
    n_steps = -(-BATCH // task.n_envs)
    limit = physics_alone(make_vec_env(task.env, task.n_envs, seed=0, vec_env_cls=batched_vec_env), task.env, n_steps)
    physics, policy = Meter(), Meter()
    owner, names = physics_of(ours.model.env)
    physics.watch(owner, *names)
    policy.watch(ActionSampler, "__call__")
    policy.watch(ours.model.policy, "evaluate_actions", "predict_values")
    limits, shares = [], []
    for _ in range(rounds + 1):
        limits.append(rate(limit, n_steps * task.n_envs))
        physics.seconds = policy.seconds = 0.0
        ours.iterate()
        in_policy = policy.seconds
        shares.append((physics.seconds, in_policy))
        for peer in peers.values():
            peer.iterate()
    return report(task, ours, peers, limits[1:], shares[1:])


def report(
    task: Task, ours: Learner, peers: dict[int, Learner], limits: Sequence[float], shares: Sequence[tuple[float, float]]
) -> bool:
    n_steps = ours.model.n_steps * task.n_envs
    best = min(peers, key=lambda n_envs: median(peers[n_envs].wholes[1:]))
    ratios = [theirs / own for own, theirs in zip(ours.wholes[1:], peers[best].wholes[1:], strict=True)]
    spent = ours.wholes[1:] if task.whole_iteration else ours.rollouts[1:]
    parts = [n_steps / seconds / rate for seconds, rate in zip(spent, limits, strict=True)]
    print(f"\n{task.env}, batches of {BATCH} steps, {len(limits)} rounds after one to warm up")
    physics, policy = (median(share[i] for share in shares) for i in range(2))
    rollout, update = median(ours.rollouts[1:]), median(ours.updates[1:])
    print(
        f"  sb3_gae      {task.n_envs:3d} envs  {n_steps / (rollout + update):8.0f} steps/s   rollout {rollout:6.2f} s "
        f"(physics {physics:.2f}, policy {policy:.2f}, bookkeeping {rollout - physics - policy:.2f}), update {update:5.2f} s"
    )
    for n_envs, peer in peers.items():
        rollout, update = median(peer.rollouts[1:]), median(peer.updates[1:])
        speed = peer.model.n_steps * n_envs / (rollout + update)
        print(f"  sb3_contrib  {n_envs:3d} envs  {speed:8.0f} steps/s   rollout {rollout:6.2f} s, update {update:5.2f} s")
    print(f"  physics alone          {median(limits):8.0f} steps/s")
    what = "iteration" if task.whole_iteration else "rollout"
    met = [
        verdict(f"speed over sb3-contrib's best ({best} envs)", ratios, task.end_to_end),
        verdict(f"speed of the {what} as a part of the physics'", parts, task.of_physics),
    ]
    return all(met)


def verdict(what: str, ratios: Sequence[float], target: float) -> bool:
    met = median(ratios) >= target
    print(
        f"  {what}: {median(ratios):.2f} (from {min(ratios):.2f} to {max(ratios):.2f}), "
        f"target {target:g}: {'met' if met else 'MISSED'}"
    )
    return met


def memory(limit_mib: float = 2048.0) -> bool:
    """Peak of a process that trains the quadruped for two iterations of 200 000 steps."""
    measured = subprocess.run([sys.executable, __file__, "--memory-here"], check=True, capture_output=True, text=True).stdout
    met = float(measured) < limit_mib
    print(
        f"\nGaeQuadruped-v0, batches of 200 000 steps: peak {float(measured):.0f} MiB, target below {limit_mib:.0f}: ", end=""
    )
    print("met" if met else "MISSED")
    return met


def memory_here() -> None:
    learner = make_learner(TRPOGAE, "GaeQuadruped-v0", 256, 200_000, vec_env_cls=batched_vec_env)
    for _ in range(2):
        learner.iterate()
    # Linux only
    (line,) = (line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM"))
    print(int(line.split()[1]) / 1024)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", choices=[task.env for task in TASKS], default=[task.env for task in TASKS])
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--memory", action="store_true", help="only the memory")
    parser.add_argument("--memory-here", action="store_true", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.memory_here:
        memory_here()
        return
    # sb3-contrib's, of a last minibatch that is smaller
    warnings.filterwarnings("ignore", message="You have specified a mini-batch size")
    print(f"Python {sys.version.split()[0]}, torch {th.__version__}, {th.get_num_threads()} threads")
    met = [] if args.memory else [compare(task, args.rounds) for task in TASKS if task.env in args.tasks]
    met.append(memory())
    sys.exit(not all(met))


if __name__ == "__main__":
    main()
