"""Callbacks for training."""

import pathlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import ActorCriticPolicy

from sb3_gae.callback_tree import check_hears_of_rollouts
from sb3_gae.checks import check_count, check_number, check_unit_interval
from sb3_gae.diagnostics.rollout_diagnostics import LambdaErrors, has_several_trajectories, lambda_errors
from sb3_gae.diagnostics.rollout_file import record, save_rollout
from sb3_gae.estimators.measures import ValueErrors, value_errors
from sb3_gae.presets import PAPER_LAMBDAS
from sb3_gae.rollout.rollout_buffer import GAERolloutBuffer, LambdaSweep

# Of SB3's 36 characters three are the indent below the group's name
_LONGEST_KEY_OF_A_TABLE = 33


class _OfRollouts(BaseCallback):
    """Acts at the end of rollouts."""

    def _init_callback(self) -> None:
        check_hears_of_rollouts(self)

    def _on_training_start(self) -> None:
        check_hears_of_rollouts(self)

    def _on_step(self) -> bool:
        return True


class LambdaSweepCallback(_OfRollouts):
    r"""
    Logs, after each rollout, what other :math:`\lambda` would have made of it. Needs no further samples.

    Keys are ``sweep/<quantity>/lambda_<value>``, the quantities those of :class:`~sb3_gae.LambdaSweep`. Those too long for
    SB3's table are in the other logs alone.
    The summary of the last rollout is in ``self.sweep``.

    :param lambdas: weights of longer estimates, each in [0, 1]
    :param gamma: discount factor, None for the one in training
    :param verbose: as for SB3's callbacks
    :raises ValueError: if a number is out of range
    """

    def __init__(self, lambdas: Sequence[float] = PAPER_LAMBDAS, gamma: float | None = None, verbose: int = 0):
        super().__init__(verbose)
        _check_factors(lambdas, gamma)
        self.lambdas = tuple(lambdas)
        self.gamma = gamma
        self.sweep: LambdaSweep | None = None

    def _on_rollout_end(self) -> None:
        self.sweep = _rollout_buffer(self).lambda_sweep(self.lambdas, self.gamma)
        _log(self, "sweep", self.sweep, self.lambdas)


class GradientDiagnosticsCallback(_OfRollouts):
    r"""
    Logs, after a rollout, how far the policy gradient is off with each :math:`\lambda`: bias, variance and their sum.

    Estimated from the rollout itself, see :func:`~sb3_gae.diagnostics.rollout_diagnostics.lambda_errors`, with the policy that
    collected it. A single rollout says little; average the curves over several. A rollout of a single trajectory is left out.

    Keys are ``gradient/<quantity>/lambda_<value>``, the quantities those of :class:`~sb3_gae.LambdaErrors`,
    too long ones not in SB3's table. The estimates of the last rollout that had any are in ``self.errors``. Beside them, to
    compare: ``value_error/<measure>`` with the measures of :class:`~sb3_gae.estimators.measures.ValueErrors`, which are in
    ``self.value_errors``, and ``value_error/policy_gradient``, the bias squared at :math:`\lambda = 0`
    (:func:`~sb3_gae.diagnostics.rollout_diagnostics.policy_gradient_value_error`).

    :param lambdas: weights of longer estimates, each in [0, 1]
    :param every: rollouts from one estimate to the next, the first rollout being the first
    :param n_groups: of trajectories to compare; more than 16 lower the noise little
    :param gamma: discount factor, None for the one in training
    :param verbose: as for SB3's callbacks
    :raises ValueError: if a number is out of range
    """

    def __init__(
        self,
        lambdas: Sequence[float] = PAPER_LAMBDAS,
        every: int = 1,
        n_groups: int = 16,
        gamma: float | None = None,
        verbose: int = 0,
    ):
        super().__init__(verbose)
        check_count("every", every)
        check_count("n_groups", n_groups, low=2)
        _check_factors(lambdas, gamma)
        self.lambdas = tuple(lambdas)
        self.every = every
        self.n_groups = n_groups
        self.gamma = gamma
        self.errors: LambdaErrors | None = None
        self.value_errors: ValueErrors | None = None
        self._n_rollouts = 0

    def _on_rollout_end(self) -> None:
        rollout_buffer = _rollout_buffer(self)
        due, self._n_rollouts = self._n_rollouts % self.every == 0, self._n_rollouts + 1
        if not due or not has_several_trajectories(rollout_buffer):
            return
        policy = self.model.policy
        assert isinstance(policy, ActorCriticPolicy)
        # λ = 0 for the value function's error as the policy gradient sees it
        lambdas = self.lambdas if 0.0 in self.lambdas else (*self.lambdas, 0.0)
        with _evaluation_mode(policy):
            errors = lambda_errors(policy, rollout_buffer, lambdas, self.gamma, self.n_groups)
        self.errors = LambdaErrors(*(array[: len(self.lambdas)] for array in errors))
        self.value_errors = _value_errors(rollout_buffer, self.gamma)
        _log(self, "gradient", self.errors, self.lambdas)
        for measure, value in self.value_errors._asdict().items():
            self.logger.record(f"value_error/{measure}", value)
        self.logger.record("value_error/policy_gradient", float(errors.bias_squared[lambdas.index(0.0)]))


