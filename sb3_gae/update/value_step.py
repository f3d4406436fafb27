r"""
The value step: the paper's trust region for the value function (section 5).

With :math:`\sigma^2 = \mathrm{mean}(V_{old} - \hat V)^2`, the mean KL divergence between the Gaussians
:math:`N(V_{old}, \sigma^2)` and :math:`N(V, \sigma^2)` is :math:`\mathrm{mean}(V - V_{old})^2 / 2\sigma^2`; it must not
exceed the radius. All quantities here are divided by :math:`\sigma^2`: the objective, whose value at the start is
:math:`-\frac12`, as well as the Gauss-Newton matrix. The radius then has no units.
(The paper's own formula for the length of the step leaves :math:`\sigma^2` out of the matrix.)
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import torch as th
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.type_aliases import PyTorchObs

from sb3_gae.batch import TrainingBatch, in_chunks, take
from sb3_gae.networks.dense_policy import dense_value_network, has_dense_value
from sb3_gae.networks.parameters import flat_gradient, influencing_in_batch, influencing_parameters
from sb3_gae.networks.value_head import ValueHead
from sb3_gae.update.curvature import CurvatureProduct, hessian_product
from sb3_gae.update.kronecker import NOTHING_ADDED, KroneckerPreconditioner, OutputMoments
from sb3_gae.update.shared_parameters import SharedParameters, SharedStep
from sb3_gae.update.trust_region import LocalProblem, StepRecord, TrustRegionSettings, trust_region_step

#: prior precision of a parameter's move in a batch, for targets of mean square 1; see ``benchmarks/value_fit_error.py``
PRIOR_PRECISION = 600.0


def value_parameters(
    policy: ActorCriticPolicy, batch: TrainingBatch, policy_parameters: Sequence[th.Tensor]
) -> list[th.Tensor]:
    """
    :param policy: any actor-critic policy
    :param batch: at least one sample
    :param policy_parameters: what the action distribution depends on, which the value step must not move
    :return: the other trainable parameters that the value depends on, in whichever sample
    """
    shared = {id(parameter) for parameter in policy_parameters}
    others = [parameter for parameter in policy.parameters() if id(parameter) not in shared]

    def values(part: TrainingBatch) -> th.Tensor:
        return policy.predict_values(part.observations)

    # Every sample goes through all of an MLP: one of them is enough there
    found = influencing_parameters(values(batch.first()), others)
    return found if has_dense_value(policy, found) else influencing_in_batch(values, others, batch)


@dataclass(frozen=True)
class ValueFitRecord:
    r"""
    :param steps: a record for each step; their objectives are in units of each step's own :math:`\sigma^2`
    :param values_before: values of the batch before the first step, in units of the reward, shape (B,)
    :param values_after: values of the batch after the last step, in units of the reward, shape (B,)
    :param policy_kl: how far the policy was moved by the parameters that it shares; None where they were left alone
    """

    steps: list[StepRecord]
    values_before: th.Tensor
    values_after: th.Tensor
    policy_kl: float | None = None


def automatic_damping(n_samples: int) -> float:
    r"""
    Damping that lets a batch say less the fewer samples it has.

    Ridge regression that takes the errors of the batch for noise of variance :math:`\sigma^2`, and has a normal prior of
    precision c on how far each parameter moves, has the matrix :math:`\sum_t J_t J_t^\top + c \sigma^2 I`. Divided by the
    number of samples n, as the Gauss-Newton matrix here is, the prior adds c / n times :math:`\sigma^2`.

    :param n_samples: in the batch
    :return: what is to be added to the diagonal of the Gauss-Newton matrix, in units of :math:`\sigma^2`
    """
    return PRIOR_PRECISION / n_samples


def value_steps(
    policy: ActorCriticPolicy,
    parameters: Sequence[th.Tensor],
    batch: TrainingBatch,
    settings: TrustRegionSettings,
    n_steps: int,
    curvature_subset: th.Tensor | None = None,
    shared: SharedParameters | None = None,
) -> ValueFitRecord:
    r"""
    Fit the value function by up to ``n_steps`` trust-region steps, each measured from where it begins.

    Each solves the paper's problem (section 5) once, with :math:`V_{old}` and :math:`\sigma^2` taken anew.
    The first step that is rejected is the last, and there is none where the values agree with their targets but for
    rounding. With shared parameters it is the last that moves those, as is one that
    leaves no room: the value function's own may go on.

    All steps have the same damping of the Gauss-Newton matrix itself, ``settings.cg_damping`` times the first step's
    :math:`\sigma^2`. Were it times each step's own, the closer the fit, the less would hold it back from the noise of the
    batch.

    :param policy: owner of the value function, in evaluation mode
    :param parameters: see :func:`value_parameters`
    :param batch: observations and value targets, B samples
    :param settings: radius, solver and search; the damping is in units of the first step's :math:`\sigma^2`, see
        :func:`automatic_damping`
    :param n_steps: largest number of steps
    :param curvature_subset: samples to compute the curvature on, None for all
    :param shared: what is to be moved beside the parameters, within which limit; None for nothing
    :return: what was done
    :raises NumericalError: if a gradient or a curvature product is not finite
    """
    observations = batch.observations if curvature_subset is None else take(batch.observations, curvature_subset)
    scale = value_scale(policy)

    def make_fit(moved: Sequence[th.Tensor]) -> _Fit:
        make_model = _DenseValues if has_dense_value(policy, moved) else _AutogradValues
        return _Fit(make_model(policy, moved, batch.observations, observations), batch.value_targets / scale)

    joint = shared
    fit = make_fit(parameters if joint is None else [*parameters, *joint.parameters])
    damping = settings.cg_damping * fit.variance / fit.target_square
    before = fit.values
    records: list[StepRecord] = []
    for steps_left in range(n_steps, 0, -1):
        radius = 0.0 if joint is None else joint.radius(steps_left)
        rejected = bool(records) and not records[-1].accepted
        if joint is not None and (rejected or radius == 0.0):
            joint, fit = None, make_fit(parameters)
        elif rejected:
            break
        if fit.is_exact or not fit.parameters:
            break
        # Of the matrix over the present variance, as the step has it
        settings = replace(settings, cg_damping=damping / fit.variance)
        records.append(fit.step(settings) if joint is None else fit.step(settings, joint.step(fit.parameters, radius)))
    policy_kl = None if shared is None else shared.divergence()
    return ValueFitRecord(records, before * scale, fit.values * scale, policy_kl)


def value_scale(policy: ActorCriticPolicy) -> th.Tensor | float:
    """
    :param policy: any actor-critic policy
    :return: the factor of its :class:`~sb3_gae.networks.value_head.ValueHead`, 1 if it has none
    """
    head = getattr(policy, "value_net", None)
    return head.scale if isinstance(head, ValueHead) else 1.0


class _Values(Protocol):
    """A value function over a fixed batch, in units of the value scale."""

    parameters: Sequence[th.Tensor]

    def values(self) -> th.Tensor:
        """Values at the present parameters, shape (B,)."""

    def vjp(self, cotangents: th.Tensor) -> th.Tensor:
        """Jacobian's transpose at the parameters of the last :meth:`values`, times ``cotangents`` (B,), shape (n,)."""

    def curvature(self, added: OutputMoments | None) -> tuple[CurvatureProduct, KroneckerPreconditioner | None]:
        """
        Products with the mean of the Jacobian's outer products over the curvature's samples, at the same parameters,
        and about the inverse of that matrix with what is ``added`` to it, where that is known.
        """


