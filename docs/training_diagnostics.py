"""
Measures training runs at several checkpoints: bias and variance of the policy gradient for each λ, its response by delay,
statistics of the advantages, and the errors of several value functions. About twenty minutes of one core.

    python docs/training_diagnostics.py                                # every run that is not stored yet
    python docs/training_diagnostics.py --tasks GaeCartPole-v0 --seeds 0

A run is trained with the shipped settings. At a checkpoint, policy and observation statistics are frozen and many
further rollouts are played. Products of groups of environments over *all* of these give sharper estimates than the mean of
an estimate a rollout: their noise falls with the number of rollouts and not with its root.

A line for each checkpoint is appended to benchmarks/results/training_diagnostics.jsonl; checkpoints that are stored are not
measured again. docs/training_figures.py and docs/value_errors.py draw from that file.
"""

import argparse
import copy
import itertools
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.utils import safe_mean

from sb3_gae import TRPOGAE, GAERolloutBuffer
from sb3_gae.diagnostics.policy_gradients import policy_gradients
from sb3_gae.estimators.advantages import discounted_returns, td_residuals
from sb3_gae.estimators.group_statistics import Estimate, mean_variance, squared_norm
from sb3_gae.estimators.measures import value_errors
from sb3_gae.estimators.response import lagged_signal
from sb3_gae.presets import PAPER_LAMBDAS
from sb3_gae.rollout.evaluation import training_batch
from sb3_gae.sweep.experiment import Experiment
from sb3_gae.sweep.grid import Cell
from sb3_gae.sweep.plan import Options
from sb3_gae.update.policy_step import policy_parameters

RESULTS = Path(__file__).parents[1] / "benchmarks" / "results" / "training_diagnostics.jsonl"
N_GROUPS = 16
# From the seeds of training to those of measuring
SEED_OFFSET = 10_000

State = dict[str, th.Tensor]
Result = dict[str, Any]


class Task(NamedTuple):
    """
    What is trained, and how it is measured.

    :param gamma: of the shipped settings
    :param gae_lambda: likewise
    :param checkpoints: iterations after which to measure, ascending
    :param seeds: of the runs
    :param batch: of training, in units of what the gradient of a measured rollout comes from: part of its counted steps
    :param n_envs: of a measured rollout
    :param n_steps: likewise
    :param lookahead: the last so many steps do not count, since λ = 1 relies on the value function where a time limit
        or the end of the rollout cuts an episode
    :param n_rollouts: that are measured
    :param lags: delays of the response, in steps
    """

    gamma: float
    gae_lambda: float
    checkpoints: tuple[int, ...]
    seeds: tuple[int, ...]
    batch: float
    n_envs: int
    n_steps: int
    lookahead: int
    n_rollouts: int
    lags: tuple[int, ...]


TASKS = {
    # Batches of 20 whole episodes of at most 1 000 steps
    "GaeCartPole-v0": Task(
        0.99, 0.96, (1, 3, 6, 10, 15, 20, 30), (0, 1, 2), 20 / 128, 128, 1000, 400, 12,
        (0, 1, 2, 3, 5, 8, 12, 20, 30, 50, 80, 120),
    ),
    # Episodes of 200 steps
    "Pendulum-v1": Task(
        0.9, 0.95, (5, 20, 50, 97), (0, 1, 2), 1024 / (64 * 160), 64, 200, 40, 20,
        (0, 1, 2, 3, 4, 6, 8, 10, 13, 16, 20, 30),
    ),
    # Batches of 196 steps of 256 environments
    "GaeBiped-v0": Task(
        0.995, 0.97, (5, 20, 60), (0, 1), 196 / 500, 256, 1000, 500, 4,
        (0, 1, 2, 3, 5, 8, 12, 20, 30, 50, 80, 120),
    ),
}  # fmt: skip


# --- Training ---


