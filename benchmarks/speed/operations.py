r"""
How many operations the passes of an update are, as the matrix products that they consist of.

A product of matrices of shapes (m, k) and (k, n) is :math:`2mkn` operations, a multiplication and an addition for each term.
All else is left out: activations, vectors as long as the parameters, eigendecompositions. What comes out is thus a lower
bound.

An MLP has layers :math:`h_l = f(W_l (h_{l-1}, 1))`, the bias the last column of the weights, with :math:`n_{l-1}` inputs and
:math:`n_l` outputs, over a batch of B samples. With :math:`S = \sum_l (n_{l-1} + 1) n_l` over all layers, and
:math:`T = \sum_l n_{l-1} n_l`, of weights alone, over all but the first:

- *forward*: :math:`W_l (h_{l-1}, 1)` for each layer, :math:`2BS`;
- *cotangents*, what an output's cotangents are further up: :math:`W_l^\top c_l` for each layer but the first, whose inputs
  are data, :math:`2BT`;
- *backward*, a product with the transposed Jacobian: the cotangents, and :math:`c_l (h_{l-1}, 1)^\top` for each layer,
  :math:`2B(S + T)`;
- *tangents*, a product with the Jacobian: :math:`\dot W_l (h_{l-1}, 1)` for each layer, and :math:`W_l \dot h_{l-1}` for
  each but the first, whose inputs do not move, :math:`2B(S + T)`;
- *curvature product*, Fisher or Gauss-Newton alike: tangents and backward, :math:`4B(S + T)`. The metric between the two
  acts on each sample alone;
- *double backward*, the same by differentiating the gradient, as torch does it, whose biases are no part of matrix
  products: of :math:`c_l h_{l-1}^\top` by both factors, of :math:`W_l^\top c_l` by both, and the backward pass through
  the forward one, :math:`2B(2 \sum_l n_{l-1} n_l + 4T)`;
- *Kronecker factors*: the cotangents, and for each layer the second moments of its inputs, with a 1 for the bias, and of the
  cotangents at its output, :math:`2B\sum_l ((n_{l-1}+1)^2 + n_l^2)`; to apply them takes for each layer two products
  from each side with a matrix of its weights' shape.

A policy step on B samples with the curvature on C of them is a forward and a backward pass over B, a forward pass and
the Kronecker factors over C, a curvature product over C and an application of the factors for each step of conjugate gradient,
and a forward pass over B for each trial of the line search. A value step is the same less the first forward pass, which is
the last trial of the step before. Its curvature needs no forward pass of its own where C is B, and the second moments of
the inputs of the first layer are those of the first step.
"""

import itertools
from collections import Counter
from collections.abc import Iterable, Sequence
from typing import NamedTuple

from sb3_gae.update.conjugate_gradient import CGStatus


class Product(NamedTuple):
    """
    Two matrices are multiplied.

    :param rows: of the first
    :param inner: columns of the first, rows of the second
    :param columns: of the second
    """

    rows: int
    inner: int
    columns: int


class Layer(NamedTuple):
    """
    :param n_in: inputs of a linear layer with a bias
    :param n_out: its outputs
    """

    n_in: int
    n_out: int


#: the products of a computation, and how many there are of each shape
Products = Counter[Product]


class Solved(NamedTuple):
    """
    What of the work of a trust-region step depends on the numbers.

    :param cg_products: curvature products of conjugate gradient
    :param cg_solves: applications of the preconditioner
    :param trials: lengths that the line search tried
    """

    cg_products: int
    cg_solves: int
    trials: int


def layers_of(n_in: int, hidden: Sequence[int], n_out: int) -> list[Layer]:
    """
    :param n_in: inputs of the network
    :param hidden: widths of its hidden layers
    :param n_out: outputs of the network
    :return: from the first to the last
    """
    return [Layer(*pair) for pair in itertools.pairwise([n_in, *hidden, n_out])]


def n_parameters(layers: Iterable[Layer]) -> int:
    """
    :param layers: of an MLP
    :return: number of weights and biases
    """
    return sum((layer.n_in + 1) * layer.n_out for layer in layers)


def operations(products: Products) -> int:
    """
    :param products: of a computation
    :return: multiplications and additions
    """
    return sum(2 * product.rows * product.inner * product.columns * count for product, count in products.items())


def times(products: Products, count: int) -> Products:
    """
    :param products: of a computation
    :param count: how often it is done
    :return: products of all of that
    """
    return Counter({product: count * number for product, number in products.items()})


def forward(layers: Sequence[Layer], batch: int) -> Products:
    """
    :param layers: of an MLP
    :param batch: rows
    :return: of a forward pass
    """
    return Counter(Product(n_out, n_in + 1, batch) for n_in, n_out in layers)


