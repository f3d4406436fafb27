r"""Where :math:`\lambda` comes from when it is no fixed number: a schedule, or what the last batches showed."""

import copy
from collections.abc import Callable, Sequence
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch as th
from stable_baselines3.common.policies import ActorCriticPolicy

from sb3_gae.checks import check_choice, check_count, check_number, check_unit_interval
from sb3_gae.diagnostics.rollout_diagnostics import METRICS, expected_improvement, has_several_trajectories, lambda_errors
from sb3_gae.estimators.advantages import discounted_returns
from sb3_gae.estimators.measures import explained_variance
from sb3_gae.rollout.evaluation import precision_of, training_batch
from sb3_gae.rollout.rollout_buffer import GAERolloutBuffer
from sb3_gae.update.natural_gradients import has_natural_gradients
from sb3_gae.update.policy_step import policy_parameters

#: what :class:`MeasuredLambda` chooses from
MEASURED_LAMBDAS = (0.68, 0.84, 0.92, 0.96, 0.98, 0.99, 1.0)
#: what it may choose by
CRITERIA = ("squared_error", "improvement")


@runtime_checkable
class LambdaRule(Protocol):
    r"""
    A source of :math:`\lambda`. What it learns from one batch it applies to the next, so that no batch chooses its own.

    ``target_lambda`` is for the value targets where the user says nothing of them, None for that of the advantages. It is read
    after :meth:`value`.
    """

    @property
    def target_lambda(self) -> float | None:
        r""":math:`\lambda` of the value targets, in [0, 1]; None for that of the advantages."""

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

    target_lambda: float | None = None

    def __init__(self, schedule: Callable[[float], float]):
        self.schedule = schedule

    def value(self, progress_remaining: float) -> float:
        """
        :param progress_remaining: from 1 at the beginning of training to 0 at its end
        :return: what the schedule says, for the batch to come
        :raises ValueError: if that is no number in [0, 1]
        """
        value = self.schedule(progress_remaining)
        check_number("gae_lambda", value, 0.0, 1.0)
        return float(value)

    def learn_from(self, policy: ActorCriticPolicy, rollout_buffer: GAERolloutBuffer) -> dict[str, float]:
        """
        A schedule learns nothing.

        :param policy: not looked at
        :param rollout_buffer: not looked at
        :return: nothing to log
        """
        return {}


class ExplainedVarianceLambda:
    r"""
    The simple rule, for comparison: :math:`\lambda = 1 - (1 - \lambda_{min}) \max(EV, 0)`, with EV the explained variance of
    the returns, averaged over some batches. It cannot tell noisy returns from a bad value function.

    :param lowest: :math:`\lambda_{min}`, what a perfect value function gets, in [0, 1]
    :param memory: weight of the past in the average of the explained variance, in [0, 1)
    :raises ValueError: if a number is out of range
    """

    target_lambda: float | None = None

    def __init__(self, lowest: float = 0.9, memory: float = 0.8):
        check_number("lowest", lowest, 0.0, 1.0)
        check_number("memory", memory, 0.0, 1.0, below=True)
        self.lowest = lowest
        self.memory = memory
        self.explained_variance = 0.0

    def value(self, progress_remaining: float) -> float:
        r"""
        :param progress_remaining: from 1 at the beginning of training to 0 at its end; plays no part
        :return: for the batch to come, from :math:`\lambda_{min}` to 1; 1 before the first batch
        """
        return 1.0 - (1.0 - self.lowest) * max(self.explained_variance, 0.0)

    def learn_from(self, policy: ActorCriticPolicy, rollout_buffer: GAERolloutBuffer) -> dict[str, float]:
        """
        Take the batch into the average, unless its explained variance is not finite, as where all returns are equal. It counts
        as -1 at least: where they are nearly equal it has no bound.

        :param policy: not looked at
        :param rollout_buffer: full, with its advantages computed
        :return: the average, as ``explained_variance``; it begins at 0
        """
        buffer = rollout_buffer
        returns = discounted_returns(buffer.rewards, buffer.next_values, buffer.dones, buffer.gamma)
        found = explained_variance(buffer.values[buffer.mask], returns[buffer.mask])
        if np.isfinite(found):
            self.explained_variance = self.memory * self.explained_variance + (1.0 - self.memory) * max(found, -1.0)
        return {"explained_variance": self.explained_variance}


