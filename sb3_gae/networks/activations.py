"""Activations in place, and their derivatives from what came out: only those for which that is enough are here."""

from collections.abc import Callable
from typing import Any, NamedTuple

import torch as th
from torch import nn
from torch.nn import functional

_aten = th.ops.aten


class _Activation(NamedTuple):
    """
    :param apply: to what a layer puts out, given with the module, in place
    :param times_derivative: multiplies tangents, in place, given with the module and what came out
    :param is_enough: whether what comes out of this module tells on which side of zero the input was
    """

    apply: Callable[[Any, th.Tensor], object]
    times_derivative: Callable[[Any, th.Tensor, th.Tensor], object]
    is_enough: Callable[[Any], bool] = lambda _: True


# The fused kernels of torch's own backward pass read each array once
_KNOWN: dict[type[nn.Module], _Activation] = {
    nn.Tanh: _Activation(
        lambda _, x: x.tanh_(),
        lambda _, t, h: _aten.tanh_backward.grad_input(t, h, grad_input=t),
    ),
    nn.Sigmoid: _Activation(
        lambda _, x: x.sigmoid_(),
        lambda _, t, h: _aten.sigmoid_backward.grad_input(t, h, grad_input=t),
    ),
    nn.ReLU: _Activation(
        lambda _, x: x.relu_(),
        lambda _, t, h: _aten.threshold_backward.grad_input(t, h, 0, grad_input=t),
    ),
    nn.LeakyReLU: _Activation(
        lambda module, x: functional.leaky_relu_(x, module.negative_slope),
        lambda module, t, h: _aten.leaky_relu_backward.grad_input(t, h, module.negative_slope, True, grad_input=t),
        lambda module: module.negative_slope >= 0.0,
    ),
    nn.ELU: _Activation(
        lambda module, x: functional.elu_(x, module.alpha),
        lambda module, t, h: _aten.elu_backward.grad_input(t, module.alpha, 1, 1, True, h, grad_input=t),
        lambda module: module.alpha >= 0.0,
    ),
}


def has_known_derivative(activation: nn.Module) -> bool:
    """
    :param activation: any module
    :return: whether the others here know it; a subclass may do something else
    """
    known = _KNOWN.get(type(activation))
    return known is not None and known.is_enough(activation)


def activate_(activation: nn.Module, outputs: th.Tensor) -> None:
    """
    :param activation: one that :func:`has_known_derivative`
    :param outputs: of a layer before it, without a graph; overwritten by those after it
    """
    _KNOWN[type(activation)].apply(activation, outputs)


def times_derivative_(activation: nn.Module, tangents: th.Tensor, activated: th.Tensor) -> None:
    """
    :param activation: one that :func:`has_known_derivative`
    :param tangents: overwritten by their product with the derivative
    :param activated: what came out of the activation, of the same shape
    """
    _KNOWN[type(activation)].times_derivative(activation, tangents, activated)
