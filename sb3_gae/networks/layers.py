"""Layers of MLPs one by one: which activation follows which linear layer, and few rows at a time."""

from collections.abc import Sequence

import numpy as np
import torch as th
from torch import nn

# Multiplications of a product up to which NumPy's BLAS, OpenBLAS, keeps to one thread by itself. Its others would wait by
# spinning on the cores that step the physics
_ONE_THREAD = 2**18


def pair_up(layers: Sequence[nn.Module]) -> list[tuple[nn.Linear, nn.Module | None]]:
    """
    :param layers: in the order in which they are applied
    :return: each linear layer with the activation after it; nothing where the layers do not alternate so
    """
    pairs: list[tuple[nn.Linear, nn.Module | None]] = []
    for layer in layers:
        if isinstance(layer, nn.Linear):
            pairs.append((layer, None))
        elif pairs and pairs[-1][1] is None:
            pairs[-1] = (pairs[-1][0], layer)
        else:
            return []
    return pairs


def has_hook(of: nn.Module | th.Tensor) -> bool:
    """
    :param of: a module, or a leaf of the computation graph
    :return: whether something is called, and may change what it returns, where it is evaluated or its gradient is computed
    """
    if isinstance(of, th.Tensor):
        return bool(of._backward_hooks)
    return bool(of._forward_hooks or of._forward_pre_hooks or of._backward_hooks or of._backward_pre_hooks)


class StepNetwork:
    """
    Layers of an MLP on the CPU, applied to the few rows of a step: by NumPy, a call of which costs a fraction of torch's.

    :param layers: what :func:`pair_up` found; their weights may be written to, but not put elsewhere
    """

    def __init__(self, layers: Sequence[tuple[nn.Linear, nn.Module | None]]):
        self._layers = [
            (linear.weight.detach().numpy().T, None if linear.bias is None else linear.bias.detach().numpy(), activation)
            for linear, activation in layers
        ]
        self._most_rows = _ONE_THREAD // max(weight.size for weight, _, _ in self._layers)

    def __call__(self, inputs: np.ndarray) -> np.ndarray:
        """
        :param inputs: in the precision of the weights, shape (B, n_in)
        :return: shape (B, n_out)
        """
        hidden = inputs
        for weight, bias, activation in self._layers:
            hidden = hidden @ weight if len(inputs) <= self._most_rows else _mm(hidden, weight)
            if bias is not None:
                hidden += bias
            if type(activation) is nn.Tanh:
                np.tanh(hidden, out=hidden)
            elif activation is not None:
                with th.no_grad():
                    hidden = activation(th.from_numpy(hidden)).numpy()
        return hidden


def _mm(rows: np.ndarray, weight: np.ndarray) -> np.ndarray:
    return th.mm(th.from_numpy(rows), th.from_numpy(weight)).numpy()
