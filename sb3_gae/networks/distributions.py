"""What the trust region asks of SB3's action distributions: divergence, Fisher metric, and building them from a network."""

import copy
from collections.abc import Callable, Sequence
from typing import Any, TypeVar, cast

import torch as th
from stable_baselines3.common.distributions import (
    BernoulliDistribution,
    CategoricalDistribution,
    DiagGaussianDistribution,
    Distribution,
    MultiCategoricalDistribution,
    kl_divergence,
)

from sb3_gae.networks.diagonal_gaussian import DiagonalGaussian

OutputMetric = Callable[[th.Tensor, slice], th.Tensor]
#: over the actions of a batch: one of SB3's, or the one here that stands in for it
ActionDistribution = Distribution | DiagonalGaussian
AnyDistribution = TypeVar("AnyDistribution", bound=ActionDistribution)


def snapshot(distribution: AnyDistribution) -> AnyDistribution:
    """
    SB3 policies own one distribution object and refill it at every call; this one stays as it is now.

    :param distribution: of any kind; a graph that it has stays attached
    :return: a shallow copy
    """
    return copy.copy(distribution)


def mean_kl(old: ActionDistribution, new: ActionDistribution) -> th.Tensor:
    r"""
    Mean over the batch of :math:`D_{KL}(\pi_{old} \| \pi_{new})`, summed over independent action dimensions.

    :param old: distribution for each state of the batch
    :param new: likewise
    :return: a scalar, in nats
    """
    if isinstance(old, DiagonalGaussian) and isinstance(new, DiagonalGaussian):
        return old.mean_kl(new)
    divergence = kl_divergence(cast(Distribution, old), cast(Distribution, new))
    return divergence.reshape(len(divergence), -1).sum(dim=1).mean()


def has_known_metric(distribution: Distribution) -> bool:
    """
    :param distribution: a policy's ``action_dist``
    :return: whether its Fisher metric is known in closed form; a subclass may be something else
    """
    return type(distribution) in {DiagGaussianDistribution, *_FISHER_METRICS}


def distribution_from_outputs(
    distribution: Distribution, outputs: th.Tensor, log_std: Sequence[th.Tensor]
) -> ActionDistribution:
    """
    :param distribution: a policy's ``action_dist`` that :func:`has_known_metric`; refilled, unless it is a Gaussian
    :param outputs: means or logits of the last layer, shape (B, n_out)
    :param log_std: for a Gaussian, one tensor of shape (n_actions,); nothing for the others
    :return: the distribution with these outputs
    """
    if type(distribution) is DiagGaussianDistribution:
        return DiagonalGaussian(outputs, *log_std)
    return distribution.proba_distribution(outputs, *log_std)


def _gaussian_metric(distribution: DiagonalGaussian) -> OutputMetric:
    precision = distribution.precision
    return lambda tangents, rows: tangents * precision


def _categorical_metric(distribution: CategoricalDistribution) -> OutputMetric:
    probabilities = distribution.distribution.probs
    return lambda tangents, rows: _softmax_metric(tangents, probabilities[rows])


def _multi_categorical_metric(distribution: MultiCategoricalDistribution) -> OutputMetric:
    per_action = [categorical.probs for categorical in distribution.distribution]
    sizes = [probabilities.shape[1] for probabilities in per_action]

    def metric(tangents: th.Tensor, rows: slice) -> th.Tensor:
        parts = zip(tangents.split(sizes, dim=1), per_action, strict=True)
        return th.cat([_softmax_metric(part, probabilities[rows]) for part, probabilities in parts], dim=1)

    return metric


def _bernoulli_metric(distribution: BernoulliDistribution) -> OutputMetric:
    probabilities = distribution.distribution.probs
    variance = probabilities * (1.0 - probabilities)
    return lambda tangents, rows: tangents * variance[rows]


def _softmax_metric(tangents: th.Tensor, probabilities: th.Tensor) -> th.Tensor:
    weighted = probabilities * tangents
    return weighted - probabilities * weighted.sum(dim=1, keepdim=True)


# A Gaussian policy's is not here: what stands in for SB3's distribution has it
_FISHER_METRICS: dict[type, Callable[[Any], OutputMetric]] = {
    CategoricalDistribution: _categorical_metric,
    MultiCategoricalDistribution: _multi_categorical_metric,
    BernoulliDistribution: _bernoulli_metric,
}


def fisher_metric(distribution: ActionDistribution) -> OutputMetric:
    r"""
    Fisher information of a distribution in the coordinates of its last layer: :math:`M` in :math:`J^\top M J`.

    Gaussian means: :math:`1/\sigma^2`. Logits of a categorical: :math:`\mathrm{diag}(p) - pp^\top`.
    Logits of a Bernoulli: :math:`p(1-p)`.

    :param distribution: of :func:`distribution_from_outputs`, without a graph
    :return: applies :math:`M` to the output tangents of a slice of the batch
    """
    if isinstance(distribution, DiagonalGaussian):
        return _gaussian_metric(distribution)
    return _FISHER_METRICS[type(distribution)](distribution)
