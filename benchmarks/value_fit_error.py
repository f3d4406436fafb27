"""
What a value function knows about the batch that comes next, by how it was fitted to those before.

    python -m benchmarks.value_fit_error            # about five minutes on one core
    python -m benchmarks.value_fit_error --summary  # only the table, from the stored results

An agent learns with the shipped settings. Beside it other value functions that began as copies of its own are fitted to the
same batches, each in its way. Before each fit they are asked about the batch, which they have not seen: how much of the
variance of its λ-returns do they leave? And once more after it. The λ-returns are the agent's, for all of them.
What is stored in results/value_fit_error.csv is not run again.
"""

import copy
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import ActorCriticPolicy

from benchmarks.shipped_agent import shipped_agent
from benchmarks.stored_rows import measure, stored
from sb3_gae import TRPOGAE, GAERolloutBuffer
from sb3_gae.batch import TrainingBatch
from sb3_gae.estimators.measures import explained_variance
from sb3_gae.networks.value_head import ValueHead
from sb3_gae.rollout.evaluation import training_batch
from sb3_gae.update.adam_fit import adam_fit
from sb3_gae.update.policy_step import policy_parameters
from sb3_gae.update.trust_region import TrustRegionSettings
from sb3_gae.update.value_step import value_parameters, value_steps

RESULTS = Path(__file__).parent / "results" / "value_fit_error.csv"
COLUMNS = ["batch", "samples", "fit", "left_before", "left_after", "products"]
SEEDS = (100, 101)
#: with the number of batches
TASKS = {"HalfCheetah-v5": 40, "Hopper-v5": 40, "Walker2d-v5": 40, "Swimmer-v5": 40}
DAMPINGS = (0.01, 0.03, 0.1, 0.3, 1.0, 3.0)
#: those of TRPOGAE and of rl-zoo3's files for sb3-contrib's TRPO
TRUST_REGION = TrustRegionSettings(radius=0.2, cg_max_steps=10, cg_damping=0.01, cg_progress_tolerance=0.1, max_scale=1.0)
VALUE_STEPS = 5
ADAM = dict(n_epochs=20, batch_size=128)
ADAM_LEARNING_RATE = 1e-3


class Onlooker(NamedTuple):
    """A value function, and how it is fitted."""

    policy: ActorCriticPolicy
    fit: Callable[[ActorCriticPolicy, TrainingBatch, GAERolloutBuffer], int]


def one_damping(damping: float) -> Callable[..., int]:
    """Of all steps of a batch, in units of the error before the first: what is shipped, with ``vf_cg_damping`` a number."""

    def fit(policy: ActorCriticPolicy, batch: TrainingBatch, rollout_buffer: GAERolloutBuffer) -> int:
        settings = replace(TRUST_REGION, cg_damping=damping)
        steps = value_steps(policy, _parameters(policy, batch), batch, settings, VALUE_STEPS).steps
        return sum(step.cg_steps for step in steps)

    return fit


def damping_of_each_step(policy: ActorCriticPolicy, batch: TrainingBatch, rollout_buffer: GAERolloutBuffer) -> int:
    """0.01 in units of the error before each step, which every step makes less."""
    parameters = _parameters(policy, batch)
    fits = (value_steps(policy, parameters, batch, TRUST_REGION, 1) for _ in range(VALUE_STEPS))
    return sum(step.cg_steps for fit in fits for step in fit.steps)


def by_adam(policy: ActorCriticPolicy, batch: TrainingBatch, rollout_buffer: GAERolloutBuffer) -> int:
    adam_fit(policy, _parameters(policy, batch), rollout_buffer, **ADAM)
    return 0


def _parameters(policy: ActorCriticPolicy, batch: TrainingBatch) -> list[th.Tensor]:
    return value_parameters(policy, batch, policy_parameters(policy, batch))


FITS = {f"{damping:g}": one_damping(damping) for damping in DAMPINGS}
FITS |= {"0.01 of each step's own": damping_of_each_step, "Adam": by_adam}


class Onlookers(BaseCallback):
    """Fits its value functions to what the agent collects, and notes what they leave of it before and after."""

    def __init__(self) -> None:
        super().__init__()
        self.rows: list[dict[str, Any]] = []

    def _on_training_start(self) -> None:
        policy = cast(ActorCriticPolicy, self.model.policy)
        self.onlookers = {name: Onlooker(copy.deepcopy(policy), fit) for name, fit in FITS.items()}
        for group in self.onlookers["Adam"].policy.optimizer.param_groups:
            group["lr"] = ADAM_LEARNING_RATE

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        rollout_buffer = cast(TRPOGAE, self.model).rollout_buffer
        batch = training_batch(rollout_buffer, self.model.action_space)
        number = len(self.rows) // len(FITS)
        for name, (policy, fit) in self.onlookers.items():
            before = left(policy, batch)
            cast(ValueHead, policy.value_net).update_scale(batch.value_targets)
            products = fit(policy, batch, rollout_buffer)
            numbers = [number, len(batch), name, before, left(policy, batch), products]
            self.rows.append(dict(zip(COLUMNS, numbers, strict=True)))


def left(policy: ActorCriticPolicy, batch: TrainingBatch) -> float:
    """Part of the variance of the targets that the values leave."""
    with th.no_grad():
        values = policy.predict_values(batch.observations).flatten()
    return 1.0 - explained_variance(values.numpy(), batch.value_targets.numpy())


def rows_of(env_id: str, seed: int) -> Iterator[dict[str, Any]]:
    model, onlookers = shipped_agent(env_id, seed), Onlookers()
    model.learn(TASKS[env_id] * model.n_steps * model.n_envs, callback=onlookers)
    for row in onlookers.rows:
        yield {"env": env_id, "seed": seed} | row


def summary() -> str:
    """A table of medians over batches and seeds, the first quarter of the batches apart; after the fit in brackets."""
    rows, names = stored(RESULTS), list(FITS)
    lines = ["| task | batches | " + " | ".join(names) + " |", "| --- " * (len(names) + 2) + "|"]
    for env, n_batches in TASKS.items():
        for first, end in ((1, n_batches // 4), (n_batches // 4, n_batches)):
            among = [row for row in rows if row["env"] == env and first <= int(row["batch"]) < end]
            cells = [_medians([row for row in among if row["fit"] == name]) for name in names]
            lines.append(f"| {env} | {first + 1} to {end} | " + " | ".join(cells) + " |")
    products = [np.mean([float(row["products"]) for row in rows if row["fit"] == name] or [np.nan]) for name in names]
    lines.append("| products a batch | | " + " | ".join(f"{number:.0f}" if number else "" for number in products) + " |")
    return "\n".join(lines)


def _medians(rows: list[dict[str, str]]) -> str:
    if not rows:
        return ""
    before, after = (np.median([float(row[name]) for row in rows]) for name in ("left_before", "left_after"))
    return f"{before:.3f} ({after:.3f})"


if __name__ == "__main__":
    measure(__doc__, RESULTS, product(TASKS, SEEDS), rows_of, summary)
