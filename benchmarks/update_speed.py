"""
How long an update takes beside sb3-contrib's, and a grid of advantages beside one pass of SB3's.

    python benchmarks/update_speed.py            # the two ratios, a few minutes
    python benchmarks/update_speed.py --memory   # also the peak memory of the update at four batch sizes

One process, the same rollout and the same initial weights for both, the two in turn round by round.
The task is a set of noisy oscillators with 33 observed variables and 10 actions, the shape of the paper's biped;
the networks are the paper's 100-50-25.
"""

import argparse
import copy
import json
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from sb3_contrib import TRPO
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from sb3_gae import TRPOGAE, GAERolloutBuffer
from sb3_gae.estimators.measures import explained_variance
from sb3_gae.presets import LOCOMOTION_NETWORKS

N_ENVS = 16
N_STATES, N_ACTIONS = 33, 10
GAMMAS = np.array([0.9, 0.95, 0.97, 0.98, 0.99, 0.995, 0.999, 1.0])
LAMBDAS = np.array([0.0, 0.2, 0.4, 0.6, 0.7, 0.8, 0.9, 0.92, 0.95, 0.97, 0.99, 1.0])


class NoisyOscillators(gym.Env):
    """
    Slow noisy oscillators that the actions push; the reward depends on the first few, so that there is a value to learn.

    Ends when those are far off, or after 500 steps.
    """

    observation_space = gym.spaces.Box(-np.inf, np.inf, (N_STATES,), np.float32)
    action_space = gym.spaces.Box(-1.0, 1.0, (N_ACTIONS,), np.float32)

    def __init__(self) -> None:
        system = np.random.default_rng(0)
        self._phase = 0.995 * np.exp(1j * system.uniform(0.01, 0.1, N_STATES // 2 + 1))
        self._control = 0.02 * system.normal(size=(len(self._phase), N_ACTIONS))

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        self._state, self._time = self._noise(1.0), 0
        return self._observation(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        self._state = self._phase * self._state + self._control @ action + self._noise(0.1)
        self._time += 1
        near = self._state[:3].real
        return (
            self._observation(),
            float(1.0 + near[0] - near[1] * near[2]),
            bool(abs(near).max() > 4.0),
            self._time >= 500,
            {},
        )

    def _noise(self, scale: float) -> np.ndarray:
        return scale * (self.np_random.normal(size=(len(self._phase), 2)) @ [1.0, 1.0j])

    def _observation(self) -> np.ndarray:
        return np.concatenate([self._state.real, self._state.imag])[:N_STATES].astype(np.float32)


def ours(batch_size: int, networks: dict[str, Any] = LOCOMOTION_NETWORKS, seed: int = 0) -> TRPOGAE:
    """A model that has collected one rollout and not yet learned from it."""
    env = make_vec_env(NoisyOscillators, N_ENVS, seed=seed)
    model = TRPOGAE("MlpPolicy", env, n_steps=batch_size // N_ENVS, policy_kwargs=networks, seed=seed, device="cpu")
    _, callback = model._setup_learn(batch_size)
    callback.on_training_start(locals(), globals())
    model.collect_rollouts(env, callback, model.rollout_buffer, model.n_steps)
    return model


def theirs(model: TRPOGAE, **settings: Any) -> TRPO:
    """sb3-contrib's TRPO with its defaults but for some settings, the same weights and the same rollout."""
    networks = dict(model.policy_kwargs)
    peer = TRPO("MlpPolicy", model.env, n_steps=model.n_steps, policy_kwargs=networks, seed=0, device="cpu", **settings)
    weights = model.policy.state_dict()
    peer.policy.load_state_dict({name: weights[name] for name in peer.policy.state_dict()})
    peer.set_logger(model.logger)
    for name in ("observations", "actions", "rewards", "values", "log_probs", "advantages", "returns"):
        setattr(peer.rollout_buffer, name, getattr(model.rollout_buffer, name).copy())
    peer.rollout_buffer.full = True
    return peer


class Update:
    """Repeats one model's update from the same start."""

    def __init__(self, model: OnPolicyAlgorithm):
        self.model = model
        self._start = copy.deepcopy(model.get_parameters())
        self._rollout_buffer = copy.deepcopy(model.rollout_buffer)

    def __call__(self) -> None:
        self.model.train()

    def rewind(self) -> None:
        self.model.set_parameters(self._start)
        self.model.rollout_buffer = copy.deepcopy(self._rollout_buffer)


def explained(model: OnPolicyAlgorithm, observations: np.ndarray, returns: np.ndarray) -> float:
    with th.no_grad():
        values = model.policy.predict_values(th.as_tensor(observations.reshape(-1, N_STATES))).flatten().numpy()
    return explained_variance(values, returns.flatten())


def seconds(action: Callable[[], object]) -> float:
    start = time.perf_counter()
    action()
    return time.perf_counter() - start


def compare_updates(batch_size: int, rounds: int) -> None:
    model = ours(batch_size)
    updates = {"sb3_gae": Update(model), "sb3_contrib": Update(theirs(model))}
    held_out = copy.deepcopy(model)
    held_out.set_random_seed(1)
    _, callback = held_out._setup_learn(batch_size)
    held_out.collect_rollouts(held_out.env, callback, held_out.rollout_buffer, held_out.n_steps)
    seen, unseen = model.rollout_buffer, held_out.rollout_buffer
    times: dict[str, list[float]] = {name: [] for name in updates}
    fits: dict[str, tuple[float, float]] = {}
    for _ in range(rounds + 1):
        for name, update in updates.items():
            update.rewind()
            times[name].append(seconds(update))
            of = update.model
            fits[name] = (
                explained(of, seen.observations, seen.returns),
                explained(of, unseen.observations, unseen.returns),
            )
    ratios = [b / a for a, b in zip(times["sb3_gae"][1:], times["sb3_contrib"][1:], strict=True)]
    print(f"One update, batch {batch_size} x {N_STATES}, {rounds} rounds after one to warm up")
    for name in updates:
        on_batch, on_held_out = fits[name]
        print(
            f"  {name:<12} median {statistics.median(times[name][1:]):6.3f} s   explained variance after the fit:"
            f" {on_batch:.3f} on the batch, {on_held_out:.3f} on another rollout"
        )
    print(f"  ratio        median {statistics.median(ratios):6.1f}     (from {min(ratios):.1f} to {max(ratios):.1f})")


def random_rollout(kind: type[RolloutBuffer], batch_size: int, n_envs: int) -> RolloutBuffer:
    """A full buffer of that kind, the same rewards and values in each, with its advantages computed."""
    spaces = NoisyOscillators.observation_space, NoisyOscillators.action_space
    rng, shape = np.random.default_rng(0), (batch_size // n_envs, n_envs)
    buffer = kind(shape[0], *spaces, device="cpu", n_envs=n_envs)
    for name in ("rewards", "values"):
        setattr(buffer, name, rng.normal(size=shape).astype(np.float32))
    buffer.episode_starts = (rng.random(shape) < 0.005).astype(np.float32)
    buffer.full = True
    compute_advantages(buffer)
    return buffer


def compute_advantages(buffer: RolloutBuffer) -> None:
    """One pass over a full buffer."""
    buffer.compute_returns_and_advantage(th.zeros(buffer.n_envs), np.zeros(buffer.n_envs, dtype=bool))


def compare_advantages(batch_size: int, rounds: int) -> None:
    n_steps = batch_size // N_ENVS
    plain, kept_apart = (random_rollout(kind, batch_size, N_ENVS) for kind in (RolloutBuffer, GAERolloutBuffer))
    single, grid = [], []
    for _ in range(rounds + 1):
        single.append(seconds(lambda: compute_advantages(plain)))
        grid.append(seconds(lambda: kept_apart.advantage_grid(GAMMAS, LAMBDAS)))
    ratios = [b / a for a, b in zip(single[1:], grid[1:], strict=True)]
    print(f"Advantages, {n_steps} steps of {N_ENVS} environments, {rounds} rounds after one to warm up")
    print(f"  one pass of SB3's buffer          median {1e3 * statistics.median(single[1:]):6.1f} ms")
    print(f"  grid of {len(GAMMAS)} gammas x {len(LAMBDAS)} lambdas      median {1e3 * statistics.median(grid[1:]):6.1f} ms")
    print(f"  ratio                             median {statistics.median(ratios):6.2f}    (up to {max(ratios):.2f})")


def peak_memory() -> None:
    """Peak resident memory that an update adds, each batch size in a process of its own."""
    print("Peak memory that an update adds to the process after the rollout")
    for batch_size in (25_000, 50_000, 100_000, 200_000):
        command = [sys.executable, __file__, "--memory-of", str(batch_size)]
        added = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
        print(f"  batch {batch_size:>7}: {added / 2**20:7.0f} MiB = {added / batch_size / 2**10:.2f} KiB a sample")


def memory_of_update(batch_size: int) -> None:
    model = ours(batch_size)
    # Linux only: forget the peak of the rollout
    Path("/proc/self/clear_refs").write_text("5")
    before = resident_kib("VmRSS")
    model.train()
    print(1024 * (resident_kib("VmHWM") - before))


def resident_kib(name: str) -> int:
    (line,) = (line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith(name))
    return int(line.split()[1])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--batch-size", type=int, default=50_000)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--memory", action="store_true", help="also measure peak memory")
    parser.add_argument("--memory-of", type=int, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.memory_of:
        memory_of_update(args.memory_of)
        return
    print(f"Python {sys.version.split()[0]}, torch {th.__version__}, {th.get_num_threads()} threads")
    compare_updates(args.batch_size, args.rounds)
    compare_advantages(args.batch_size, 20)
    if args.memory:
        peak_memory()


if __name__ == "__main__":
    main()