class Checkpoint(NamedTuple):
    """
    :param iteration: how many updates
    :param policy: parameters of policy and value function
    :param normalization: statistics of the observations, None where they are not normalised
    :param mean_return: of the last 100 episodes of training, not a number if none has ended
    """

    iteration: int
    policy: State
    normalization: Any
    mean_return: float


def checkpoint(model: TRPOGAE, iteration: int) -> Checkpoint:
    normalize = model.get_vec_normalize_env()
    statistics = None if normalize is None else copy.deepcopy(normalize.obs_rms)
    mean_return = float(safe_mean([episode["r"] for episode in model.ep_info_buffer or ()]))
    return Checkpoint(iteration, copy.deepcopy(model.policy.state_dict()), statistics, mean_return)


def train(env: str, task: Task, seed: int) -> list[Checkpoint]:
    """:return: the beginning, and the task's checkpoints"""
    cell = Cell(env, "trust_region", task.gamma, task.gae_lambda, seed, task.checkpoints[-1])
    experiment = Experiment(cell, Options(device="cpu"))
    found = [checkpoint(experiment.model, 0)]

    def on_row(row: dict[str, float]) -> None:
        if row["iteration"] in task.checkpoints:
            found.append(checkpoint(experiment.model, int(row["iteration"])))

    experiment.run(on_row)
    return found


# --- Rollouts of a frozen policy ---


class Player:
    """Environments of their own, which do not disturb those of training, and a model to load checkpoints into."""

    def __init__(self, env: str, task: Task, seed: int):
        sizes = json.dumps({"n_envs": task.n_envs, "n_steps": task.n_steps})
        cell = Cell(env, "trust_region", task.gamma, task.gae_lambda, SEED_OFFSET + seed, 1, sizes)
        self.task = task
        self.model = Experiment(cell, Options(device="cpu")).model
        self._callback: BaseCallback = self.model._setup_learn(1, None)[1]

    def load(self, frozen: Checkpoint) -> None:
        self.model.policy.load_state_dict(frozen.policy)
        normalize = self.model.get_vec_normalize_env()
        if normalize is not None:
            normalize.training, normalize.obs_rms = False, copy.deepcopy(frozen.normalization)
        assert self.model.env is not None
        self.model._last_obs = self.model.env.reset()  # type: ignore[assignment]
        self.model._last_episode_starts = np.ones(self.model.n_envs, dtype=bool)

    def rollouts(self, count: int) -> Iterator[GAERolloutBuffer]:
        model = self.model
        for _ in range(count):
            model.collect_rollouts(model.env, self._callback, model.rollout_buffer, model.n_steps)  # type: ignore[arg-type]
            yield model.rollout_buffer

    def close(self) -> None:
        assert self.model.env is not None
        self.model.env.close()

    def evaluate(self, value_function: State) -> None:
        """Values and advantages of the last rollout by another value function."""
        self.model.policy.load_state_dict(value_function)
        self.model._estimate_advantages(self.model.rollout_buffer)

    def counted(self, buffer: GAERolloutBuffer) -> np.ndarray:
        """Which steps the measurements are taken over, shape (T, N)."""
        early = np.arange(len(buffer.mask)) < self.task.n_steps - self.task.lookahead
        return buffer.mask & early[:, None]


def value_functions(player: Player, frozen: Checkpoint, before: Checkpoint) -> dict[str, State]:
    """
    Wrong in different ways; the policy is that of the checkpoint in all of them.

    :return: ``own``, the one that training goes on with; ``refitted`` on two further rollouts; that of the ``earlier``
        checkpoint; ``half`` of the own; ``zero``; and the own with an ``offset`` of one deviation of the returns
    """
    own, model = frozen.policy, player.model
    for buffer in player.rollouts(2):
        deviation = returns_of(buffer)[player.counted(buffer)].std()
        batch = training_batch(buffer, model.action_space)
        parameters = model._parameter_groups(batch)
        for _ in range(2):
            model._fit_value(batch, parameters)
    refitted = copy.deepcopy(model.policy.state_dict())
    weight, bias, scale = (own[f"value_net.{name}"] for name in ("weight", "bias", "scale"))
    return {
        "own": own,
        "refitted": own | of_value_function(refitted),
        "earlier": own | of_value_function(before.policy),
        "half": own | {"value_net.weight": weight / 2, "value_net.bias": bias / 2},
        "zero": own | {"value_net.weight": 0 * weight, "value_net.bias": 0 * bias},
        "offset": own | {"value_net.bias": bias + float(deviation) / scale},
    }


