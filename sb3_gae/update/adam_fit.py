"""The value fit of sb3-contrib's TRPO, kept for comparison: epochs of minibatches with a first-order optimiser."""

from collections.abc import Sequence

import torch as th
from stable_baselines3.common.policies import ActorCriticPolicy
from torch.nn import functional as F

from sb3_gae.batch import in_chunks
from sb3_gae.errors import NumericalError
from sb3_gae.rollout.rollout_buffer import GAERolloutBuffer
from sb3_gae.update.value_step import ValueFitRecord, value_scale


def adam_fit(
    policy: ActorCriticPolicy,
    parameters: Sequence[th.Tensor],
    rollout_buffer: GAERolloutBuffer,
    n_epochs: int,
    batch_size: int,
) -> ValueFitRecord:
    """
    :param policy: owner of the value function and of the optimiser
    :param parameters: see :func:`~sb3_gae.update.value_step.value_parameters`; the optimiser moves no others
    :param rollout_buffer: observations and targets
    :param n_epochs: passes over the rollout
    :param batch_size: samples of a minibatch
    :return: values before and after, and no trust-region steps
    :raises NumericalError: if a gradient is not finite; earlier minibatches have moved the parameters then
    """
    scale = value_scale(policy)

    def predict() -> th.Tensor:
        return in_chunks(lambda part: policy.predict_values(part).flatten(), rollout_buffer.batch().observations)

    before = predict()
    for _ in range(n_epochs if parameters else 0):
        for samples in rollout_buffer.get(batch_size):
            errors = (policy.predict_values(samples.observations).flatten() - samples.returns) / scale
            # These samples may go through frozen parts alone
            if not errors.requires_grad:
                continue
            # None for parts of a network that none of these samples goes through
            gradients = th.autograd.grad(F.mse_loss(errors, th.zeros_like(errors)), parameters, allow_unused=True)
            if not all(th.isfinite(gradient).all() for gradient in gradients if gradient is not None):
                raise NumericalError("A gradient of the value function contains NaN or infinity.")
            policy.optimizer.zero_grad()
            for parameter, gradient in zip(parameters, gradients, strict=True):
                parameter.grad = gradient
            policy.optimizer.step()
    policy.optimizer.zero_grad()
    return ValueFitRecord([], before, predict())
