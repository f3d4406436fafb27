r"""
Kronecker-factored preconditioner for curvature products of an MLP.

The block of the curvature that belongs to one layer is about :math:`A \otimes G` (K-FAC, Martens and Grosse 2015):
:math:`A` the second moment of the layer's inputs, :math:`G` that of the cotangents at its output. As a preconditioner
the approximation costs no accuracy. It decides how fast conjugate gradient converges, and not what it converges to.
"""

from collections.abc import Mapping
from types import MappingProxyType

import torch as th
from torch import nn

from sb3_gae.networks.dense_network import DenseNetwork
from sb3_gae.networks.joined_layers import joined_pieces, separated

#: second moments of cotangents at the outputs of linear layers, shapes (n_out, n_out)
OutputMoments = Mapping[nn.Module, th.Tensor]

# Eigenvalues of a second moment, shape (n,), and its eigenvectors as columns, shape (n, n)
_Eigen = tuple[th.Tensor, th.Tensor]

NOTHING_ADDED: OutputMoments = MappingProxyType({})

# Eigendecompositions grow with the cube of a layer's width; above this they cost more than the products that they save
WIDEST_LAYER = 512


class KroneckerPreconditioner:
    """
    An approximate inverse of the damped curvature, layer by layer.

    :param network: after :meth:`~sb3_gae.networks.dense_network.DenseNetwork.forward`
    :param cotangents: one for each output, whose covariance is the output metric, shape (B, n_out)
    :param added: second moments of further cotangents at the outputs of some layers, where the curvature of another
        network with these layers is added: both have the same inputs, so that the sum is a Kronecker product again
    :param former: of the same network with other parameters. The inputs of the first layer are the same for all, and so is
        the eigendecomposition of their moments
    """

    def __init__(
        self,
        network: DenseNetwork,
        cotangents: th.Tensor,
        added: OutputMoments = NOTHING_ADDED,
        former: "KroneckerPreconditioner | None" = None,
    ):
        self._layers = [linear for linear, _ in network.layers]
        factors = network.kronecker_factors(cotangents)
        first = _eigh(factors[0][0]) if former is None else former._eigen[0][0]
        self._eigen: list[tuple[_Eigen, _Eigen]] = [
            (_eigh(inputs) if index else first, _eigh(outputs + added[layer] if layer in added else outputs))
            for index, (layer, (inputs, outputs)) in enumerate(zip(self._layers, factors, strict=True))
        ]

    @staticmethod
    def suits(network: DenseNetwork) -> bool:
        """
        :param network: any
        :return: whether its layers are narrow enough for this to pay
        """
        return all(max(linear.weight.shape) <= WIDEST_LAYER for linear, _ in network.layers)

    @th.no_grad()
    def __call__(self, vector: th.Tensor, scale: float, damping: float) -> th.Tensor:
        r"""
        Solve :math:`(c\,A \otimes G + d) x = v` for each layer.

        :param vector: in the order of the network's parameters, shape (n,)
        :param scale: :math:`c`, what the curvature is a multiple by
        :param damping: :math:`d`, positive
        :return: shape (n,)
        """
        solved = []
        for matrix, ((input_values, input_vectors), (output_values, output_vectors)) in zip(
            joined_pieces(self._layers, vector), self._eigen, strict=True
        ):
            rotated = output_vectors.t() @ matrix @ input_vectors
            rotated /= scale * output_values[:, None] * input_values + damping
            solved.append(output_vectors @ rotated @ input_vectors.t())
        return separated(self._layers, solved)


def _eigh(matrix: th.Tensor) -> _Eigen:
    values, vectors = th.linalg.eigh(matrix)
    # Rounding may leave a semi-definite matrix with eigenvalues just below zero
    return values.clamp_min(0.0), vectors