def of_value_function(policy: State) -> State:
    return {name: tensor for name, tensor in policy.items() if "value_net" in name}


# --- Measurements ---


def measure(player: Player, frozen: Checkpoint, before: Checkpoint) -> Result:
    """:return: everything that is stored of a checkpoint; numbers of gradients are those of one training batch"""
    task = player.task
    player.load(frozen)
    functions = value_functions(player, frozen, before)
    player.load(frozen)
    gradients, errors = {name: Sums() for name in functions}, {name: Means() for name in functions}
    response, advantages = Sums(), Means()
    for buffer in player.rollouts(task.n_rollouts):
        counted = player.counted(buffer)
        for name, function in functions.items():
            player.evaluate(function)
            grid = buffer.advantage_grid([task.gamma], PAPER_LAMBDAS)[0]
            gradients[name].add(player.model, buffer, grid, counted)
            errors[name].add(errors_of_values(buffer, counted))
            if name == "own":
                advantages.add(advantage_statistics(grid[:, counted].astype(np.float64)))
                response.add(player.model, buffer, delayed_signals(buffer, task.lags), counted)
    # Unbiased with any value function, and the less noisy the better that is
    truth = gradients["refitted"].sums[:, -1:]
    delayed = squared_norm(response.sums, response.steps)
    n_lags, batches = len(task.lags), task.n_rollouts / task.batch
    return {
        "iteration": frozen.iteration,
        "mean_return": frozen.mean_return,
        "counted_steps": int(response.steps.sum()),
        "squared_gradient": pair(Estimate(*(each[0] for each in squared_norm(truth, response.steps)))),
        "advantages": advantages.mean(),
        "lags": task.lags,
        "response_of_rewards": pair(Estimate(*(each[:n_lags] for each in delayed))),
        "response_of_shaped_rewards": pair(Estimate(*(each[n_lags:] for each in delayed))),
        "value_functions": {
            name: errors[name].mean() | errors_of_gradient(each, truth, batches) for name, each in gradients.items()
        },
    }


class Sums:
    """Policy gradients summed over the same groups of environments in several rollouts."""

    def __init__(self) -> None:
        self.sums: np.ndarray = np.zeros(())
        self.steps: np.ndarray = np.zeros(())

    def add(self, model: TRPOGAE, buffer: GAERolloutBuffer, signals: np.ndarray, counted: np.ndarray) -> None:
        """:param signals: what the scores are weighted with, shape (K, T, N)"""
        groups = np.where(counted, np.arange(buffer.n_envs) % N_GROUPS, -1)[buffer.mask]
        batch = training_batch(buffer, model.action_space)
        parameters = policy_parameters(model.policy, batch)
        signals = np.ascontiguousarray(signals[:, buffer.mask])
        sums = policy_gradients(model.policy, parameters, batch.observations, batch.actions, signals, groups)
        self.sums = self.sums + sums
        self.steps = self.steps + np.bincount(groups[groups >= 0], minlength=N_GROUPS)


class Means:
    """Means of dictionaries of numbers or lists."""

    def __init__(self) -> None:
        self._rows: list[dict[str, Any]] = []

    def add(self, row: dict[str, Any]) -> None:
        self._rows.append(row)

    def mean(self) -> dict[str, Any]:
        return {name: np.mean([row[name] for row in self._rows], axis=0) for name in self._rows[0]}