class SaveRolloutCallback(_OfRollouts):
    r"""
    Saves each rollout as it ends, in the place of the one before, for ``python -m sb3_gae.gridworld --rollout``.

    What is saved serves to redo advantages, bias and variance with any :math:`\gamma` and :math:`\lambda`;
    see :mod:`sb3_gae.diagnostics.rollout_file`. Scores of single steps take about as long as an update of 2 000 steps.

    :param path: of the file
    :param name: of what is recorded, None for the environment's
    :param every: rollouts from one saved to the next, the first rollout being the first
    :param verbose: as for SB3's callbacks
    :raises ValueError: if a number is out of range
    """

    def __init__(self, path: str | pathlib.Path, name: str | None = None, every: int = 1, verbose: int = 0):
        super().__init__(verbose)
        check_count("every", every)
        self.path = path
        self.name = name
        self.every = every
        self._n_rollouts = 0

    def _on_rollout_end(self) -> None:
        due, self._n_rollouts = self._n_rollouts % self.every == 0, self._n_rollouts + 1
        if not due:
            return
        rollout_buffer, policy = _rollout_buffer(self), self.model.policy
        assert isinstance(policy, ActorCriticPolicy)
        with _evaluation_mode(policy):
            recorded = record(policy, rollout_buffer, self.name or _task_name(self), rollout_buffer.gae_lambda)
        save_rollout(recorded, self.path)


def _check_factors(lambdas: Sequence[float], gamma: float | None) -> None:
    check_unit_interval("lambdas", lambdas)
    if gamma is not None:
        check_number("gamma", gamma, 0.0, 1.0)


def _task_name(callback: BaseCallback) -> str:
    spec = callback.training_env.get_attr("spec", 0)[0]
    return "a task without a name" if spec is None else str(spec.id)


def _rollout_buffer(callback: BaseCallback) -> GAERolloutBuffer:
    rollout_buffer = callback.locals["rollout_buffer"]
    if not isinstance(rollout_buffer, GAERolloutBuffer):
        name = type(callback).__name__
        raise TypeError(f"{name} needs a sb3_gae.GAERolloutBuffer, got {type(rollout_buffer).__name__}.")
    return rollout_buffer


def _value_errors(rollout_buffer: GAERolloutBuffer, gamma: float | None) -> ValueErrors:
    return value_errors(
        rollout_buffer.rewards,
        rollout_buffer.values,
        rollout_buffer.next_values,
        rollout_buffer.dones,
        rollout_buffer.gamma if gamma is None else gamma,
        rollout_buffer.mask,
    )


def _log(callback: BaseCallback, group: str, curves: Any, lambdas: Sequence[float]) -> None:
    labels = [f"{gae_lambda:g}" for gae_lambda in lambdas]
    if len(set(labels)) < len(labels):
        labels = [repr(float(gae_lambda)) for gae_lambda in lambdas]
    for quantity, values in curves._asdict().items():
        if quantity != "gae_lambda":
            for label, value in zip(labels, values, strict=True):
                key = f"{quantity}/lambda_{label}"
                # SB3's table cuts longer keys, and ends training where two of them are then the same
                too_long = len(key) > _LONGEST_KEY_OF_A_TABLE
                callback.logger.record(f"{group}/{key}", float(value), exclude="stdout" if too_long else None)


@contextmanager
def _evaluation_mode(policy: ActorCriticPolicy) -> Iterator[None]:
    training = policy.training
    policy.set_training_mode(False)
    try:
        yield
    finally:
        policy.set_training_mode(training)
