r"""
Raw policy gradients :math:`\sum_t \hat A_t \nabla_\theta\log\pi(a_t|s_t)` for many kinds of advantages at once (torch).

They are linear in the advantages: one forward pass serves all of them, and only the pass backward is one for each.
"""

from collections.abc import Sequence

import numpy as np
import torch as th
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.type_aliases import PyTorchObs

from sb3_gae.batch import batch_size, take
from sb3_gae.borrowed_distribution import borrowed_distribution

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
    :param parameters: what to differentiate by, P scalars in all; see :func:`~sb3_gae.update.policy_step.policy_parameters`
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
    weights = th.as_tensor(advantages, dtype=parameters[0].dtype, device=parameters[0].device)
    for group in range(len(result)):
        for rows in th.as_tensor(np.flatnonzero(rows_of == group), device=weights.device).split(_CHUNK_ROWS):
            if len(rows):
                chunk = take(observations, rows), actions[rows], weights[:, rows]
                result[group] += _chunk_gradients(policy, parameters, *chunk)
    return result


def _chunk_gradients(
    policy: ActorCriticPolicy,
    parameters: Sequence[th.Tensor],
    observations: PyTorchObs,
    actions: th.Tensor,
    advantages: th.Tensor,
) -> np.ndarray:
    """One graph, one pass backward for each row of advantages: shape (K, P)."""
    with borrowed_distribution(policy), th.enable_grad():
        log_prob = policy.get_distribution(observations).log_prob(actions)
    result = np.empty((len(advantages), sum(parameter.numel() for parameter in parameters)))
    for row, weights in enumerate(advantages):
        last = row == len(advantages) - 1
        gradients = th.autograd.grad(
            log_prob, parameters, weights, retain_graph=not last, allow_unused=True, materialize_grads=True
        )
        result[row] = th.cat([gradient.flatten() for gradient in gradients]).cpu().numpy()
    return result
