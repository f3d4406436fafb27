"""
What a policy step gains where it was not computed, by the damping of its linear system.

    python -m benchmarks.policy_step_gain            # about 25 minutes on one core
    python -m benchmarks.policy_step_gain --summary  # only the table, from the stored results

An agent learns with the shipped settings. Before every fifth update the step is computed from its batch with each damping,
all to the same divergence, and asked what it gains: of the surrogate on that batch, and on six more that the same policy has
collected. Both are in units of the advantages' deviation. None of these steps is taken; the agent goes on with its own.
What is stored in results/policy_step_gain.csv is not run again.
"""

import copy
from collections.abc import Iterator
from itertools import product
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.vec_env import VecNormalize

from benchmarks.shipped_agent import shipped_agent
from benchmarks.stored_rows import measure, stored
from sb3_gae import TRPOGAE
from sb3_gae.batch import TrainingBatch, standardized
from sb3_gae.rollout.evaluation import training_batch
from sb3_gae.update.policy_step import policy_parameters, policy_step
from sb3_gae.update.trust_region import TrustRegionSettings

RESULTS = Path(__file__).parent / "results" / "policy_step_gain.csv"
SEEDS = (100, 101)
#: with the number of batches
TASKS = {"HalfCheetah-v5": 150, "Walker2d-v5": 150, "Swimmer-v5": 60, "Ant-v5": 100, "Humanoid-v5": 90}
EVERY = 5
OTHER_BATCHES = 6
DAMPINGS = (0.01, 0.1, 0.3, 1.0, 3.0, 10.0, 100.0)


class Sampler(TRPOGAE):
    """Collects and learns nothing."""

    def train(self) -> None:
        pass


class Batches(BaseCallback):
    """Keeps what is collected."""

    def _on_training_start(self) -> None:
        self.kept: list[TrainingBatch] = []

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        rollout_buffer = cast(TRPOGAE, self.model).rollout_buffer
        self.kept.append(copy.deepcopy(training_batch(rollout_buffer, self.model.action_space)))


class Trials(BaseCallback):
    """Tries steps on copies of the policy, and asks the sampler's batches about them."""

    def __init__(self, sampler: Sampler) -> None:
        super().__init__()
        self.sampler = sampler
        self.rows: list[dict[str, Any]] = []
        self.n_batches = 0

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        self.n_batches += 1
        if self.n_batches % EVERY:
            return
        model = cast(TRPOGAE, self.model)
        batch, others = training_batch(model.rollout_buffer, model.action_space), self._other_batches(model)
        for damping in DAMPINGS:
            own, other, products = gains_of_step(model, batch, others, damping)
            row = {"batch": self.n_batches, "samples": len(batch), "damping": damping}
            self.rows.append(row | {"own": own, "others": other, "products": products})

    def _other_batches(self, model: TRPOGAE) -> TrainingBatch:
        normalization = cast(VecNormalize, self.sampler.get_vec_normalize_env())
        normalization.obs_rms = copy.deepcopy(cast(VecNormalize, model.get_vec_normalize_env()).obs_rms)
        normalization.training = False
        self.sampler.policy.load_state_dict(model.policy.state_dict())
        n_steps = OTHER_BATCHES * model.n_steps * model.n_envs
        self.sampler.learn(n_steps, callback := Batches(), reset_num_timesteps=False)
        fields = ("observations", "actions", "advantages", "value_targets")
        return TrainingBatch(*(th.cat([getattr(batch, field) for batch in callback.kept]) for field in fields))


def gains_of_step(model: TRPOGAE, batch: TrainingBatch, others: TrainingBatch, damping: float) -> tuple[float, float, int]:
    """Of the surrogate, on the step's own batch and on others, and the curvature products that the step took."""
    policy = cast(ActorCriticPolicy, copy.deepcopy(model.policy))
    settings = TrustRegionSettings(model.target_kl, model.cg_max_steps, damping, model.cg_tolerance)
    before = log_prob(policy, others)
    record = policy_step(policy, policy_parameters(policy, batch), batch, standardized(batch.advantages), settings)
    ratios = th.exp(log_prob(policy, others) - before)
    gain = (standardized(others.advantages) * ratios).mean().item()
    return record.objective_after - record.objective_before, gain, record.cg_steps


def log_prob(policy: ActorCriticPolicy, batch: TrainingBatch) -> th.Tensor:
    with th.no_grad():
        return policy.get_distribution(cast(th.Tensor, batch.observations)).log_prob(batch.actions)


def rows_of(env_id: str, seed: int) -> Iterator[dict[str, Any]]:
    model = shipped_agent(env_id, seed)
    trials = Trials(cast(Sampler, shipped_agent(env_id, seed + 1_000, Sampler)))
    model.learn(TASKS[env_id] * model.n_steps * model.n_envs, callback=trials)
    for row in trials.rows:
        yield {"env": env_id, "seed": seed} | row


def summary() -> str:
    """A table of means over updates and seeds, in thousandths; on the step's own batch in brackets."""
    rows = stored(RESULTS)
    lines = ["| task | " + " | ".join(f"{damping:g}" for damping in DAMPINGS) + " |", "| --- " * (len(DAMPINGS) + 1) + "|"]
    for env in TASKS:
        if own := [row for row in rows if row["env"] == env]:
            cells = [_means([row for row in own if float(row["damping"]) == damping]) for damping in DAMPINGS]
            lines.append(f"| {env} | " + " | ".join(cells) + " |")
    products = [_mean([row for row in rows if float(row["damping"]) == damping], "products") for damping in DAMPINGS]
    lines.append("| products a step | " + " | ".join(f"{number:.1f}" for number in products) + " |")
    return "\n".join(lines)


def _means(rows: list[dict[str, str]]) -> str:
    return f"{1_000 * _mean(rows, 'others'):.1f} ({1_000 * _mean(rows, 'own'):.0f})"


def _mean(rows: list[dict[str, str]], name: str) -> float:
    return float(np.mean([float(row[name]) for row in rows] or [np.nan]))


if __name__ == "__main__":
    measure(__doc__, RESULTS, product(TASKS, SEEDS), rows_of, summary)
