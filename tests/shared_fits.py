"""Policies that share parameters with the value function, and value fits that move these."""

from typing import Any

import pytest
import torch as th
from oracles import ACTION_SPACES, OF_IMAGES, double_policy
from stable_baselines3.common.distributions import kl_divergence
from stable_baselines3.common.policies import ActorCriticPolicy

from sb3_gae import SharedMlpPolicy
from sb3_gae.batch import TrainingBatch
from sb3_gae.networks.distributions import snapshot
from sb3_gae.update.policy_step import policy_parameters
from sb3_gae.update.shared_parameters import ParameterGroups, SharedParameters, shared_parameters
from sb3_gae.update.trust_region import TrustRegionSettings
from sb3_gae.update.value_step import ValueFitRecord, value_parameters, value_steps

EXACT = TrustRegionSettings(radius=0.05, cg_max_steps=400, cg_damping=0.05, max_scale=1.0)
DEFAULTS = TrustRegionSettings(radius=0.2, cg_max_steps=10, cg_damping=1e-2, cg_progress_tolerance=0.1, max_scale=1.0)

KINDS: dict[str, dict[str, Any]] = {
    "all layers": dict(action_space=ACTION_SPACES["Box"], policy_class=SharedMlpPolicy, net_arch=[5, 4]),
    "first layer": dict(
        action_space=ACTION_SPACES["Discrete"], policy_class=SharedMlpPolicy, net_arch=dict(pi=[5, 4], vf=[5, 3])
    ),
    "convolution": dict(action_space=ACTION_SPACES["Box"], **OF_IMAGES),
    "gSDE": dict(action_space=ACTION_SPACES["Box"], policy_class=SharedMlpPolicy, net_arch=[5], use_sde=True),
}
each_kind = pytest.mark.parametrize("kind", KINDS)


def policy_of(kind: str, seed: int = 0) -> ActorCriticPolicy:
    return double_policy(**KINDS[kind], seed=seed)


def groups_of(policy: ActorCriticPolicy, batch: TrainingBatch) -> ParameterGroups:
    of_policy = policy_parameters(policy, batch)
    of_value = value_parameters(policy, batch, of_policy)
    return ParameterGroups(of_policy, of_value, shared_parameters(policy, batch, of_policy))


def fit(
    policy: ActorCriticPolicy,
    batch: TrainingBatch,
    limit: float | None,
    settings: TrustRegionSettings = EXACT,
    n_steps: int = 1,
    subset: th.Tensor | None = None,
) -> ValueFitRecord:
    """:param limit: of the divergence of the policy; None to leave the shared parameters alone"""
    groups = groups_of(policy, batch)
    shared = None if limit is None else SharedParameters(policy, groups, batch, limit, subset)
    return value_steps(policy, groups.of_value, batch, settings, n_steps, subset, shared)


def values_of(policy: ActorCriticPolicy, batch: TrainingBatch) -> th.Tensor:
    with th.no_grad():
        return policy.predict_values(batch.observations).squeeze(1)


def distribution_of(policy: ActorCriticPolicy, batch: TrainingBatch) -> Any:
    with th.no_grad():
        return snapshot(policy.get_distribution(batch.observations))


def divergence(old: Any, new: Any) -> float:
    per_action = kl_divergence(old, new)
    return per_action.reshape(len(per_action), -1).sum(1).mean().item()
