"""Fits of the value function by trust-region steps, of policies of every kind."""

from dataclasses import replace

import pytest
import torch as th
from oracles import ACTION_SPACES, OF_IMAGES
from stable_baselines3.common.policies import ActorCriticPolicy

from sb3_gae import SharedMlpPolicy
from sb3_gae.batch import TrainingBatch
from sb3_gae.update.policy_step import policy_parameters
from sb3_gae.update.trust_region import TrustRegionSettings
from sb3_gae.update.value_step import ValueFitRecord, value_parameters, value_steps

BOX = ACTION_SPACES["Box"]
EXACT = TrustRegionSettings(radius=0.05, cg_max_steps=300, cg_damping=0.0, max_scale=1.0)
DAMPED = replace(EXACT, cg_max_steps=10, cg_damping=1e-2, radius=0.2)
LINEAR = dict(net_arch=dict(pi=[3], vf=[]))

KINDS = {
    "linear": LINEAR,
    "network": {},
    "shared convolution": OF_IMAGES,
    "own convolution": {**OF_IMAGES, "share_features_extractor": False},
    "gSDE": dict(use_sde=True),
    "first layer shared": dict(policy_class=SharedMlpPolicy, net_arch=dict(pi=[5], vf=[5, 4])),
}
each_kind = pytest.mark.parametrize("kwargs", KINDS.values(), ids=KINDS.keys())


def fit(
    policy: ActorCriticPolicy,
    batch: TrainingBatch,
    settings: TrustRegionSettings = EXACT,
    n_steps: int = 1,
    subset: th.Tensor | None = None,
) -> ValueFitRecord:
    return value_steps(policy, value_parameters_of(policy, batch), batch, settings, n_steps, subset)


def value_parameters_of(policy: ActorCriticPolicy, batch: TrainingBatch) -> list[th.Tensor]:
    return value_parameters(policy, batch, policy_parameters(policy, batch))


def values_of(policy: ActorCriticPolicy, batch: TrainingBatch) -> th.Tensor:
    with th.no_grad():
        return policy.predict_values(batch.observations).squeeze(1)


def variance_of(policy: ActorCriticPolicy, batch: TrainingBatch) -> float:
    """The paper's sigma squared, in units of the squared reward."""
    return (values_of(policy, batch) - batch.value_targets).square().mean().item()
