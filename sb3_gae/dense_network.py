r"""
A multi-layer perceptron that keeps its activations, so that products with its Jacobian cost two matrix products a layer.

A curvature product in a trust-region step is :math:`J^\top M (J v)`: forward through the linearised network, a metric on
its outputs, and backward. Within one conjugate-gradient solve neither the parameters nor the inputs change,
so the activations and their derivatives are computed once. Double backward computes them again for every product.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import torch as th
from torch import nn

from sb3_gae.parameters import unflatten

# Derivative of an activation as a function of its *output*; only activations for which that exists are here
_DERIVATIVES: dict[type[nn.Module], Callable[[Any, th.Tensor], th.Tensor]] = {
    nn.Tanh: lambda _, h: 1.0 - h * h,
    nn.Sigmoid: lambda _, h: h * (1.0 - h),
    nn.ReLU: lambda _, h: (h > 0).to(h.dtype),
    nn.LeakyReLU: lambda module, h: th.full_like(h, module.negative_slope).masked_fill_(h > 0, 1.0),
    nn.ELU: lambda module, h: th.where(h > 0, 1.0, h + module.alpha),
}

# Rows that go through all layers together: few enough to stay in the cache, enough to keep the cores busy
_BLOCK_ROWS = 8192


class DenseNetwork:
    """
    Layers of an MLP over a fixed batch of inputs.

    :param layers: alternating :class:`torch.nn.Linear` and activations, as :meth:`supports` accepts them
    :param inputs: shape (B, n_in); not copied
    """

    def __init__(self, layers: Sequence[nn.Module], inputs: th.Tensor):
        self.layers = _pair_up(layers)
        self.blocks = inputs.split(_BLOCK_ROWS)
        self.batch_size = len(inputs)
        # Inputs of each linear layer, and derivatives of each activation, a list over layers for each block
        self._inputs: list[list[th.Tensor]] = []
        self._derivatives: list[list[th.Tensor | None]] = []

    @staticmethod
    def supports(layers: Sequence[nn.Module]) -> bool:
        """
        :param layers: modules in the order in which they are applied
        :return: whether they are linear layers, each followed by at most one activation of a known derivative,
            with no hooks, no frozen and no shared parameters
        """
        parameters = [parameter for layer in layers for parameter in layer.parameters()]
        pairs = _pair_up(layers)
        return (
            bool(pairs)
            and all(type(linear) is nn.Linear and (act is None or type(act) in _DERIVATIVES) for linear, act in pairs)
            and not any(layer._forward_hooks or layer._forward_pre_hooks for layer in layers)
            and all(parameter.requires_grad for parameter in parameters)
            and len({id(parameter) for parameter in parameters}) == len(parameters)
        )

    @property
    def parameters(self) -> list[nn.Parameter]:
        """Weights and biases, in the order of the vectors that :meth:`jvp` takes and :meth:`vjp` returns."""
        return [parameter for linear, _ in self.layers for parameter in linear.parameters()]

    @property
    def n_parameters(self) -> int:
        """Number of scalars in :attr:`parameters`."""
        return sum(parameter.numel() for parameter in self.parameters)

    @th.no_grad()
    def forward(self) -> th.Tensor:
        """
        Apply the layers with their present parameters and keep what the products need.

        :return: outputs, shape (B, n_out)
        """
        self._inputs, self._derivatives = [], []
        return th.cat([self._forward_block(block) for block in self.blocks])

    def _forward_block(self, hidden: th.Tensor) -> th.Tensor:
        inputs: list[th.Tensor] = []
        derivatives: list[th.Tensor | None] = []
        for linear, activation in self.layers:
            inputs.append(hidden)
            hidden = linear(hidden)
            if activation is not None:
                hidden = activation(hidden)
            derivatives.append(None if activation is None else _DERIVATIVES[type(activation)](activation, hidden))
        self._inputs.append(inputs)
        self._derivatives.append(derivatives)
        return hidden

    @th.no_grad()
    def vjp(self, cotangents: th.Tensor) -> th.Tensor:
        """
        :param cotangents: one for each output, shape (B, n_out)
        :return: the Jacobian's transpose times ``cotangents``, summed over the batch, shape (n,)
        """
        result = cotangents.new_zeros(self.n_parameters)
        gradients = list(self._split(result))
        for index, block in enumerate(cotangents.split(_BLOCK_ROWS)):
            self._accumulate_vjp(index, block, gradients)
        return result

    @th.no_grad()
    def gauss_newton_product(self, vector: th.Tensor, metric: Callable[[th.Tensor, slice], th.Tensor]) -> th.Tensor:
        r"""
        :math:`\sum_n J_n^\top M_n J_n v`.

        :param vector: shape (n,)
        :param metric: applies :math:`M` to a block of output tangents, given with the slice of rows that it holds
        :return: shape (n,)
        """
        result = th.zeros_like(vector)
        tangents, gradients = list(self._split(vector)), list(self._split(result))
        for index, block in enumerate(self.blocks):
            rows = slice(index * _BLOCK_ROWS, index * _BLOCK_ROWS + len(block))
            self._accumulate_vjp(index, metric(self._jvp_block(index, tangents), rows), gradients)
        return result

    @th.no_grad()
    def kronecker_factors(self, cotangents: th.Tensor) -> list[tuple[th.Tensor, th.Tensor]]:
        """
        Second moments from which a layer's block of the curvature is approximated as a Kronecker product.

        :param cotangents: one for each output, with the output metric as their covariance, shape (B, n_out)
        :return: for each layer the mean outer product of its inputs, with a 1 appended for the bias, and that of the
            cotangents at its output: shapes (n_in + 1, n_in + 1) and (n_out, n_out)
        """
        factors: dict[int, tuple[th.Tensor, th.Tensor]] = {}
        for index, block in enumerate(cotangents.split(_BLOCK_ROWS)):
            for layer, hidden, at_layer in self._backward(index, block):
                if self.layers[layer][0].bias is not None:
                    hidden = th.cat([hidden, hidden.new_ones(len(hidden), 1)], dim=1)
                moments = hidden.t() @ hidden / self.batch_size, at_layer.t() @ at_layer / self.batch_size
                before = factors.get(layer, (0.0, 0.0))
                factors[layer] = (before[0] + moments[0], before[1] + moments[1])
        return [factors[layer] for layer in range(len(self.layers))]

    @th.no_grad()
    def jvp(self, vector: th.Tensor) -> th.Tensor:
        """
        :param vector: a direction in parameter space, shape (n,)
        :return: how the outputs move along it, shape (B, n_out)
        """
        tangents = list(self._split(vector))
        return th.cat([self._jvp_block(index, tangents) for index in range(len(self.blocks))])

    def _jvp_block(self, index: int, tangents: list[tuple[th.Tensor, th.Tensor | None]]) -> th.Tensor:
        tangent: th.Tensor | None = None
        for (linear, _), hidden, derivative, (weight, bias) in zip(
            self.layers, self._inputs[index], self._derivatives[index], tangents, strict=True
        ):
            moved = hidden @ weight.t() if bias is None else th.addmm(bias, hidden, weight.t())
            if tangent is not None:
                moved.addmm_(tangent, linear.weight.t())
            if derivative is not None:
                moved.mul_(derivative)
            tangent = moved
        assert tangent is not None
        return tangent

    def _accumulate_vjp(self, index: int, cotangent: th.Tensor, gradients: list[tuple[th.Tensor, th.Tensor | None]]) -> None:
        for layer, hidden, at_layer in self._backward(index, cotangent):
            weight, bias = gradients[layer]
            weight.addmm_(at_layer.t(), hidden)
            if bias is not None:
                bias.add_(at_layer.sum(0))

    def _backward(self, index: int, cotangent: th.Tensor) -> Iterator[tuple[int, th.Tensor, th.Tensor]]:
        """Each linear layer of a block from the last to the first, with its inputs and the cotangents at its output."""
        for layer in range(len(self.layers) - 1, -1, -1):
            derivative = self._derivatives[index][layer]
            if derivative is not None:
                cotangent = cotangent * derivative
            yield layer, self._inputs[index][layer], cotangent
            if layer > 0:
                cotangent = cotangent @ self.layers[layer][0].weight

    def _split(self, vector: th.Tensor) -> Iterator[tuple[th.Tensor, th.Tensor | None]]:
        pieces = (piece for _, piece in unflatten(self.parameters, vector))
        for linear, _ in self.layers:
            yield next(pieces), None if linear.bias is None else next(pieces)


def _pair_up(layers: Sequence[nn.Module]) -> list[tuple[nn.Linear, nn.Module | None]]:
    """Each linear layer with the activation after it; empty where the layers do not alternate so."""
    pairs: list[tuple[nn.Linear, nn.Module | None]] = []
    for layer in layers:
        if isinstance(layer, nn.Linear):
            pairs.append((layer, None))
        elif pairs and pairs[-1][1] is None:
            pairs[-1] = (pairs[-1][0], layer)
        else:
            return []
    return pairs
