r"""
The gridworld demonstration at one step: policy, value function, the batch that the step will use, and the truth about it.

A moment is a value. The next one follows from it alone, and all chance from its seed and the number of its step, so that
the same controls give the same run, step for step.
"""

from dataclasses import dataclass, replace
from functools import cache, cached_property

import numpy as np

from sb3_gae.gridworld import (
    Episodes,
    GradientMoments,
    TabularMDP,
    TabularPolicy,
    angle,
    episode_advantages,
    episode_gradients,
    fitted_values,
    gridworld,
    optimal_values,
    sample_episodes,
)
from sb3_gae.lab.controls import Controls

#: standard deviation of the error of ``"noisy"`` values; returns lie between -1 and 1
NOISE = 0.6
#: episodes are cut after so many steps; with the presets none is ever as long
MAX_STEPS = 500
#: how far the logits of a cell may be from their mean, so that every move keeps some probability and every episode ends
MAX_LOGIT = 6.0


@dataclass(frozen=True)
class Moment:
    """
    :param logits: of the policy, shape (S, A)
    :param learned: values fitted to the batches before, shape (S,)
    :param frozen: values of ``"frozen"``, shape (S,)
    :param controls: in use
    :param seed: of all randomness
    :param step: how many steps were taken
    """

    logits: np.ndarray
    learned: np.ndarray
    frozen: np.ndarray
    controls: Controls
    seed: int = 0
    step: int = 0

    @cached_property
    def policy(self) -> TabularPolicy:
        """Acting in the default gridworld."""
        return TabularPolicy(world(), self.logits)

    @cached_property
    def exact_values(self) -> np.ndarray:
        """Those of the policy, shape (S,)."""
        return self.policy.values(self.controls.gamma)

    @cached_property
    def values(self) -> np.ndarray:
        """What the estimator takes for V before the batch is seen, shape (S,)."""
        match self.controls.value_function:
            case "learned":
                return self.learned
            case "zero":
                return np.zeros_like(self.learned)
            case "noisy":
                return np.where(world().terminal, 0.0, self.exact_values + _noise(self.seed))
            case "frozen":
                return self.frozen
        return self.exact_values

    @cached_property
    def batch(self) -> Episodes:
        """Episodes of this step."""
        generator = np.random.default_rng((self.seed, 0, self.step))
        return sample_episodes(self.policy, self.controls.batch_size, generator, MAX_STEPS)

    @cached_property
    def fitted(self) -> np.ndarray:
        """The learned values after the batch: its mean return from each cell that it visited, shape (S,)."""
        visited = np.isin(np.arange(len(self.learned)), self.batch.states[self.batch.mask])
        return np.where(visited, fitted_values(self.policy, self.batch, self.controls.gamma), self.learned)

    @cached_property
    def estimator_values(self) -> np.ndarray:
        """V with which the advantages of the batch are estimated, shape (S,)."""
        fits_first = self.controls.order == "value_first" and self.controls.value_function == "learned"
        return self.fitted if fits_first else self.values

    @cached_property
    def advantages(self) -> np.ndarray:
        """GAE at each step of the batch, shape (T, N)."""
        controls = self.controls
        return episode_advantages(self.policy, self.batch, self.estimator_values, controls.gamma, controls.gae_lambda)

    @cached_property
    def batch_gradient(self) -> np.ndarray:
        """Mean over the episodes of the batch, shape (S, A)."""
        return episode_gradients(self.policy, self.batch, self.advantages).mean(axis=0)

    @cached_property
    def true_gradient(self) -> np.ndarray:
        """By linear solves, shape (S, A)."""
        return self.policy.true_gradient(self.controls.gamma)

    @cached_property
    def moments(self) -> GradientMoments:
        """Exact mean and variance of the gradient estimate of one episode, for values that have not seen it."""
        return self.policy.gradient_moments(self.values, self.controls.gamma, self.controls.gae_lambda)

    @property
    def bias_angle(self) -> float:
        """Between expected and true gradient, in radians."""
        return angle(self.moments.mean, self.true_gradient)

    @property
    def variance(self) -> float:
        """Of the batch's gradient, exact: the trace of its covariance."""
        return self.moments.variance / self.controls.batch_size

    @property
    def share_of_gradient(self) -> float:
        """Component of the batch's gradient along the true one, in units of its length: 1 on average if unbiased."""
        return float((self.batch_gradient * self.true_gradient).sum() / np.square(self.true_gradient).sum())

    @property
    def score(self) -> float:
        """Expected discounted return of the policy, in units of the best possible."""
        return float(world().start @ self.exact_values) / best_return(self.controls.gamma)

    def with_controls(self, controls: Controls) -> "Moment":
        """
        :param controls: from now on
        :return: the same moment under these controls; values that are to be frozen are those in use now
        """
        freezes = controls.value_function == "frozen" != self.controls.value_function
        moment = replace(self, controls=controls, frozen=self.values.copy() if freezes else self.frozen)
        # A drag asks for the same things many times a second
        kept = {"policy"}
        if controls.batch_size == self.controls.batch_size:
            kept.add("batch")
        if controls.gamma == self.controls.gamma:
            kept |= {"exact_values", "true_gradient"}
        vars(moment).update({name: value for name, value in vars(self).items() if name in kept})
        return moment

    def next(self) -> "Moment":
        """:return: after one policy-gradient ascent step and a fit of the learned values to the batch"""
        logits = self.logits + self.controls.learning_rate * self.batch_gradient
        logits = np.clip(logits - logits.mean(axis=1, keepdims=True), -MAX_LOGIT, MAX_LOGIT)
        return replace(self, logits=logits, learned=self.fitted, step=self.step + 1)


def first_moment(controls: Controls, seed: int = 0) -> Moment:
    """
    :param controls: to begin with
    :param seed: of all randomness
    :return: the uniform policy; learned values are zero, frozen ones exact
    """
    logits = np.zeros((world().n_states, world().n_actions))
    exact = TabularPolicy(world(), logits).values(controls.gamma)
    return Moment(logits, np.zeros(world().n_states), exact, controls, seed)


@cache
def world() -> TabularMDP:
    """:return: the one gridworld of the demonstration"""
    return gridworld()


@cache
def best_return(gamma: float) -> float:
    r"""
    :param gamma: discount factor in [0, 1]
    :return: expected discounted return of the best policy; 1 for :math:`\gamma = 0`, with which nothing is ever in sight
    """
    return float(world().start @ optimal_values(world(), gamma)) or 1.0


@cache
def _noise(seed: int) -> np.ndarray:
    return NOISE * np.random.default_rng((seed, 1)).normal(size=world().n_states)
