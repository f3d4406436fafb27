"""
Brute force that the tests compare with: direct sums, enumerated expectations, dense matrices.

None of it repeats an algorithm of the package, and all of it is in double precision.
"""

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from stable_baselines3.common.distributions import (
    BernoulliDistribution,
    CategoricalDistribution,
    Distribution,
    MultiCategoricalDistribution,
)
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, FlattenExtractor
from torch import nn

from sb3_gae.batch import TrainingBatch
from sb3_gae.networks.parameters import flatten
from sb3_gae.networks.policies import MlpPolicy

# --- Rollouts ---


@dataclass
class Rollout:
    """Random numbers and endings, shape (T, N); ``last_values`` has shape (N,)."""

    rewards: np.ndarray
    values: np.ndarray
    last_values: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray
    bootstrap_values: np.ndarray

    @property
    def dones(self) -> np.ndarray:
        return self.terminated | self.truncated

    @property
    def next_values(self) -> np.ndarray:
        """Case by case, as the docstring of ``next_state_values`` has it."""
        result = np.empty_like(self.values)
        for t, n in np.ndindex(*result.shape):
            if self.terminated[t, n]:
                result[t, n] = 0.0
            elif self.truncated[t, n]:
                result[t, n] = self.bootstrap_values[t, n]
            else:
                result[t, n] = self.last_values[n] if t + 1 == len(result) else self.values[t + 1, n]
        return result


@st.composite
def rollouts(
    draw: st.DrawFn, dtype: type = np.float32, scales: Sequence[float] = (1e-30, 1.0, 1e30), both: bool = True
) -> Rollout:
    """
    Few steps and environments, with constant rewards, one-step episodes and endings of both kinds among the examples.

    :param both: whether a step may be terminated and truncated at once
    """
    shape = draw(st.integers(1, 9)), draw(st.integers(1, 3))
    scale = draw(st.sampled_from(scales))

    def numbers(shape: tuple[int, ...]) -> np.ndarray:
        elements = st.floats(-1.0, 1.0, width=32, allow_subnormal=False)
        return draw(st.one_of(arrays(dtype, shape, elements=elements), arrays(dtype, shape, elements=st.just(0.7)))) * dtype(
            scale
        )

    def flags() -> np.ndarray:
        return draw(st.one_of(arrays(bool, shape), arrays(bool, shape, elements=st.sampled_from([False] * 4 + [True]))))

    terminated = draw(st.just(np.ones(shape, dtype=bool))) if draw(st.integers(0, 9)) == 0 else flags()
    truncated = flags()
    if not both:
        truncated &= ~terminated
    return Rollout(numbers(shape), numbers(shape), numbers(shape[1:]), terminated, truncated, numbers(shape))


def discounted_sums(terms: np.ndarray, dones: np.ndarray, decay: float) -> np.ndarray:
    """:math:`\\sum_l` ``decay``\\ :math:`^l` ``terms[t + l]`` to the end of the episode or of the rollout, term by term."""
    result = np.zeros(terms.shape)
    for t, n in np.ndindex(*terms.shape):
        last = last_step(dones, t, n)
        result[t, n] = math.fsum(decay**step * float(terms[t + step, n]) for step in range(last - t + 1))
    return result


def last_step(dones: np.ndarray, t: int, n: int) -> int:
    """Index of the last step of the episode that step ``t`` belongs to, as far as the rollout goes."""
    endings = np.flatnonzero(dones[t:, n])
    return t + int(endings[0]) if len(endings) else len(dones) - 1


def direct_advantages(rollout: Rollout, gamma: float, gae_lambda: float) -> np.ndarray:
    """The paper's equation 16, term by term."""
    rewards, values, next_values = (
        array.astype(np.float64) for array in (rollout.rewards, rollout.values, rollout.next_values)
    )
    return discounted_sums(rewards + gamma * next_values - values, rollout.dones, gamma * gae_lambda)


def advantage_magnitudes(rollout: Rollout, gamma: float, gae_lambda: float) -> np.ndarray:
    """What rounding errors of the advantages are relative to: the same sum without cancellation."""
    rewards, values, next_values = (
        np.abs(array.astype(np.float64)) for array in (rollout.rewards, rollout.values, rollout.next_values)
    )
    return discounted_sums(rewards + gamma * next_values + values, rollout.dones, gamma * gae_lambda)


def assert_equal_to_rounding(actual: np.ndarray, expected: np.ndarray, magnitudes: np.ndarray) -> None:
    """Each entry within a few units of rounding of ``actual``'s type, for each step of the sums."""
    assert actual.shape == expected.shape
    limits = np.finfo(actual.dtype)
    tolerance = 4 * (len(magnitudes) + 2) * (limits.eps * magnitudes + float(limits.tiny))
    difference = np.abs(actual.astype(np.float64) - expected)
    assert (difference <= tolerance).all(), f"off by {(difference / tolerance).max():.3g} times the tolerance"


# --- Policies ---


class DoubleFeatures(FlattenExtractor):
    """Observations as they are, in the double precision that SB3's preprocessing takes away."""

    def forward(self, observations: th.Tensor) -> th.Tensor:
        return super().forward(observations).double()


class DoubleConvolution(BaseFeaturesExtractor):
    """The least there is to an image features extractor."""

    def __init__(self, observation_space: spaces.Box):
        super().__init__(observation_space, features_dim=8)
        self.layers = nn.Sequential(nn.Conv2d(1, 2, kernel_size=3), nn.Tanh(), nn.Flatten()).double()

    def forward(self, observations: th.Tensor) -> th.Tensor:
        return self.layers(observations.double())


