r"""
Policy gradients as a trust region sees them: :math:`F^{-1}g`, with :math:`F` the mean Fisher matrix.

Solving for many gradients exactly would take longer than the update that they belong to. A Kronecker-factored approximation
of :math:`F` (K-FAC) is inverted once for all of them.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch as th
from stable_baselines3.common.policies import ActorCriticPolicy

from sb3_gae.batch import TrainingBatch
from sb3_gae.borrowed_distribution import borrowed_distribution
from sb3_gae.networks.dense_policy import has_dense_policy
from sb3_gae.networks.parameters import positions
from sb3_gae.update.kronecker import WIDEST_LAYER
from sb3_gae.update.policy_step import DenseFisher

# Second moments of so many samples are good enough for a metric
_MOST_SAMPLES = 8192


class NaturalGradients(NamedTuple):
    r"""
    With :math:`M = (F + d)^{-1}`, one symmetric and positive matrix for all gradients.

    :param steps: :math:`s = Mg`, where a trust-region step leads, shape (..., P)
    :param duals: :math:`MFMg`, whose product with :math:`g` is :math:`s^\top Fs`: the step's squared length as
        the trust region measures it, without the damping, shape (..., P)
    """

    steps: np.ndarray
    duals: np.ndarray


def natural_gradients(
    policy: ActorCriticPolicy,
    parameters: Sequence[th.Tensor],
    batch: TrainingBatch,
    gradients: np.ndarray,
    damping: float = 0.1,
) -> NaturalGradients:
    r"""
    :param policy: an MLP as SB3 builds it
    :param parameters: what the gradients are by, P scalars in all, see :func:`~sb3_gae.update.policy_step.policy_parameters`
    :param batch: observations and the actions that the policy drew for them
    :param gradients: shape (..., P)
    :param damping: :math:`d`, positive
    :return: see :class:`NaturalGradients`
    :raises ValueError: if the policy is of another kind
    """
    fisher = _prepared_fisher(policy, parameters, batch)
    if fisher is None:
        raise ValueError(
            f"Natural gradients need a policy that is an MLP as SB3 builds it, with layers no wider than {WIDEST_LAYER}."
        )
    places = positions(parameters, fisher.parameters).cpu().numpy()
    dtype, device = parameters[0].dtype, parameters[0].device

    def solved(vector: np.ndarray) -> np.ndarray:
        # Unit length, so that gradients of 1e-30 and 1e30 come out alike in single precision
        length, result = float(np.linalg.norm(vector)) or 1.0, np.empty_like(vector)
        scaled = th.as_tensor(vector[places] / length, dtype=dtype, device=device)
        result[places] = length * fisher.precondition(scaled, damping).cpu().double().numpy()
        return result

    steps, twice = np.empty_like(gradients), np.empty_like(gradients)
    for index in np.ndindex(gradients.shape[:-1]):
        steps[index] = solved(gradients[index])
        twice[index] = solved(steps[index])
    return NaturalGradients(steps, steps - damping * twice)


def has_natural_gradients(policy: ActorCriticPolicy, parameters: Sequence[th.Tensor], batch: TrainingBatch) -> bool:
    """
    :param policy: any actor-critic policy
    :param parameters: see :func:`~sb3_gae.update.policy_step.policy_parameters`
    :param batch: at least one sample
    :return: whether :func:`natural_gradients` knows this kind of policy
    """
    one = batch.first()
    return _prepared_fisher(policy, parameters, one) is not None


def _prepared_fisher(policy: ActorCriticPolicy, parameters: Sequence[th.Tensor], batch: TrainingBatch) -> DenseFisher | None:
    if not has_dense_policy(policy, parameters):
        return None
    # Evenly spaced: random ones would come out of the generator that training draws from
    spread = th.arange(0, len(batch), -(-len(batch) // _MOST_SAMPLES), device=batch.advantages.device)
    part = batch.take(spread)
    with borrowed_distribution(policy):
        fisher = DenseFisher(policy, part.observations)
    return fisher if fisher.prepare(part.actions) else None
