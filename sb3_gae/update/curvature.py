r"""
Curvature of a mean divergence at the point where it vanishes, as matrix-vector products.

The divergence is :math:`D_{KL}(\pi_{old} \| \pi)` for the policy, whose Hessian is the Fisher matrix, and
:math:`(V - V_{old})^2 / 2\sigma^2` for the value function, whose Hessian is the Gauss-Newton matrix over :math:`\sigma^2`.
The products here work for any network. :class:`~sb3_gae.networks.dense_network.DenseNetwork` has the fast ones for MLPs.
"""

from collections.abc import Callable, Sequence

import torch as th

from sb3_gae.networks.parameters import flat_gradient

CurvatureProduct = Callable[[th.Tensor], th.Tensor]


def hessian_product(divergence: th.Tensor, parameters: Sequence[th.Tensor]) -> CurvatureProduct:
    """
    Hessian-vector products by differentiating twice.

    :param divergence: a scalar with a graph that can be differentiated twice
    :param parameters: what to differentiate by, n scalars in all
    :return: maps (n,) to (n,)
    """
    gradient = flat_gradient(divergence, parameters, create_graph=True)

    def product(vector: th.Tensor) -> th.Tensor:
        return flat_gradient(gradient.dot(vector), parameters, retain_graph=True)

    return product
