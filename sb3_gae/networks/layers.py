"""Layers of MLPs one by one: which activation follows which linear layer, and a faster tanh."""

from collections.abc import Sequence

import numpy as np
import torch as th
from torch import nn


def activate(activation: nn.Module, outputs: th.Tensor) -> th.Tensor:
    """
    :param activation: of a layer
    :param outputs: of that layer before it; fresh, since they may be overwritten, and without a graph
    :return: after it
    """
    if type(activation) is not nn.Tanh or outputs.device.type != "cpu" or outputs.dtype not in (th.float32, th.float64):
        return activation(outputs)
    # NumPy's kernel takes a fraction of the time of torch's, which would be the largest cost of a pass
    array = outputs.numpy()
    np.tanh(array, out=array)
    return outputs


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