class _DenseValues:
    """An MLP; the activations of the last :meth:`values` serve the gradient and the products of the next step."""

    def __init__(
        self,
        policy: ActorCriticPolicy,
        parameters: Sequence[th.Tensor],
        observations: PyTorchObs,
        curvature_observations: PyTorchObs,
    ):
        self._network = dense_value_network(policy, observations, parameters)
        self._curvature_network = self._network
        if curvature_observations is not observations:
            self._curvature_network = dense_value_network(policy, curvature_observations, parameters)
        self.parameters: Sequence[th.Tensor] = self._network.parameters
        self._preconditioner: KroneckerPreconditioner | None = None

    def values(self) -> th.Tensor:
        return self._network.forward().squeeze(1)

    def vjp(self, cotangents: th.Tensor) -> th.Tensor:
        return self._network.vjp(cotangents[:, None])

    def curvature(self, added: OutputMoments | None) -> tuple[CurvatureProduct, KroneckerPreconditioner | None]:
        network = self._curvature_network
        if network is not self._network:
            network.forward()

        def product(vector: th.Tensor) -> th.Tensor:
            return network.gauss_newton_product(vector, lambda tangents, rows: tangents) / network.batch_size

        if added is None or not KroneckerPreconditioner.suits(network):
            return product, None
        ones = self.parameters[0].new_ones(network.batch_size, 1)
        self._preconditioner = KroneckerPreconditioner(network, ones, added, former=self._preconditioner)
        return product, self._preconditioner


