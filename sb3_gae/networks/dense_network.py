r"""
A multi-layer perceptron that keeps its activations, so that products with its Jacobian cost two matrix products a layer.

A curvature product in a trust-region step is :math:`J^\top M (J v)`: forward through the linearised network, a metric on
its outputs, and backward. Within one conjugate-gradient solve neither the parameters nor the inputs change,
so the activations are computed once. Double backward computes them again for every product.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import torch as th
from torch import nn

from sb3_gae.networks.layers import activate, pair_up
from sb3_gae.networks.parameters import unflatten

_aten = th.ops.aten

# Tangents times the derivative of an activation, given its *output*; only activations for which that is enough are here.
# The fused kernels of torch's own backward pass read each array once
_TIMES_DERIVATIVE: dict[type[nn.Module], Callable[[Any, th.Tensor, th.Tensor], th.Tensor]] = {
    nn.Tanh: lambda _, tangents, h: _aten.tanh_backward(tangents, h),
    nn.Sigmoid: lambda _, tangents, h: _aten.sigmoid_backward(tangents, h),
    nn.ReLU: lambda _, tangents, h: _aten.threshold_backward(tangents, h, 0),
    nn.LeakyReLU: lambda module, tangents, h: _aten.leaky_relu_backward(tangents, h, module.negative_slope, True),
    nn.ELU: lambda module, tangents, h: _aten.elu_backward(tangents, module.alpha, 1, 1, True, h),
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
        self.layers = pair_up(layers)
        self.blocks = inputs.split(_BLOCK_ROWS)
        self.batch_size = len(inputs)
        # For each block the input of each layer, and last the output of the network
        self._hidden: list[list[th.Tensor]] = []

    @staticmethod
    def supports(layers: Sequence[nn.Module]) -> bool:
        """
        :param layers: modules in the order in which they are applied
        :return: whether they are linear layers, each followed by at most one activation of a known derivative,
            with no hooks, no frozen and no shared parameters
        """
        parameters = [parameter for layer in layers for parameter in layer.parameters()]
        pairs = pair_up(layers)
        return (
            bool(pairs)
            and all(type(linear) is nn.Linear and (act is None or type(act) in _TIMES_DERIVATIVE) for linear, act in pairs)
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
        self._hidden = [self._forward_block(block) for block in self.blocks]
        return th.cat([hidden[-1] for hidden in self._hidden])

    def _forward_block(self, inputs: th.Tensor) -> list[th.Tensor]:
        hidden = [inputs]
        for linear, activation in self.layers:
            outputs = linear(hidden[-1])
            hidden.append(outputs if activation is None else activate(activation, outputs))
        return hidden

    def _times_derivative(self, index: int, layer: int, tangents: th.Tensor) -> th.Tensor:
        activation = self.layers[layer][1]
        if activation is None:
            return tangents
        return _TIMES_DERIVATIVE[type(activation)](activation, tangents, self._hidden[index][layer + 1])

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
        tangent = th.empty(0)
        for layer, (weight, bias) in enumerate(tangents):
            hidden = self._hidden[index][layer]
            moved = hidden @ weight.t() if bias is None else th.addmm(bias, hidden, weight.t())
            if layer > 0:
                moved.addmm_(tangent, self.layers[layer][0].weight.t())
            tangent = self._times_derivative(index, layer, moved)
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
            cotangent = self._times_derivative(index, layer, cotangent)
            yield layer, self._hidden[index][layer], cotangent
            if layer > 0:
                cotangent = cotangent @ self.layers[layer][0].weight

    def _split(self, vector: th.Tensor) -> Iterator[tuple[th.Tensor, th.Tensor | None]]:
        pieces = (piece for _, piece in unflatten(self.parameters, vector))
        for linear, _ in self.layers:
            yield next(pieces), None if linear.bias is None else next(pieces)
