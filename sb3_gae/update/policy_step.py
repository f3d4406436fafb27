"""The policy step: TRPO's natural gradient with an exact radius and a search on the true divergence."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch as th
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.type_aliases import PyTorchObs

from sb3_gae.batch import TrainingBatch
from sb3_gae.borrowed_distribution import borrowed_distribution
from sb3_gae.checks import is_about_numbers
from sb3_gae.networks.dense_policy import dense_policy_network, has_dense_policy, policy_log_std
from sb3_gae.networks.distributions import ActionDistribution, distribution_from_outputs, fisher_metric, mean_kl, snapshot
from sb3_gae.networks.parameters import flat_gradient, influencing_in_batch, influencing_parameters
from sb3_gae.update.curvature import CurvatureProduct, hessian_product
from sb3_gae.update.kronecker import KroneckerPreconditioner, OutputMoments
from sb3_gae.update.trust_region import LocalProblem, StepRecord, TrustRegionSettings, trust_region_step


def policy_parameters(policy: ActorCriticPolicy, batch: TrainingBatch) -> list[th.Tensor]:
    """
    :param policy: any actor-critic policy
    :param batch: at least one sample
    :return: the trainable parameters that the action distribution depends on, in whichever sample
    """

    def log_prob(part: TrainingBatch) -> th.Tensor:
        return policy.get_distribution(part.observations).log_prob(part.actions)

    with borrowed_distribution(policy):
        # Every sample goes through all of an MLP: one of them is enough there
        found = influencing_parameters(log_prob(batch.first()), policy.parameters())
        return found if has_dense_policy(policy, found) else influencing_in_batch(log_prob, policy.parameters(), batch)


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
    curvature_batch = batch.take(curvature_subset)
    make_problem = _dense_problem if has_dense_policy(policy, parameters) else _autograd_problem
    return trust_region_step(make_problem(policy, parameters, batch, advantages, curvature_batch), settings)


@dataclass
class _SurrogateAndDivergence:
    """Surrogate and mean KL divergence of the policy as it now is, from the policy as it was."""

    parameters: Sequence[th.Tensor]
    distribution: Callable[[], ActionDistribution]
    actions: th.Tensor
    advantages: th.Tensor
    old: ActionDistribution
    old_log_prob: th.Tensor

    def __call__(self) -> tuple[float, float]:
        try:
            with th.no_grad():
                new = self.distribution()
                surrogate = _surrogate(self.advantages, new.log_prob(self.actions), self.old_log_prob)
                return surrogate.item(), mean_kl(self.old, new).item()
        except ValueError as error:
            # torch refuses distribution parameters that are not finite: too long a step, not an error of the user's. Where
            # `torch.compile` has switched that check off, both are NaN, which the search rejects, too.
            if not is_about_numbers(error, self.parameters):
                raise
            return -math.inf, math.inf


def _surrogate(advantages: th.Tensor, log_prob: th.Tensor, old_log_prob: th.Tensor) -> th.Tensor:
    return (advantages * th.exp(log_prob - old_log_prob)).mean()


def _autograd_problem(
    policy: ActorCriticPolicy,
    parameters: Sequence[th.Tensor],
    batch: TrainingBatch,
    advantages: th.Tensor,
    curvature_batch: TrainingBatch,
) -> LocalProblem:
    """For any policy that can be differentiated twice."""

    def distribution() -> ActionDistribution:
        return policy.get_distribution(batch.observations)

    with th.no_grad():
        old = snapshot(distribution())
        old_log_prob = old.log_prob(batch.actions)
    surrogate = _surrogate(advantages, distribution().log_prob(batch.actions), old_log_prob)
    return LocalProblem(
        name="policy",
        parameters=parameters,
        objective=surrogate.item(),
        gradient=flat_gradient(surrogate, parameters),
        curvature=autograd_fisher_product(policy, parameters, curvature_batch.observations),
        evaluate=_SurrogateAndDivergence(parameters, distribution, batch.actions, advantages, old, old_log_prob),
    )


def _dense_problem(
    policy: ActorCriticPolicy,
    parameters: Sequence[th.Tensor],
    batch: TrainingBatch,
    advantages: th.Tensor,
    curvature_batch: TrainingBatch,
) -> LocalProblem:
    """The same for an MLP, several times as fast."""
    network, log_std = dense_policy_network(policy, batch.observations), policy_log_std(policy)

    def distribution(outputs: th.Tensor | None = None) -> ActionDistribution:
        outputs = network.forward() if outputs is None else outputs
        return distribution_from_outputs(policy.action_dist, outputs, log_std)

    outputs = network.forward()
    with th.no_grad():
        old = snapshot(distribution(outputs))
    log_prob = distribution(outputs.requires_grad_()).log_prob(batch.actions)
    surrogate = _surrogate(advantages, log_prob, log_prob.detach())
    fisher = DenseFisher(policy, curvature_batch.observations)
    cotangents, *log_std_gradient = th.autograd.grad(surrogate, [outputs, *log_std])
    return LocalProblem(
        name="policy",
        parameters=[*network.parameters, *log_std],
        objective=surrogate.item(),
        gradient=th.cat([network.vjp(cotangents), *log_std_gradient]),
        curvature=fisher.product,
        precondition=fisher.precondition if fisher.prepare(curvature_batch.actions) else None,
        evaluate=_SurrogateAndDivergence(parameters, distribution, batch.actions, advantages, old, log_prob.detach()),
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


class DenseFisher:
    r"""
    The mean Fisher matrix :math:`\frac1B \sum_n J_n^\top M_n J_n` of an MLP policy, n by n.

    Vectors are in the order of the layers, followed by the logarithm of a Gaussian's standard deviations.

    :param policy: one that :func:`~sb3_gae.networks.dense_policy.has_dense_policy`
    :param observations: B samples
    """

    def __init__(self, policy: ActorCriticPolicy, observations: PyTorchObs):
        self._network = dense_policy_network(policy, observations)
        self._log_std = policy_log_std(policy)
        self._outputs = self._network.forward().requires_grad_()
        self._distribution = snapshot(distribution_from_outputs(policy.action_dist, self._outputs, self._log_std))
        self._preconditioner: KroneckerPreconditioner | None = None
        with th.no_grad():
            old = snapshot(distribution_from_outputs(policy.action_dist, self._outputs, self._log_std))
        self._metric = fisher_metric(old)

    @property
    def parameters(self) -> list[th.Tensor]:
        """In the order of the vectors."""
        return [*self._network.parameters, *self._log_std]

    def product(self, vector: th.Tensor) -> th.Tensor:
        """
        :param vector: shape (n,)
        :return: the matrix times the vector, shape (n,)
        """
        of_layers, of_log_std = vector.split([self._network.n_parameters, len(vector) - self._network.n_parameters])
        layers = self._network.gauss_newton_product(of_layers, self._metric) / self._network.batch_size
        return th.cat([layers, _LOG_STD_INFORMATION * of_log_std])

    def prepare(self, actions: th.Tensor) -> bool:
        r"""
        Get ready for :meth:`precondition`. The score of actions that the policy itself has drawn has the metric
        :math:`M` as its covariance, so the batch's own actions give the second moments without sampling anew.

        :param actions: drawn in the states of the observations, B of them
        :return: whether the network is one that preconditioning suits
        """
        if not KroneckerPreconditioner.suits(self._network):
            return False
        self._preconditioner = KroneckerPreconditioner(self._network, self._scores(actions))
        return True

    def output_moments(self, actions: th.Tensor) -> OutputMoments:
        """
        :param actions: as for :meth:`prepare`
        :return: for each linear layer the second moment of the scores at its output, shape (n_out, n_out)
        """
        factors = self._network.kronecker_factors(self._scores(actions))
        return {linear: outputs for (linear, _), (_, outputs) in zip(self._network.layers, factors, strict=True)}

    def _scores(self, actions: th.Tensor) -> th.Tensor:
        # The distribution's own part of the graph serves every call
        (scores,) = th.autograd.grad(self._distribution.log_prob(actions).sum(), self._outputs, retain_graph=True)
        return scores

    def precondition(self, vector: th.Tensor, damping: float) -> th.Tensor:
        """
        :param vector: shape (n,)
        :param damping: multiple of the identity that is added to the matrix, positive
        :return: about the inverse of the damped matrix times the vector, shape (n,)
        """
        assert self._preconditioner is not None
        of_layers, of_log_std = vector.split([self._network.n_parameters, len(vector) - self._network.n_parameters])
        layers = self._preconditioner(of_layers, 1.0, damping)
        return th.cat([layers, of_log_std / (_LOG_STD_INFORMATION + damping)])


# Fisher information of a Gaussian about the logarithm of its standard deviation, in every state
_LOG_STD_INFORMATION = 2.0