class _AutogradValues:
    """Any value function that can be differentiated twice."""

    def __init__(
        self,
        policy: ActorCriticPolicy,
        parameters: Sequence[th.Tensor],
        observations: PyTorchObs,
        curvature_observations: PyTorchObs,
    ):
        self.parameters = parameters
        self._policy = policy
        self._observations = observations
        self._curvature_observations = curvature_observations

    def values(self) -> th.Tensor:
        return in_chunks(self._predict, self._observations)

    def vjp(self, cotangents: th.Tensor) -> th.Tensor:
        return flat_gradient(self._predict(self._observations).dot(cotangents), self.parameters)

    def curvature(self, added: OutputMoments | None) -> tuple[CurvatureProduct, KroneckerPreconditioner | None]:
        values = self._predict(self._curvature_observations)
        return hessian_product(0.5 * (values - values.detach()).square().mean(), self.parameters), None

    def _predict(self, observations: PyTorchObs) -> th.Tensor:
        # A policy of one's own may leave the axis of the one value out
        return self._policy.predict_values(observations).flatten() / value_scale(self._policy)


class _Fit:
    """Least squares to fixed targets, seen from wherever the last accepted step ended."""

    def __init__(self, model: _Values, targets: th.Tensor):
        self._model = model
        self._targets = targets
        self.values = model.values()

    @property
    def parameters(self) -> Sequence[th.Tensor]:
        """What a step moves."""
        return self._model.parameters

    @property
    def target_square(self) -> float:
        """
        Mean square of the targets, in the network's units: about 1 with a ``ValueHead`` that keeps to the returns.

        The curvature over the variance shrinks with its inverse, and what is added to the diagonal must follow.
        """
        return self._targets.cpu().double().square().mean().item() or 1.0

    @property
    def variance(self) -> float:
        r""":math:`\sigma^2` of the present values, in units of the squared value scale."""
        return (self.values - self._targets).square().mean().item()

    @property
    def is_exact(self) -> bool:
        """Whether all that is left between values and targets is rounding: a step would fit that."""
        rounding = 4.0 * th.finfo(self._targets.dtype).eps
        variance = self.variance
        # Not <=, which an infinite target would pass
        return variance == 0.0 or variance < rounding**2 * self.target_square

    def step(self, settings: TrustRegionSettings, shared: SharedStep | None = None) -> StepRecord:
        """One trust-region step from the present values."""
        before, constraint = self.values, None
        added: OutputMoments | None = NOTHING_ADDED
        if shared is not None:
            constraint = shared.constraint
            # To the curvature before its division by the variance
            added = shared.output_moments(constraint.weight(settings.radius) * self.variance)
        record = trust_region_step(replace(self._local_problem(added), constraint=constraint), settings)
        if not record.accepted:
            self.values = before
        return record

    def _local_problem(self, added: OutputMoments | None) -> LocalProblem:
        old_values, variance = self.values, self.variance
        product, preconditioner = self._model.curvature(added)

        def evaluate() -> tuple[float, float]:
            self.values = self._model.values()
            new_variance, change = self.variance, (self.values - old_values).square().mean().item()
            return -0.5 * new_variance / variance, 0.5 * change / variance

        return LocalProblem(
            name="value function",
            parameters=self._model.parameters,
            objective=-0.5,
            gradient=self._model.vjp((self._targets - old_values) / (len(old_values) * variance)),
            curvature=lambda vector: product(vector) / variance,
            evaluate=evaluate,
            precondition=None
            if preconditioner is None
            else lambda vector, damping: preconditioner(vector, 1.0 / variance, damping),
        )
