"""What is computed of a whole rollout: values and log-probabilities, and what an update is trained on."""

from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.utils import obs_as_tensor

from sb3_gae.batch import TrainingBatch, as_float, in_chunks
from sb3_gae.borrowed_distribution import borrowed_distribution
from sb3_gae.checks import check_finite_rollout
from sb3_gae.estimators.advantages import discounted_returns
from sb3_gae.rollout.collection import Observations, RolloutEnd, TerminalObservation, stacked
from sb3_gae.rollout.rollout_buffer import GAERolloutBuffer


def evaluate_rollout(policy: ActorCriticPolicy, rollout_buffer: GAERolloutBuffer, end: RolloutEnd) -> th.Tensor:
    """
    Give a full buffer its values and log-probabilities, computed for all of it at once.

    :param policy: in evaluation mode, as it was when the rollout was collected
    :param rollout_buffer: full
    :param end: of the rollout
    :return: values of the last observations, shape (N,)
    :raises NumericalError: if a value or a log-probability is not finite
    """
    samples, mask = rollout_buffer.batch(), rollout_buffer.mask
    actions = distribution_actions(policy.action_space, samples.actions)

    def evaluate(observations: Any, actions: th.Tensor) -> th.Tensor:
        values, log_probs, _ = policy.evaluate_actions(observations, actions)
        return th.stack([values.flatten(), log_probs], dim=1)

    with borrowed_distribution(policy):
        evaluated = in_chunks(evaluate, samples.observations, actions).cpu().numpy()
    values, log_probs = np.zeros((2, *mask.shape), dtype=evaluated.dtype)
    values[mask], log_probs[mask] = evaluated.T
    check_finite_rollout("value", values)
    check_finite_rollout("log-probability", log_probs)
    rollout_buffer.set_values(values, log_probs, _bootstrap_values(policy, end.terminal, mask.shape))
    return _predict_values(policy, end.observations)


def distribution_actions(action_space: spaces.Space, actions: th.Tensor) -> th.Tensor:
    """
    :param action_space: of the environment
    :param actions: as the buffer keeps them, shape (B, n_actions)
    :return: as the distribution takes them: whole numbers of shape (B,) for Discrete
    """
    return actions.long().flatten() if isinstance(action_space, spaces.Discrete) else actions


def precision_of(policy: ActorCriticPolicy) -> th.dtype:
    """
    :param policy: any actor-critic policy
    :return: double precision if it has any parameter in it, else single
    """
    return th.float64 if any(parameter.dtype == th.float64 for parameter in policy.parameters()) else th.float32


def training_batch(
    rollout_buffer: GAERolloutBuffer, action_space: spaces.Space, precision: th.dtype = th.float32
) -> TrainingBatch:
    """
    :param rollout_buffer: full, with its advantages computed
    :param action_space: of the environment
    :param precision: see :func:`precision_of`
    :return: all of it, flattened, as the steps of an update take it
    """
    samples = rollout_buffer.batch()
    actions = distribution_actions(action_space, samples.actions)
    return TrainingBatch(as_float(samples.observations, precision), actions, samples.advantages, samples.returns)


def reward_returns(rollout_buffer: GAERolloutBuffer) -> np.ndarray:
    """
    :param rollout_buffer: full
    :return: discounted returns of the rewards alone, no value function involved, shape (``n_samples``,)
    :raises NumericalError: if a return is not finite
    """
    nothing = np.zeros_like(rollout_buffer.rewards)
    returns = discounted_returns(rollout_buffer.rewards, nothing, rollout_buffer.dones, rollout_buffer.gamma)
    check_finite_rollout("discounted return", returns)
    return returns[rollout_buffer.mask]


def _bootstrap_values(policy: ActorCriticPolicy, terminal: list[TerminalObservation], shape: tuple[int, ...]) -> np.ndarray:
    bootstrap_values = np.zeros(shape, dtype=np.float32)
    if terminal:
        steps, envs = [ending.step for ending in terminal], [ending.env for ending in terminal]
        bootstrap_values[steps, envs] = _predict_values(policy, stacked([ending.observation for ending in terminal])).cpu()
    return bootstrap_values


def _predict_values(policy: ActorCriticPolicy, observations: Observations) -> th.Tensor:
    return in_chunks(lambda part: policy.predict_values(part).flatten(), obs_as_tensor(observations, policy.device))
