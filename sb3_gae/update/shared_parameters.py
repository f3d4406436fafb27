r"""
What keeps the value fit from moving the policy too far through parameters that both depend on.

The Fisher matrix makes the policies a space in which :math:`\sqrt{2 D_{KL}}` is, for small steps, a distance. Distances
add up at most: an iteration whose policy step goes :math:`1 - \sqrt f` of the way that ``target_kl`` allows, and whose value
fit goes :math:`\sqrt f` of it, stays within ``target_kl``.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch as th
from stable_baselines3.common.policies import ActorCriticPolicy

from sb3_gae.batch import TrainingBatch
from sb3_gae.checks import is_about_numbers
from sb3_gae.networks.dense_policy import has_dense_policy
from sb3_gae.networks.distributions import mean_kl, snapshot
from sb3_gae.networks.parameters import influencing_in_batch, positions
from sb3_gae.update.curvature import CurvatureProduct
from sb3_gae.update.kronecker import OutputMoments
from sb3_gae.update.policy_step import DenseFisher, autograd_fisher_product
from sb3_gae.update.trust_region import Constraint

# Part of the way below which a step is not worth its while: the weight of its constraint would only meet rounding
_NEXT_TO_NO_WAY = 1e-3


def policy_step_radius(target_kl: float, vf_kl_fraction: float) -> float:
    """
    :param target_kl: largest divergence of an iteration
    :param vf_kl_fraction: part of it that the value fit may use
    :return: largest divergence of the policy step, so that both together keep to ``target_kl``
    """
    return (1.0 - math.sqrt(vf_kl_fraction)) ** 2 * target_kl


def shared_parameters(
    policy: ActorCriticPolicy, batch: TrainingBatch, policy_parameters: Sequence[th.Tensor]
) -> list[th.Tensor]:
    """
    :param policy: any actor-critic policy
    :param batch: at least one sample
    :param policy_parameters: what the action distribution depends on
    :return: those of them that the value depends on, too, in whichever sample
    """
    return influencing_in_batch(lambda part: policy.predict_values(part.observations), policy_parameters, batch)


class ParameterGroups(NamedTuple):
    """
    :param of_policy: what the action distribution depends on
    :param of_value: what the value depends on and the action distribution does not
    :param of_both: those of the first that the value fit may move, too
    """

    of_policy: list[th.Tensor]
    of_value: list[th.Tensor]
    of_both: list[th.Tensor]


@dataclass(frozen=True)
class SharedStep:
    """
    What a value step has to know of the policy.

    :param constraint: on the policy's divergence
    :param unweighted_moments: of the policy's curvature at the outputs of layers, None where they are not known
    """

    constraint: Constraint
    unweighted_moments: OutputMoments | None

    def output_moments(self, weight: float) -> OutputMoments | None:
        """
        :param weight: what the policy's curvature is multiplied by
        :return: what is then added to the curvature of the value function, None where that is not known
        """
        if self.unweighted_moments is None:
            return None
        return {layer: weight * moments for layer, moments in self.unweighted_moments.items()}


class SharedParameters:
    r"""
    Parameters that policy and value function both depend on, and how far the value fit may move the policy by them.

    The limit holds for :math:`D_{KL}` from the policy as it stands now, at the beginning of the fit, whatever the number of
    steps.

    :param policy: in evaluation mode
    :param groups: which parameters these are
    :param batch: over whose observations the divergence is averaged
    :param limit: largest divergence
    :param curvature_subset: samples to compute the Fisher matrix on, None for all
    """

    def __init__(
        self,
        policy: ActorCriticPolicy,
        groups: ParameterGroups,
        batch: TrainingBatch,
        limit: float,
        curvature_subset: th.Tensor | None = None,
    ):
        self.parameters = groups.of_both
        self._policy = policy
        self._is_dense = has_dense_policy(policy, groups.of_policy)
        self._observations = batch.observations
        self._curvature_batch = batch.take(curvature_subset)
        self._limit = limit
        with th.no_grad():
            self._start = snapshot(policy.get_distribution(self._observations))

    def divergence(self) -> float:
        """Of the policy as it now is, from the policy as it stood at the beginning; infinite where it is not a number."""
        try:
            with th.no_grad():
                divergence = mean_kl(self._start, self._policy.get_distribution(self._observations)).item()
        except ValueError as error:
            # torch refuses distribution parameters that are not finite: too long a step
            if not is_about_numbers(error, self._policy.parameters()):
                raise
            return math.inf
        # `torch.compile` has switched that check off for the whole process
        return math.inf if math.isnan(divergence) else divergence

    def radius(self, steps_left: int) -> float:
        """
        :param steps_left: of the fit
        :return: largest divergence of the next of them: each gets an equal part of the way that is left; 0 for next to none
        """
        way = math.sqrt(self._limit)
        way_left = way - math.sqrt(max(self.divergence(), 0.0))
        return (way_left / steps_left) ** 2 if way_left > _NEXT_TO_NO_WAY * way else 0.0

    def step(self, moved: Sequence[th.Tensor], radius: float) -> SharedStep:
        """
        :param moved: what the value step moves, the shared parameters among it
        :param radius: see :meth:`radius`, positive
        :return: for a step from the present parameters
        """
        observations = self._curvature_batch.observations
        product: CurvatureProduct
        of_policy: Sequence[th.Tensor]
        moments: OutputMoments | None = None
        if self._is_dense:
            fisher = DenseFisher(self._policy, observations)
            of_policy, product = fisher.parameters, fisher.product
            moments = fisher.output_moments(self._curvature_batch.actions)
        else:
            of_policy = self.parameters
            product = autograd_fisher_product(self._policy, of_policy, observations)
        in_policy, in_moved = positions(of_policy, self.parameters), positions(moved, self.parameters)
        n_of_policy, n_moved = (sum(parameter.numel() for parameter in each) for each in (of_policy, moved))

        def embedded(vector: th.Tensor) -> th.Tensor:
            direction, result = vector.new_zeros(n_of_policy), th.zeros_like(vector)
            direction[in_policy] = vector[in_moved]
            result[in_moved] = product(direction)[in_policy]
            return result

        coordinates = th.zeros(n_moved, dtype=th.bool, device=in_moved.device).index_fill(0, in_moved, True)
        return SharedStep(Constraint(radius, embedded, coordinates, self._limit, self.divergence), moments)