class MeasuredLambda:
    r"""
    The :math:`\lambda` of a grid that is best by what the batches themselves show of the policy gradient.

    What is measured (:func:`~sb3_gae.diagnostics.rollout_diagnostics.lambda_errors`) says little in one batch, so it is
    averaged over batches, each in units of its own variance at :math:`\lambda = 1` because gradients change their scale
    in training. From one batch to the next it moves by one place of the grid at most.

    :param lambdas: the grid, ascending and ending with 1, which counts as unbiased
    :param start: where to begin; the nearest of the grid
    :param memory: weight of the past in the averages, in [0, 1]
    :param patience: batches to watch before the first move
    :param criterion: ``"squared_error"`` for the least bias squared and variance, ``"improvement"`` for the largest
        :func:`~sb3_gae.diagnostics.rollout_diagnostics.expected_improvement`
    :param metric: of the gradients, ``"fisher"`` or ``"euclidean"``. Policies that are no MLP as SB3 builds it have
        the latter in any case
    :param largest_target_lambda: what :math:`\lambda` of the value targets is at most where ``value_lambda`` is None; below,
        it is that of the advantages. What is measured is of the policy gradient, and where that is best with long sums, this
        says nothing of the noise that the value function should be fitted to
    :raises ValueError: if the grid is no ascending list in [0, 1] that ends with 1, a number is out of range, or a name is
        unknown
    """

    def __init__(
        self,
        lambdas: Sequence[float] = MEASURED_LAMBDAS,
        start: float = 0.96,
        memory: float = 0.95,
        patience: int = 5,
        criterion: str = "squared_error",
        metric: str = "euclidean",
        largest_target_lambda: float = 0.96,
    ):
        check_unit_interval("lambdas", lambdas)
        if lambdas[-1] != 1.0 or not np.all(np.diff(lambdas) > 0):
            raise ValueError(f"`lambdas` must ascend and end with 1, got {lambdas!r}.")
        check_number("start", start, 0.0, 1.0)
        check_number("memory", memory, 0.0, 1.0)
        check_count("patience", patience, low=0)
        check_choice("criterion", criterion, CRITERIA)
        check_choice("metric", metric, METRICS)
        check_number("largest_target_lambda", largest_target_lambda, 0.0, 1.0)
        self.lambdas = tuple(lambdas)
        self.memory = memory
        self.patience = patience
        self.criterion = criterion
        self.metric = metric
        self.largest_target_lambda = largest_target_lambda
        self.place = int(np.argmin(np.abs(np.subtract(lambdas, start))))
        self._in_use = self.lambdas[self.place]
        self._sums = np.zeros((4, len(lambdas)))
        self._weight = 0.0
        self._n_batches = 0

    def value(self, progress_remaining: float) -> float:
        """
        Put into use what the batches so far have led to.

        :param progress_remaining: from 1 at the beginning of training to 0 at its end; plays no part
        :return: for the batch to come, a number of the grid
        """
        self._in_use = self.lambdas[self.place]
        return self._in_use

    @property
    def target_lambda(self) -> float:
        r"""The :math:`\lambda` in use, but at most ``largest_target_lambda``."""
        return min(self._in_use, self.largest_target_lambda)

    def learn_from(self, policy: ActorCriticPolicy, rollout_buffer: GAERolloutBuffer) -> dict[str, float]:
        r"""
        Measure the batch, take it into the averages, and move by one place of the grid at most.

        A batch of a single trajectory changes nothing, and neither does a measurement that fails or is not finite.

        :param policy: in evaluation mode, as it was when the rollout was collected
        :param rollout_buffer: full, with its advantages computed
        :return: the averages for each :math:`\lambda` of the grid, as ``<quantity>/lambda_<value>``: ``bias_squared`` and
            ``variance`` in units of the variance at :math:`\lambda = 1`, ``improvement`` in those of its square root. Nothing
            if the batch has changed nothing
        :raises ValueError: if the buffer is not full
        """
        if not has_several_trajectories(rollout_buffer):
            return {}
        try:
            errors = lambda_errors(policy, rollout_buffer, self.lambdas, metric=self._metric_for(policy, rollout_buffer))
        except th.linalg.LinAlgError:
            # Of the Fisher metric. A measurement that fails is none, and no reason to end a training
            return {}
        squared_length, scale = errors.squared_norm + errors.variance, errors.variance[-1]
        found = np.stack([errors.bias_squared, errors.variance, errors.inner_product, squared_length])
        if not np.isfinite(found).all() or scale <= 0.0:
            return {}
        self._sums = self.memory * self._sums + found / scale
        self._weight = self.memory * self._weight + 1.0
        self._n_batches += 1
        bias_squared, variance, inner_product, squared_length = self._sums / self._weight
        improvement = expected_improvement(inner_product, squared_length)
        if self._n_batches >= self.patience:
            self._move(improvement if self.criterion == "improvement" else -(np.maximum(bias_squared, 0.0) + variance))
        return {
            f"{quantity}/lambda_{gae_lambda:g}": float(estimate)
            for quantity, estimates in (("bias_squared", bias_squared), ("variance", variance), ("improvement", improvement))
            for gae_lambda, estimate in zip(self.lambdas, estimates, strict=True)
        }

    def _metric_for(self, policy: ActorCriticPolicy, rollout_buffer: GAERolloutBuffer) -> str:
        if self.metric == "euclidean":
            return self.metric
        batch = training_batch(rollout_buffer, policy.action_space, precision_of(policy))
        known = has_natural_gradients(policy, policy_parameters(policy, batch), batch)
        return self.metric if known else "euclidean"

    def _move(self, merit: np.ndarray) -> None:
        best = int(np.argmax(merit))
        # Where no step is expected to gain anything, noise is all there is to choose by
        if self.criterion != "improvement" or merit[best] > 0.0:
            self.place += int(np.sign(best - self.place))


#: what ``gae_lambda`` may be as a text
_NAMED_RULES: dict[str, Callable[[], LambdaRule]] = {
    "auto": MeasuredLambda,
    "improvement": lambda: MeasuredLambda(criterion="improvement", metric="fisher"),
    "explained_variance": ExplainedVarianceLambda,
}


def lambda_rule(gae_lambda: Any) -> LambdaRule | None:
    """
    :param gae_lambda: as :class:`~sb3_gae.TRPOGAE` takes it
    :return: a rule, None for a number, which needs none
    :raises ValueError: if it is none of what is allowed
    """
    if isinstance(gae_lambda, LambdaRule):
        # Two models must not learn in one
        return copy.deepcopy(gae_lambda)
    if callable(gae_lambda):
        return ScheduledLambda(gae_lambda)
    if isinstance(gae_lambda, str):
        if gae_lambda in _NAMED_RULES:
            return _NAMED_RULES[gae_lambda]()
        names = ", ".join(map(repr, _NAMED_RULES))
        raise ValueError(
            f"`gae_lambda` must be a number in [0, 1], a function of the remaining progress, a rule, or one of {names}, "
            f"got {gae_lambda!r}."
        )
    return None
