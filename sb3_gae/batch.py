"""Batches of observations that are tensors or dictionaries of tensors."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import torch as th
from stable_baselines3.common.type_aliases import PyTorchObs

# Observations' values in one pass: bounds the memory of activations for images
_CHUNK_VALUES = 2**24


@dataclass(frozen=True)
class TrainingBatch:
    """
    One rollout, flattened: B is steps times environments.

    :param observations: shape (B, ...), or a dictionary of such
    :param actions: as the distribution samples them, shape (B, n_actions), or (B,) for Discrete
    :param advantages: raw, shape (B,)
    :param value_targets: what the value function is fitted to, shape (B,)
    """

    observations: PyTorchObs
    actions: th.Tensor
    advantages: th.Tensor
    value_targets: th.Tensor

    def __len__(self) -> int:
        return len(self.advantages)

    def take(self, indices: th.Tensor | None) -> "TrainingBatch":
        """
        :param indices: which samples, shape (n,); None for all
        :return: a copy of those, or the batch itself
        """
        if indices is None:
            return self
        return TrainingBatch(
            take(self.observations, indices), self.actions[indices], self.advantages[indices], self.value_targets[indices]
        )

    def first(self) -> "TrainingBatch":
        """
        :return: its first sample alone, enough to see what an MLP's outputs depend on
        """
        return self.take(th.zeros(1, dtype=th.long, device=self.advantages.device))

    def parts(self) -> Iterator["TrainingBatch"]:
        """
        :return: all samples in pieces that bound the memory of activations
        """
        for piece in _pieces(self.observations):
            yield TrainingBatch(
                take(self.observations, piece), self.actions[piece], self.advantages[piece], self.value_targets[piece]
            )


def take(observations: PyTorchObs, indices: th.Tensor | slice) -> PyTorchObs:
    """
    :param observations: shape (B, ...), or a dictionary of such
    :param indices: along the batch
    :return: observations of those samples
    """
    if isinstance(observations, dict):
        return {key: value[indices] for key, value in observations.items()}
    return observations[indices]


def batch_size(observations: PyTorchObs) -> int:
    """
    :param observations: shape (B, ...), or a dictionary of such
    :return: B
    """
    return len(next(iter(observations.values())) if isinstance(observations, dict) else observations)


def as_float(observations: PyTorchObs, precision: th.dtype = th.float32) -> PyTorchObs:
    """
    Floats no more precise than the policy, so that not every pass over the batch converts them; integers stay.

    :param observations: shape (B, ...), or a dictionary of such
    :param precision: of the policy; in double precision it gets all as it had it when it acted
    :return: likewise
    """
    if precision == th.float64:
        return observations
    if isinstance(observations, dict):
        return {key: value.float() if value.is_floating_point() else value for key, value in observations.items()}
    return observations.float() if observations.is_floating_point() else observations


def standardized(advantages: th.Tensor) -> th.Tensor:
    """
    Mean 0 and deviation 1; in double precision, so that advantages of 1e-30 and 1e30 come out alike.

    :param advantages: shape (B,)
    :return: shape (B,); zeros if all are the same
    """
    # On the CPU, since not every device has doubles
    wide = advantages.cpu().double()
    centred = wide - wide.mean()
    deviation = centred.std()
    # A deviation that is only rounding must not be blown up to 1
    if deviation <= th.finfo(advantages.dtype).eps * wide.abs().max():
        return th.zeros_like(advantages)
    return (centred / deviation).to(advantages)


def random_subset(n_samples: int, at_most: int | None, device: th.device) -> th.Tensor | None:
    """
    Indices of a subset without replacement, from NumPy's global generator as SB3's own minibatches are.

    :param n_samples: how many there are
    :param at_most: how many to take, None for all
    :param device: where the indices are wanted
    :return: sorted so that memory is read forwards; None if all are taken
    """
    if at_most is None or n_samples <= at_most:
        return None
    return th.as_tensor(np.sort(np.random.permutation(n_samples)[:at_most]), device=device)


def in_chunks(function: Callable[..., th.Tensor], observations: PyTorchObs, *others: th.Tensor) -> th.Tensor:
    """
    Apply a function to a batch without gradients, in pieces that bound the memory.

    :param function: maps observations of shape (b, ...), and as much of the others, to a tensor of shape (b, ...)
    :param observations: shape (B, ...), or a dictionary of such
    :param others: shape (B, ...)
    :return: shape (B, ...)
    """
    with th.no_grad():
        parts = [function(take(observations, piece), *(other[piece] for other in others)) for piece in _pieces(observations)]
    return parts[0] if len(parts) == 1 else th.cat(parts)


def _pieces(observations: PyTorchObs) -> list[slice]:
    size = batch_size(observations)
    tensors = list(observations.values()) if isinstance(observations, dict) else [observations]
    rows = max(1, _CHUNK_VALUES * size // max(1, sum(tensor.numel() for tensor in tensors)))
    return [slice(start, start + rows) for start in range(0, size, rows)]
