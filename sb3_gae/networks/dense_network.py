r"""
A multi-layer perceptron that keeps its activations, so that products with its Jacobian cost two matrix products a layer.

A curvature product in a trust-region step is :math:`J^\top M (J v)`: forward through the linearised network, a metric on
its outputs, and backward. Within one conjugate-gradient solve neither the parameters nor the inputs change,
so the activations are computed once. Double backward computes them again for every product.

Inside, matrices have a unit in each row and a sample in each column, and a row of ones is under each layer's inputs as its
biases are beside its weights (:mod:`~sb3_gae.networks.joined_layers`). Adding a bias, its tangent, its gradient and its row of
the second moments are then part of a matrix product, instead of a pass over memory each; and all but the ones is contiguous.
"""

import functools
from collections.abc import Callable, Iterator, Sequence

import torch as th
from torch import nn

from sb3_gae.networks.activations import activate_, has_known_derivative, times_derivative_
from sb3_gae.networks.joined_layers import joined_columns, joined_parameters, joined_pieces, joined_zeros, separated
from sb3_gae.networks.layers import has_hook, pair_up

# Samples that go through all layers together: few enough to stay in the cache, enough to keep the cores busy
_BLOCK_ROWS = 8192


class DenseNetwork:
    """
    Layers of an MLP over a fixed batch of inputs.

    :param layers: alternating :class:`torch.nn.Linear` and activations, as :meth:`supports` accepts them
    :param inputs: shape (B, n_in); copied
    """

    def __init__(self, layers: Sequence[nn.Module], inputs: th.Tensor):
        self.layers = pair_up(layers)
        self.batch_size = len(inputs)
        self._linears = [linear for linear, _ in self.layers]
        # For each block the input of each layer, with ones for its bias, and last the output of the network
        self._hidden = [self._room(block) for block in inputs.split(_BLOCK_ROWS)]

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
            and all(type(linear) is nn.Linear and (act is None or has_known_derivative(act)) for linear, act in pairs)
            and not (any(map(has_hook, layers)) or any(map(has_hook, parameters)))
            and all(parameter.requires_grad for parameter in parameters)
            and len({id(parameter) for parameter in parameters}) == len(parameters)
        )

    @property
    def parameters(self) -> list[nn.Parameter]:
        """Weights and biases, in the order of the vectors that the products take and return."""
        return [parameter for linear in self._linears for parameter in linear.parameters()]

    @property
    def n_parameters(self) -> int:
        """Number of scalars in :attr:`parameters`."""
        return sum(parameter.numel() for parameter in self.parameters)

    def _room(self, inputs: th.Tensor) -> list[th.Tensor]:
        """Inputs of a block with ones for the biases, and where what they become is to go."""
        first = inputs.new_empty(len(inputs), joined_columns(self._linears[0]))
        first[:, : inputs.shape[1]] = inputs
        rows = [joined_columns(linear) for linear in self._linears[1:]] + [self._linears[-1].out_features]
        room = [first.t(), *(inputs.new_empty(n_rows, len(inputs)) for n_rows in rows)]
        for hidden, linear in zip(room, self._linears, strict=False):
            hidden[linear.in_features :] = 1.0
        return room

    @th.no_grad()
    def forward(self) -> th.Tensor:
        """
        Apply the layers with their present parameters and keep what the products need.

        :return: outputs, shape (B, n_out)
        """
        weights = joined_parameters(self._linears)
        for hidden in self._hidden:
            for layer, (_, activation) in enumerate(self.layers):
                outputs = self._outputs(hidden, layer)
                th.mm(weights[layer], hidden[layer], out=outputs)
                if activation is not None:
                    activate_(activation, outputs)
        return th.cat([hidden[-1].t() for hidden in self._hidden])

    def _outputs(self, hidden: list[th.Tensor], layer: int) -> th.Tensor:
        """Without the ones for the bias of the next."""
        return hidden[layer + 1][: self._linears[layer].out_features]

    def _times_derivative_(self, index: int, layer: int, tangents: th.Tensor) -> None:
        activation = self.layers[layer][1]
        if activation is not None:
            times_derivative_(activation, tangents, self._outputs(self._hidden[index], layer))

    @th.no_grad()
    def vjp(self, cotangents: th.Tensor) -> th.Tensor:
        """
        :param cotangents: one for each output, shape (B, n_out)
        :return: the Jacobian's transpose times ``cotangents``, summed over the batch, shape (n,)
        """
        gradients = joined_zeros(self._linears)
        for index, block in enumerate(cotangents.split(_BLOCK_ROWS)):
            self._accumulate_vjp(index, block, gradients)
        return separated(self._linears, gradients)

    @th.no_grad()
    def gauss_newton_product(self, vector: th.Tensor, metric: Callable[[th.Tensor, slice], th.Tensor]) -> th.Tensor:
        r"""
        :math:`\sum_n J_n^\top M_n J_n v`.

        :param vector: shape (n,)
        :param metric: applies :math:`M` to a block of output tangents, given with the slice of rows that it holds
        :return: shape (n,)
        """
        tangents, gradients = joined_pieces(self._linears, vector), joined_zeros(self._linears)
        for index, hidden in enumerate(self._hidden):
            rows = slice(index * _BLOCK_ROWS, index * _BLOCK_ROWS + hidden[0].shape[1])
            self._accumulate_vjp(index, metric(self._jvp_block(index, tangents).t(), rows), gradients)
        return separated(self._linears, gradients)

    @th.no_grad()
    def kronecker_factors(self, cotangents: th.Tensor) -> list[tuple[th.Tensor, th.Tensor]]:
        """
        Second moments from which a layer's block of the curvature is approximated as a Kronecker product.

        :param cotangents: one for each output, with the output metric as their covariance, shape (B, n_out)
        :return: for each layer the mean outer product of its inputs, with a 1 appended for the bias, and that of the
            cotangents at its output: shapes (n_in + 1, n_in + 1) and (n_out, n_out)
        """
        of_inputs: dict[int, th.Tensor] = {0: self._input_moments}
        of_outputs: dict[int, th.Tensor] = {}
        for index, block in enumerate(cotangents.split(_BLOCK_ROWS)):
            for layer, hidden, at_layer in self._backward(index, block):
                of_outputs[layer] = of_outputs.get(layer, 0.0) + self._moments(at_layer)
                if layer > 0:
                    of_inputs[layer] = of_inputs.get(layer, 0.0) + self._moments(hidden)
        return [(of_inputs[layer], of_outputs[layer]) for layer in range(len(self.layers))]

    @functools.cached_property
    def _input_moments(self) -> th.Tensor:
        """Of the first layer: the same for all parameters, and where there are many inputs the most work of all factors."""
        total, *others = (self._moments(hidden[0]) for hidden in self._hidden)
        return sum(others, start=total)

    def _moments(self, rows: th.Tensor) -> th.Tensor:
        """What a block adds to the mean of the outer products of its columns."""
        return rows @ rows.t() / self.batch_size

    def _jvp_block(self, index: int, tangents: list[th.Tensor]) -> th.Tensor:
        """How the outputs of a block move along a direction in parameter space, shape (n_out, B)."""
        tangent = th.empty(0)
        for layer, weights in enumerate(tangents):
            moved = weights @ self._hidden[index][layer]
            if layer > 0:
                moved.addmm_(self._linears[layer].weight, tangent)
            self._times_derivative_(index, layer, moved)
            tangent = moved
        return tangent

    def _accumulate_vjp(self, index: int, cotangents: th.Tensor, gradients: list[th.Tensor]) -> None:
        for layer, hidden, at_layer in self._backward(index, cotangents):
            gradients[layer].addmm_(at_layer, hidden.t())

    def _backward(self, index: int, cotangents: th.Tensor) -> Iterator[tuple[int, th.Tensor, th.Tensor]]:
        """
        Each linear layer of a block from the last to the first, with its inputs, ones included, and the cotangents at its
        output.
        """
        at_layer = cotangents.t().clone(memory_format=th.contiguous_format)
        for layer in range(len(self.layers) - 1, -1, -1):
            self._times_derivative_(index, layer, at_layer)
            yield layer, self._hidden[index][layer], at_layer
            if layer > 0:
                at_layer = self._linears[layer].weight.t() @ at_layer