ACTION_SPACES: dict[str, spaces.Space] = {
    "Box": spaces.Box(-1.0, 1.0, (2,)),
    "Discrete": spaces.Discrete(3),
    "MultiDiscrete": spaces.MultiDiscrete([3, 2]),
    "MultiBinary": spaces.MultiBinary(3),
}

#: a convolution that policy and value function share
OF_IMAGES: dict[str, Any] = dict(
    observation_space=spaces.Box(0, 255, (1, 4, 4), dtype=np.uint8), features_extractor_class=DoubleConvolution
)


def double_policy(
    action_space: spaces.Space, n_inputs: int = 3, policy_class: type[ActorCriticPolicy] = MlpPolicy, seed: int = 0, **kwargs
) -> ActorCriticPolicy:
    """A small policy in double precision, away from the almost uniform one that SB3 starts with."""
    th.manual_seed(seed)
    arguments = dict(net_arch=dict(pi=[5, 4], vf=[4]), ortho_init=False, features_extractor_class=DoubleFeatures) | kwargs
    observation_space = arguments.pop("observation_space", spaces.Box(-np.inf, np.inf, (n_inputs,)))
    policy = policy_class(observation_space, action_space, lambda _: 1e-3, **arguments).double()
    policy.set_training_mode(False)
    with th.no_grad():
        for parameter in policy.parameters():
            parameter.add_(0.2 * th.randn_like(parameter))
    return policy


def observations_for(policy: ActorCriticPolicy, n_samples: int, seed: int = 1) -> th.Tensor:
    generator = th.Generator().manual_seed(seed)
    space = policy.observation_space
    if space.dtype == np.uint8:
        return th.randint(256, (n_samples, *space.shape), generator=generator, dtype=th.uint8)
    return th.randn(n_samples, *space.shape, generator=generator)


def training_batch(policy: ActorCriticPolicy, n_samples: int = 30, seed: int = 1) -> TrainingBatch:
    """Actions of the policy itself, with random advantages and value targets."""
    observations = observations_for(policy, n_samples, seed)
    th.manual_seed(seed)
    with th.no_grad():
        if hasattr(policy.action_dist, "sample_weights"):
            policy.reset_noise(n_samples)
        actions = policy.get_distribution(observations).get_actions()
    return TrainingBatch(observations, actions, th.randn(n_samples).double(), 3.0 + 2.0 * th.randn(n_samples).double())


def state_of(policy: nn.Module) -> dict[str, th.Tensor]:
    return {name: value.clone() for name, value in policy.state_dict().items()}


def moved(before: dict[str, th.Tensor], policy: nn.Module) -> set[str]:
    """Names of what is not bit for bit what it was."""
    return {name for name, value in policy.state_dict().items() if not th.equal(value, before[name])}


# --- Dense matrices ---


def jacobian(function: Callable[[], th.Tensor], parameters: Sequence[th.Tensor]) -> th.Tensor:
    """
    One backward pass for each output.

    :return: shape (outputs, n)
    """
    rows = []
    for output in function().reshape(-1):
        gradients = th.autograd.grad(output, parameters, retain_graph=True, allow_unused=True, materialize_grads=True)
        rows.append(flatten(gradients))
    return th.stack(rows)


def dense_matrix(product: Callable[[th.Tensor], th.Tensor], n: int) -> th.Tensor:
    """The matrix that a function multiplies by, column by column."""
    return th.stack([product(column) for column in th.eye(n, dtype=th.float64)], dim=1)


def fisher_matrix(policy: ActorCriticPolicy, observations: th.Tensor, parameters: Sequence[th.Tensor]) -> th.Tensor:
    r"""
    Mean over the observations of :math:`E_a[\nabla\log\pi(a|s)\,\nabla\log\pi(a|s)^\top]`, by its definition.

    The expectation is a finite sum: over all actions, or over the nodes of a quadrature that is exact for Gaussians,
    whose scores are quadratic in the action.
    """
    total = 0.0
    with th.no_grad():
        weighted = list(actions_and_weights(policy.get_distribution(observations), len(observations)))
    for actions, weights in weighted:
        scores = jacobian(lambda: policy.get_distribution(observations).log_prob(actions), parameters)  # noqa: B023
        total = total + scores.t() @ (weights[:, None] * scores)
    return total / len(observations)


def actions_and_weights(distribution: Distribution, n_samples: int):
    """Pairs of an action for each sample, and its probability or quadrature weight, shape (B,)."""
    if isinstance(distribution, CategoricalDistribution):
        choices = [range(distribution.action_dim)]
    elif isinstance(distribution, MultiCategoricalDistribution):
        choices = [range(size) for size in distribution.action_dims]
    elif isinstance(distribution, BernoulliDistribution):
        choices = [range(2)] * distribution.action_dims
    else:
        yield from _quadrature(distribution.distribution.mean, distribution.distribution.stddev)
        return
    for choice in itertools.product(*choices):
        action = th.tensor(choice, dtype=th.float64).expand(n_samples, -1)
        action = action[:, 0].long() if isinstance(distribution, CategoricalDistribution) else action
        yield action, distribution.log_prob(action).exp()


def _quadrature(mean: th.Tensor, deviation: th.Tensor):
    """Gauss-Hermite with three nodes a dimension: exact for polynomials up to the fifth degree."""
    nodes, weights = np.polynomial.hermite_e.hermegauss(3)
    weights = weights / weights.sum()
    for index in itertools.product(range(3), repeat=mean.shape[1]):
        offset = th.tensor(nodes[list(index)])
        yield mean + deviation * offset, th.full((len(mean),), float(np.prod(weights[list(index)])), dtype=th.float64)