def errors_of_gradient(gradients: Sums, truth: np.ndarray, batches: float) -> Result:
    """
    The bias is that against λ = 1, with this value function or the better one, whichever difference is less noisy.

    :param truth: sums of the gradient with λ = 1 and the better value function, shape (G, 1, P)
    :param batches: training batches that all the rollouts amount to
    """
    sums, steps = gradients.sums, gradients.steps
    differences = sums - sums[:, -1:], sums - truth
    noise = [mean_variance(each, steps).value for each in differences]
    bias_squared, variance = (
        squared_norm(np.where((noise[0] <= noise[1])[:, None], *differences), steps),
        mean_variance(sums, steps),
    )
    return {
        "bias_squared": pair(bias_squared),
        "variance": pair(Estimate(batches * variance.value, batches * variance.standard_error)),
    }


def errors_of_values(buffer: GAERolloutBuffer, counted: np.ndarray) -> dict[str, Any]:
    arrays = buffer.rewards, buffer.values, buffer.next_values, buffer.dones, buffer.gamma
    return value_errors(*arrays, mask=counted)._asdict() | {"return_variance": returns_of(buffer)[counted].var()}


def returns_of(buffer: GAERolloutBuffer) -> np.ndarray:
    return discounted_returns(buffer.rewards, buffer.next_values, buffer.dones, buffer.gamma).astype(np.float64)


def advantage_statistics(advantages: np.ndarray) -> dict[str, Any]:
    """:param advantages: of each λ, the last being 1, shape (L, B)"""
    difference = advantages - advantages[-1]
    return {
        "mean_difference": difference.mean(axis=1),
        "rms_difference": np.sqrt(np.square(difference).mean(axis=1)),
        "deviation": advantages.std(axis=1),
    }


def delayed_signals(buffer: GAERolloutBuffer, lags: tuple[int, ...]) -> np.ndarray:
    """:return: rewards, then residuals, as each step sees them so much later, shape (2 L, T, N)"""
    deltas = td_residuals(buffer.rewards, buffer.values, buffer.next_values, buffer.gamma)
    signals = (
        lagged_signal(each, buffer.dones, max(lags) + 1, buffer.mask)[0][list(lags)] for each in (buffer.rewards, deltas)
    )
    return np.concatenate(list(signals))


# --- Storage ---


def pair(estimate: Estimate) -> list[Any]:
    return [estimate.value, estimate.standard_error]


def short(item: Any) -> Any:
    """Fit for JSON, with four digits."""
    if isinstance(item, dict):
        return {name: short(each) for name, each in item.items()}
    if isinstance(item, str | int):
        return item
    if np.ndim(item):
        return [short(each) for each in item]
    return float(f"{float(item):.4g}") if np.isfinite(item) else None


def stored(path: Path = RESULTS) -> list[Result]:
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def measure_run(env: str, task: Task, seed: int, path: Path = RESULTS) -> None:
    """Train, and measure the checkpoints that are not stored yet."""
    known = {row["iteration"] for row in stored(path) if (row["env"], row["seed"]) == (env, seed)}
    if known >= set(task.checkpoints):
        return
    checkpoints, player = train(env, task, seed), Player(env, task, seed)
    for before, frozen in itertools.pairwise(checkpoints):
        if frozen.iteration not in known:
            row = {"env": env, "seed": seed} | measure(player, frozen, before)
            with path.open("a") as file:
                file.write(json.dumps(short(row)) + "\n")
            print(f"{env}, seed {seed}, iteration {frozen.iteration}", flush=True)
    player.close()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", choices=list(TASKS), default=list(TASKS))
    parser.add_argument("--seeds", nargs="+", type=int, help="other than each task's own")
    args = parser.parse_args()
    th.set_num_threads(1)
    RESULTS.parent.mkdir(exist_ok=True)
    for env in args.tasks:
        for seed in args.seeds or TASKS[env].seeds:
            measure_run(env, TASKS[env], seed)


if __name__ == "__main__":
    main()
