"""The policy step: TRPO's natural gradient with an exact radius and a search on the true divergence."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch as th
from stable_baselines3.common.distributions import Distribution
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.type_aliases import PyTorchObs

from sb3_gae.batch import TrainingBatch, take
from sb3_gae.curvature import CurvatureProduct, hessian_product
from sb3_gae.dense_policy import dense_policy_network, has_dense_policy, policy_log_std
from sb3_gae.distributions import distribution_from_outputs, fisher_metric, mean_kl, snapshot
from sb3_gae.parameters import flat_gradient, influencing_parameters
from sb3_gae.trust_region import LocalProblem, StepRecord, TrustRegionSettings, trust_region_step


def policy_parameters(policy: ActorCriticPolicy, batch: TrainingBatch) -> list[th.Tensor]:
    """
    :param policy: any actor-critic policy
    :param batch: at least one sample
    :return: the trainable parameters that the action distribution depends on
    """
    sample = batch.take(th.zeros(1, dtype=th.long, device=batch.advantages.device))
    log_prob = policy.get_distribution(sample.observations).log_prob(sample.actions)
    return influencing_parameters(log_prob, policy.parameters())


def policy_step(
    policy: ActorCriticPolicy,
    parameters: Sequence[th.Tensor],
    batch: TrainingBatch,
    advantages: th.Tensor,
    settings: TrustRegionSettings,
    curvature_subset: th.Tensor | None = None,
) -> StepRecord:
    r"""
    Increase the surrogate :math:`\mathrm{mean}\,\hat A_t\,\pi_\theta(a_t|s_t)/\pi_{old}(a_t|s_t)` subject to
    :math:`\mathrm{mean}\,D_{KL}(\pi_{old} \| \pi_\theta) \le` the radius (paper, section 6.1).

    :param policy: what to improve, in evaluation mode
    :param parameters: see :func:`policy_parameters`
    :param batch: observations and actions, B samples
    :param advantages: as they are to weigh in, shape (B,)
    :param settings: radius, solver and search
    :param curvature_subset: samples to compute the curvature on, None for all
    :return: what was done
    :raises NumericalError: if the gradient or a curvature product is not finite
    """
    observations = batch.observations if curvature_subset is None else take(batch.observations, curvature_subset)
    make_problem = _dense_problem if has_dense_policy(policy, parameters) else _autograd_problem
    return trust_region_step(make_problem(policy, parameters, batch, advantages, observations), settings)


@dataclass
class _Trial:
    """Surrogate and mean KL divergence of the policy as it now is, from the policy as it was."""

    policy: ActorCriticPolicy
    batch: TrainingBatch
    advantages: th.Tensor
    old: Distribution
    old_log_prob: th.Tensor

    def __call__(self) -> tuple[float, float]:
        try:
            with th.no_grad():
                new = self.policy.get_distribution(self.batch.observations)
                surrogate = _surrogate(self.advantages, new.log_prob(self.batch.actions), self.old_log_prob)
                return surrogate.item(), mean_kl(self.old, new).item()
        except ValueError:
            # torch refuses distribution parameters that are not finite: too long a step, not an error of the user's
            return -math.inf, math.inf


def _surrogate(advantages: th.Tensor, log_prob: th.Tensor, old_log_prob: th.Tensor) -> th.Tensor:
    return (advantages * th.exp(log_prob - old_log_prob)).mean()


def _autograd_problem(
    policy: ActorCriticPolicy,
    parameters: Sequence[th.Tensor],
    batch: TrainingBatch,
    advantages: th.Tensor,
    curvature_observations: PyTorchObs,
) -> LocalProblem:
    """For any policy that can be differentiated twice."""
    with th.no_grad():
        old = snapshot(policy.get_distribution(batch.observations))
        old_log_prob = old.log_prob(batch.actions)
    log_prob = policy.get_distribution(batch.observations).log_prob(batch.actions)
    surrogate = _surrogate(advantages, log_prob, old_log_prob)
    return LocalProblem(
        name="policy",
        parameters=parameters,
        objective=surrogate.item(),
        gradient=flat_gradient(surrogate, parameters),
        curvature=autograd_fisher_product(policy, parameters, curvature_observations),
        evaluate=_Trial(policy, batch, advantages, old, old_log_prob),
    )


def _dense_problem(
    policy: ActorCriticPolicy,
    parameters: Sequence[th.Tensor],
    batch: TrainingBatch,
    advantages: th.Tensor,
    curvature_observations: PyTorchObs,
) -> LocalProblem:
    """The same for an MLP, several times as fast."""
    network, log_std = dense_policy_network(policy, batch.observations), policy_log_std(policy)
    outputs = network.forward()
    with th.no_grad():
        old = snapshot(distribution_from_outputs(policy.action_dist, outputs, log_std))
        old_log_prob = old.log_prob(batch.actions)
    log_prob = distribution_from_outputs(policy.action_dist, outputs.requires_grad_(), log_std).log_prob(batch.actions)
    surrogate = _surrogate(advantages, log_prob, old_log_prob)
    cotangents, *log_std_gradient = th.autograd.grad(surrogate, [outputs, *log_std])
    return LocalProblem(
        name="policy",
        parameters=[*network.parameters, *log_std],
        objective=surrogate.item(),
        gradient=th.cat([network.vjp(cotangents), *log_std_gradient]),
        curvature=dense_fisher_product(policy, curvature_observations),
        evaluate=_Trial(policy, batch, advantages, old, old_log_prob),
    )


def autograd_fisher_product(
    policy: ActorCriticPolicy, parameters: Sequence[th.Tensor], observations: PyTorchObs
) -> CurvatureProduct:
    r"""
    Products with the mean Fisher matrix, as the Hessian of :math:`D_{KL}(\pi_{old} \| \pi)` at :math:`\pi = \pi_{old}`.

    :param policy: any that can be differentiated twice
    :param parameters: what to differentiate by, n scalars in all
    :param observations: B samples
    :return: maps (n,) to (n,)
    """
    with th.no_grad():
        old = snapshot(policy.get_distribution(observations))
    return hessian_product(mean_kl(old, policy.get_distribution(observations)), parameters)


def dense_fisher_product(policy: ActorCriticPolicy, observations: PyTorchObs) -> CurvatureProduct:
    r"""
    Products with the mean Fisher matrix :math:`\frac1B \sum_n J_n^\top M_n J_n`, for an MLP.

    :param policy: one that :func:`~sb3_gae.dense_policy.has_dense_policy`
    :param observations: B samples
    :return: maps (n,) to (n,); the order is that of the layers, and then the logarithm of the standard deviations
    """
    network = dense_policy_network(policy, observations)
    with th.no_grad():
        old = snapshot(distribution_from_outputs(policy.action_dist, network.forward(), policy_log_std(policy)))
    metric, n_layers = fisher_metric(old), network.n_parameters

    def product(vector: th.Tensor) -> th.Tensor:
        layers = network.gauss_newton_product(vector[:n_layers], metric) / network.batch_size
        # The Fisher information of a Gaussian about the logarithm of its standard deviation is 2, in every state
        return th.cat([layers, 2.0 * vector[n_layers:]])

    return product