def cotangents(layers: Sequence[Layer], batch: int) -> Products:
    """
    :param layers: of an MLP
    :param batch: rows
    :return: of the cotangents at each layer's output, from those at the last one's
    """
    return Counter(Product(layer.n_in, layer.n_out, batch) for layer in layers[1:])


def backward(layers: Sequence[Layer], batch: int) -> Products:
    """
    :param layers: of an MLP
    :param batch: rows
    :return: of a product with the transposed Jacobian by weights and biases
    """
    return cotangents(layers, batch) + Counter(Product(n_out, batch, n_in + 1) for n_in, n_out in layers)


def tangents(layers: Sequence[Layer], batch: int) -> Products:
    """
    :param layers: of an MLP
    :param batch: rows
    :return: of a product with the Jacobian by weights and biases
    """
    return forward(layers, batch) + _weights_alone(layers[1:], batch)


def curvature_product(layers: Sequence[Layer], batch: int) -> Products:
    """
    :param layers: of an MLP
    :param batch: rows
    :return: of a product with its Fisher or Gauss-Newton matrix, the activations at hand
    """
    return tangents(layers, batch) + backward(layers, batch)


def double_backward(layers: Sequence[Layer], batch: int) -> Products:
    """
    :param layers: of an MLP
    :param batch: rows
    :return: of a product with the Hessian of a divergence by differentiating its gradient, whose graph is at hand
    """
    of_weight_gradients = _weights_alone(layers, batch) + cotangents(layers, batch)
    of_cotangents = _weights_alone(layers[1:], batch) + _gradients_alone(layers[1:], batch)
    return of_weight_gradients + of_cotangents + cotangents(layers, batch) + _gradients_alone(layers, batch)


def _weights_alone(layers: Iterable[Layer], batch: int) -> Products:
    return Counter(Product(n_out, n_in, batch) for n_in, n_out in layers)


def _gradients_alone(layers: Iterable[Layer], batch: int) -> Products:
    return Counter(Product(n_out, batch, n_in) for n_in, n_out in layers)


def kronecker_factors(layers: Sequence[Layer], batch: int, again: bool = False) -> Products:
    """
    :param layers: of an MLP
    :param batch: rows
    :param again: whether those of the inputs of the first are known from a former call
    :return: of the second moments at each layer
    """
    widths = [width for layer in layers for width in (layer.n_in + 1, layer.n_out)]
    return cotangents(layers, batch) + Counter(Product(width, batch, width) for width in widths[again:])


def kronecker_solve(layers: Sequence[Layer]) -> Products:
    """
    :param layers: of an MLP
    :return: of one application of the preconditioner
    """
    sides = [
        product for n_in, n_out in layers for product in (Product(n_out, n_out, n_in + 1), Product(n_out, n_in + 1, n_in + 1))
    ]
    return times(Counter(sides), 2)


def solved(status: CGStatus, steps: int, trials: int) -> Solved:
    """
    :param status: how conjugate gradient ended
    :param steps: curvature products that entered the direction
    :param trials: lengths that the line search tried
    :return: what that took
    """
    if status is CGStatus.ZERO_GRADIENT:
        return Solved(0, 0, trials)
    # One that was found to have no positive curvature is not among the steps
    products = steps + (status is CGStatus.NON_POSITIVE_CURVATURE)
    # One for the first direction and one after each step, but not after the one that ends the solve
    return Solved(products, steps + (status is not CGStatus.CONVERGED), trials)


def conjugate_gradient(layers: Sequence[Layer], batch: int, what: Solved) -> Products:
    """
    :param layers: of an MLP
    :param batch: rows of the curvature
    :param what: the solve took
    :return: of the solve, preconditioned
    """
    return times(curvature_product(layers, batch), what.cg_products) + times(kronecker_solve(layers), what.cg_solves)


def policy_step(layers: Sequence[Layer], batch: int, curvature_batch: int, what: Solved) -> Products:
    """
    :param layers: of the policy, from observations to means or logits
    :param batch: samples
    :param curvature_batch: samples of the curvature
    :param what: the step took
    :return: of the step
    """
    return (
        forward(layers, batch)
        + backward(layers, batch)
        + forward(layers, curvature_batch)
        + kronecker_factors(layers, curvature_batch)
        + conjugate_gradient(layers, curvature_batch, what)
        + times(forward(layers, batch), what.trials)
    )


def value_fit(layers: Sequence[Layer], batch: int, curvature_batch: int, steps: Iterable[Solved]) -> Products:
    """
    :param layers: of the value function
    :param batch: samples
    :param curvature_batch: samples of the curvature
    :param steps: what each of them took
    :return: of the fit
    """
    products = forward(layers, batch)
    for step, what in enumerate(steps):
        products += backward(layers, batch) + kronecker_factors(layers, curvature_batch, again=step > 0)
        products += conjugate_gradient(layers, curvature_batch, what) + times(forward(layers, batch), what.trials)
        if curvature_batch != batch:
            products += forward(layers, curvature_batch)
    return products
