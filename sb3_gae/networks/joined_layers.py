"""
Weights and bias of a linear layer as one matrix, which acts on inputs that are followed by a one.

Flat vectors have a layer's weights, row by row, and then its bias, as ``parameters()`` has them. The joined matrix has the
bias as its last column; without a bias it is the weights.
"""

from collections.abc import Sequence

import torch as th
from torch import nn


def joined_columns(linear: nn.Linear) -> int:
    """
    :param linear: a layer
    :return: n_in + 1, or n_in without a bias
    """
    return linear.in_features + (linear.bias is not None)


def joined_parameters(linears: Sequence[nn.Linear]) -> list[th.Tensor]:
    """
    :param linears: layers
    :return: for each its weights and bias, shape (n_out, n_in + 1), or (n_out, n_in) without a bias
    """
    return [_joined(linear.weight, linear.bias) for linear in linears]


def joined_zeros(linears: Sequence[nn.Linear]) -> list[th.Tensor]:
    """
    :param linears: layers
    :return: for each zeros in the shape of its weights and bias
    """
    return [linear.weight.new_zeros(linear.out_features, joined_columns(linear)) for linear in linears]


def joined_pieces(linears: Sequence[nn.Linear], vector: th.Tensor) -> list[th.Tensor]:
    """
    :param linears: layers with n parameters in all
    :param vector: one scalar for each of them, shape (n,)
    :return: for each layer its part, in the shape of its weights and bias
    """
    pieces, start = [], 0
    for linear in linears:
        size = linear.weight.numel()
        weight = vector[start : start + size].view_as(linear.weight)
        start += size
        bias = None if linear.bias is None else vector[start : start + linear.out_features]
        start += 0 if bias is None else len(bias)
        pieces.append(_joined(weight, bias))
    return pieces


def separated(linears: Sequence[nn.Linear], pieces: Sequence[th.Tensor]) -> th.Tensor:
    """
    :param linears: layers with n parameters in all
    :param pieces: for each a matrix in the shape of its weights and bias
    :return: all scalars in the order of the parameters, shape (n,)
    """
    parts = [
        part.reshape(-1)
        for linear, piece in zip(linears, pieces, strict=True)
        for part in (piece[:, : linear.in_features], piece[:, linear.in_features :])
    ]
    return th.cat(parts)


def _joined(weight: th.Tensor, bias: th.Tensor | None) -> th.Tensor:
    return weight if bias is None else th.cat([weight, bias[:, None]], dim=1)
