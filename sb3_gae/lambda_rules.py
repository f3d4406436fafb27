r"""Where :math:`\lambda` comes from when it is no fixed number: a schedule, or what the last batches showed."""

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import numpy as np
from stable_baselines3.common.policies import ActorCriticPolicy

from sb3_gae.advantages import discounted_returns
from sb3_gae.checks import check_number, check_unit_interval
from sb3_gae.diagnostics import explained_variance
from sb3_gae.rollout_buffer import GAERolloutBuffer
from sb3_gae.rollout_diagnostics import has_several_trajectories, lambda_errors

#: what :class:`MeasuredLambda` chooses from
MEASURED_LAMBDAS = (0.68, 0.84, 0.92, 0.96, 0.98, 0.99, 1.0)


class LambdaRule(Protocol):
    r"""A source of :math:`\lambda`. What it learns from one batch it applies to the next, so that no batch chooses its own."""

    def value(self, progress_remaining: float) -> float:
        """
        :param progress_remaining: from 1 at the beginning of training to 0 at its end
        :return: for the batch to come
        """

    def learn_from(self, policy: ActorCriticPolicy, rollout_buffer: GAERolloutBuffer) -> dict[str, float]:
        """
        :param policy: in evaluation mode, as it was when the rollout was collected
        :param rollout_buffer: full, with its advantages computed
        :return: what to log
        """


class ScheduledLambda:
    r"""
    :math:`\lambda` as a function of the progress, as SB3 has learning rates.

    :param schedule: of the remaining progress, from 1 to 0
    """

    def __init__(self, schedule: Callable[[float], float]):
        self.schedule = schedule

    def value(self, progress_remaining: float) -> float:
        value = float(self.schedule(progress_remaining))
        check_number("gae_lambda", value, 0.0, 1.0)
        return value

    def learn_from(self, policy: ActorCriticPolicy, rollout_buffer: GAERolloutBuffer) -> dict[str, float]:
        return {}


class ExplainedVarianceLambda:
    r"""
    The simple rule, for comparison: :math:`\lambda = 1 - (1 - \lambda_{min}) \max(EV, 0)`, with EV the explained variance of
    the returns, averaged over some batches. It cannot tell noisy returns from a bad value function.

    :param lowest: :math:`\lambda_{min}`, what a perfect value function gets
    :param memory: weight of the past in the average of the explained variance
    """

    def __init__(self, lowest: float = 0.9, memory: float = 0.8):
        self.lowest = lowest
        self.memory = memory
        self.explained_variance = 0.0

    def value(self, progress_remaining: float) -> float:
        return 1.0 - (1.0 - self.lowest) * max(self.explained_variance, 0.0)

    def learn_from(self, policy: ActorCriticPolicy, rollout_buffer: GAERolloutBuffer) -> dict[str, float]:
        buffer = rollout_buffer
        returns = discounted_returns(buffer.rewards, buffer.next_values, buffer.dones, buffer.gamma)
        found = explained_variance(buffer.values[buffer.mask], returns[buffer.mask])
        if np.isfinite(found):
            self.explained_variance = self.memory * self.explained_variance + (1.0 - self.memory) * found
        return {"explained_variance": self.explained_variance}


class MeasuredLambda:
    r"""
    The :math:`\lambda` of a grid whose policy gradient has the least mean squared error, bias and variance together.

    Both are estimated from the batch itself (:func:`~sb3_gae.rollout_diagnostics.lambda_errors`). A batch alone says
    little, so the estimates are averaged over batches, each in units of its own variance at :math:`\lambda = 1`
    because gradients change their scale in training. From one batch to the next it moves by one place of the grid at most.

    :param lambdas: the grid, ascending and ending with 1, which counts as unbiased
    :param start: where to begin; the nearest of the grid
    :param memory: weight of the past in the averages
    :param patience: batches to watch before the first move
    :raises ValueError: if the grid is no ascending list in [0, 1] that ends with 1
    """

    def __init__(
        self, lambdas: Sequence[float] = MEASURED_LAMBDAS, start: float = 0.96, memory: float = 0.95, patience: int = 5
    ):
        check_unit_interval("lambdas", lambdas)
        if lambdas[-1] != 1.0 or not np.all(np.diff(lambdas) > 0):
            raise ValueError(f"`lambdas` must ascend and end with 1, got {lambdas!r}.")
        self.lambdas = tuple(lambdas)
        self.memory = memory
        self.patience = patience
        self.place = int(np.argmin(np.abs(np.subtract(lambdas, start))))
        self._sums = np.zeros((2, len(lambdas)))
        self._weight = 0.0
        self._n_batches = 0

    def value(self, progress_remaining: float) -> float:
        return self.lambdas[self.place]

    def learn_from(self, policy: ActorCriticPolicy, rollout_buffer: GAERolloutBuffer) -> dict[str, float]:
        if not has_several_trajectories(rollout_buffer):
            return {}
        errors = lambda_errors(policy, rollout_buffer, self.lambdas)
        scale = errors.variance[-1]
        if not np.isfinite(errors.squared_error).all() or scale <= 0.0:
            return {}
        self._sums = self.memory * self._sums + np.stack([errors.bias_squared, errors.variance]) / scale
        self._weight = self.memory * self._weight + 1.0
        self._n_batches += 1
        bias_squared, variance = self._sums / self._weight
        if self._n_batches >= self.patience:
            self._move(np.maximum(bias_squared, 0.0) + variance)
        return {
            f"{quantity}/lambda_{gae_lambda:g}": float(estimate)
            for quantity, estimates in (("bias_squared", bias_squared), ("variance", variance))
            for gae_lambda, estimate in zip(self.lambdas, estimates, strict=True)
        }

    def _move(self, squared_error: np.ndarray) -> None:
        best = int(np.argmin(squared_error))
        self.place += int(np.sign(best - self.place))


def lambda_rule(gae_lambda: Any) -> LambdaRule | None:
    """
    :param gae_lambda: as :class:`~sb3_gae.TRPOGAE` takes it
    :return: a rule, None for a number, which needs none
    :raises ValueError: if it is none of what is allowed
    """
    if callable(gae_lambda):
        return ScheduledLambda(gae_lambda)
    if isinstance(gae_lambda, str):
        if gae_lambda == "auto":
            return MeasuredLambda()
        if gae_lambda == "explained_variance":
            return ExplainedVarianceLambda()
        raise ValueError(
            "`gae_lambda` must be a number in [0, 1], a function of the remaining progress, 'auto' or 'explained_variance', "
            f"got {gae_lambda!r}."
        )
    return None
