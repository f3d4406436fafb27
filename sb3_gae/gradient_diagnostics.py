r"""
Raw policy gradients :math:`\sum_t \hat A_t \nabla_\theta\log\pi(a_t|s_t)` for many kinds of advantages at once (torch).

They are linear in the advantages: the network is run forward once for all of them, and for MLPs backward once as well.
"""

from collections.abc import Sequence

import numpy as np
import torch as th
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.type_aliases import PyTorchObs

from sb3_gae.batch import batch_size, take
from sb3_gae.dense_policy import dense_policy_network, has_dense_policy, policy_log_std
from sb3_gae.distributions import distribution_from_outputs

# Rows of one pass: bounds the memory of a graph, and the length of sums in single precision
_CHUNK_ROWS = 4096


def policy_gradients(
    policy: ActorCriticPolicy,
    parameters: Sequence[th.Tensor],
    observations: PyTorchObs,
    actions: th.Tensor,
    advantages: np.ndarray | th.Tensor,
    groups: np.ndarray | None = None,
) -> np.ndarray:
    r"""
    :math:`\sum_t \hat A_t \nabla_\theta\log\pi(a_t|s_t)` over each group of samples, for each row of advantages.

    The result takes 8 bytes for each group, row and parameter; with images it is as well to ask for few rows at a time.

    :param policy: that the actions were drawn from, in evaluation mode
    :param parameters: what to differentiate by, P scalars in all; see :func:`~sb3_gae.policy_step.policy_parameters`
    :param observations: B samples, shape (B, ...), or a dictionary of such
    :param actions: as the distribution takes them, shape (B, n_actions), or (B,) for Discrete
    :param advantages: finite, any scale that the policy's precision holds, shape (K, B)
    :param groups: of each sample from 0 on, negative for samples to leave out; None for one group of all, shape (B,)
    :return: sums over the samples of a group, accumulated in double precision, shape (G, K, P)
    :raises ValueError: if a shape does not fit
    """
    n_samples = batch_size(observations)
    rows_of = np.zeros(n_samples, dtype=np.int64) if groups is None else np.asarray(groups)
    if rows_of.shape != (n_samples,) or advantages.ndim != 2 or advantages.shape[1] != n_samples:
        raise ValueError(
            f"`advantages` must have the shape (K, {n_samples}) and `groups` ({n_samples},), "
            f"got {tuple(advantages.shape)} and {rows_of.shape}."
        )
    n_parameters = sum(parameter.numel() for parameter in parameters)
    result = np.zeros((int(rows_of.max(initial=0)) + 1, len(advantages), n_parameters))
    gradients_of = _dense_gradients if has_dense_policy(policy, parameters) else _autograd_gradients
    weights = th.as_tensor(advantages, dtype=parameters[0].dtype, device=parameters[0].device)
    for group in range(len(result)):
        for rows in th.as_tensor(np.flatnonzero(rows_of == group), device=weights.device).split(_CHUNK_ROWS):
            if len(rows):
                chunk = take(observations, rows), actions[rows], weights[:, rows]
                result[group] += gradients_of(policy, parameters, *chunk)
    return result


def _autograd_gradients(
    policy: ActorCriticPolicy,
    parameters: Sequence[th.Tensor],
    observations: PyTorchObs,
    actions: th.Tensor,
    advantages: th.Tensor,
) -> np.ndarray:
    """For any policy: one graph, one pass backward for each row."""
    with th.enable_grad():
        log_prob = policy.get_distribution(observations).log_prob(actions)
    result = np.empty((len(advantages), sum(parameter.numel() for parameter in parameters)))
    for row, weights in enumerate(advantages):
        last = row == len(advantages) - 1
        gradients = th.autograd.grad(
            log_prob, parameters, weights, retain_graph=not last, allow_unused=True, materialize_grads=True
        )
        result[row] = th.cat([gradient.flatten() for gradient in gradients]).cpu().numpy()
    return result


def _dense_gradients(
    policy: ActorCriticPolicy,
    parameters: Sequence[th.Tensor],
    observations: PyTorchObs,
    actions: th.Tensor,
    advantages: th.Tensor,
) -> np.ndarray:
    """The same for an MLP: scores of the outputs by autograd, the rest with kept activations."""
    network, log_std = dense_policy_network(policy, observations), policy_log_std(policy)
    outputs = network.forward().requires_grad_()
    # One for each sample, as its gradients are weighted by sample
    own_log_std = [value.detach().expand(len(actions), -1).clone().requires_grad_() for value in log_std]
    with th.enable_grad():
        log_prob = distribution_from_outputs(policy.action_dist, outputs, own_log_std).log_prob(actions)
        scores, *log_std_scores = th.autograd.grad(log_prob.sum(), [outputs, *own_log_std])
    of_layers = network.weighted_vjps(scores, advantages)
    of_log_std = [(advantages @ score).cpu().double() for score in log_std_scores]
    held = [*network.parameters, *log_std]
    pieces = [*of_layers.split([parameter.numel() for parameter in network.parameters], dim=1), *of_log_std]
    by_identity = {id(parameter): piece for parameter, piece in zip(held, pieces, strict=True)}
    return th.cat([by_identity[id(parameter)] for parameter in parameters], dim=1).numpy()
