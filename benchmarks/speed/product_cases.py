"""Curvature products and the conjugate gradient solve that they serve, on the whole of a batch."""

from collections.abc import Callable, Iterator
from functools import partial

import torch as th
from sb3_contrib.common.utils import conjugate_gradient_solver

from benchmarks.speed import operations as ops
from benchmarks.speed.case import DOUBLE_BACKWARD, LIMIT, OURS, PEER, Case, Prepared
from benchmarks.speed.matrix_products import matrix_products
from benchmarks.speed.plan import Plan
from benchmarks.speed.rollouts import HIDDEN, Rollout, peer_gradients, policy_layers, rollout
from sb3_gae.networks.dense_policy import dense_value_network
from sb3_gae.networks.parameters import flat_gradient
from sb3_gae.update.conjugate_gradient import CGResult, conjugate_gradient
from sb3_gae.update.curvature import hessian_product
from sb3_gae.update.policy_step import DenseFisher, autograd_fisher_product
from sb3_gae.update.value_step import value_scale


def product_cases(plan: Plan) -> Iterator[Case]:
    """
    :param plan: with the sizes
    :return: products and solves against batch and number of parameters
    """
    for varied, size, batch, hidden in network_sizes(plan):
        for part, contenders in _PARTS.items():
            for who, prepare in contenders.items():
                yield Case(part, varied, size, who, partial(_prepare, prepare, batch, hidden))


def network_sizes(plan: Plan) -> Iterator[tuple[str, int, int, tuple[int, ...]]]:
    """
    :param plan: with the sizes
    :return: what is varied, its value, the batch, and the widths of the hidden layers
    """
    for batch in plan.batches:
        yield "batch", batch, batch, HIDDEN
    for width in plan.widths:
        hidden = (width, width)
        yield "parameters", ops.n_parameters(policy_layers(hidden)), plan.width_batch, hidden


def _prepare(prepare: Callable[[Rollout], Prepared], batch: int, hidden: tuple[int, ...]) -> Prepared:
    return prepare(rollout(batch, hidden))


def _fisher(of: Rollout) -> Prepared:
    fisher = DenseFisher(of.model.policy, of.batch.observations)
    return _applied(fisher.product, fisher.parameters, ops.curvature_product(of.policy_layers, len(of.batch)))


def _autograd_fisher(of: Rollout) -> Prepared:
    product = autograd_fisher_product(of.model.policy, of.parameters.of_policy, of.batch.observations)
    return _applied(product, of.parameters.of_policy, ops.double_backward(of.policy_layers, len(of.batch)))


def _peer_fisher(of: Rollout) -> Prepared:
    at = peer_gradients(of)
    product = partial(at.peer.hessian_vector_product, at.parameters, at.of_divergence)
    return _applied(product, at.parameters, ops.double_backward(of.policy_layers, len(of.batch)))


def _gauss_newton(of: Rollout) -> Prepared:
    network = dense_value_network(of.model.policy, of.batch.observations)
    network.forward()

    def product(vector: th.Tensor) -> th.Tensor:
        return network.gauss_newton_product(vector, lambda tangents, rows: tangents)

    return _applied(product, network.parameters, ops.curvature_product(of.value_layers, len(of.batch)))


def _autograd_gauss_newton(of: Rollout) -> Prepared:
    values = of.model.policy.predict_values(of.batch.observations) / value_scale(of.model.policy)
    product = hessian_product(0.5 * (values - values.detach()).square().mean(), of.parameters.of_value)
    return _applied(product, of.parameters.of_value, ops.double_backward(of.value_layers, len(of.batch)))


def _applied(product: Callable[[th.Tensor], object], parameters: list, products: ops.Products) -> Prepared:
    vector = th.randn(sum(parameter.numel() for parameter in parameters), generator=th.Generator().manual_seed(0))
    return Prepared(lambda: product(vector), facts={"operations": ops.operations(products)})


def limit_of(products: ops.Products) -> Prepared:
    """
    :param products: of what it is the limit of
    :return: these products alone
    """
    return Prepared(matrix_products(products), facts={"operations": ops.operations(products)})


def _solver(of: Rollout) -> Callable[[], CGResult]:
    """The policy's direction, as :func:`sb3_gae.update.policy_step.policy_step` solves for it."""
    model, batch = of.model, of.batch
    fisher, damping = DenseFisher(model.policy, batch.observations), model.cg_damping
    fisher.prepare(batch.actions)
    log_prob = model.policy.get_distribution(batch.observations).log_prob(batch.actions)
    gradient = flat_gradient((batch.advantages * log_prob).mean(), fisher.parameters)

    def solve() -> CGResult:
        return conjugate_gradient(
            lambda vector: fisher.product(vector) + damping * vector,
            gradient,
            model.cg_max_steps,
            progress_tolerance=model.cg_tolerance,
            preconditioner=lambda vector: fisher.precondition(vector, damping),
        )

    return solve


def _solve(of: Rollout) -> Prepared:
    solve = _solver(of)
    found = solve()
    products = _products_of(of, found)
    return Prepared(solve, facts={"operations": ops.operations(products), "cg_steps": found.steps})


def _products_of(of: Rollout, found: CGResult) -> ops.Products:
    return ops.conjugate_gradient(of.policy_layers, len(of.batch), ops.solved(found.status, found.steps, 0))


def _peer_solve(of: Rollout) -> Prepared:
    at, calls = peer_gradients(of), []

    def product(vector: th.Tensor) -> th.Tensor:
        calls.append(vector)
        return at.peer.hessian_vector_product(at.parameters, at.of_divergence, vector)

    def solve() -> None:
        th.manual_seed(0)
        calls.clear()
        conjugate_gradient_solver(product, at.of_objective, max_iter=at.peer.cg_max_steps)

    solve()
    return Prepared(solve, facts={"cg_steps": len(calls)})


_PARTS: dict[str, dict[str, Callable[[Rollout], Prepared]]] = {
    "Fisher product": {
        OURS: _fisher,
        DOUBLE_BACKWARD: _autograd_fisher,
        PEER: _peer_fisher,
        LIMIT: lambda of: limit_of(ops.curvature_product(of.policy_layers, len(of.batch))),
    },
    "Gauss-Newton product": {
        OURS: _gauss_newton,
        DOUBLE_BACKWARD: _autograd_gauss_newton,
        LIMIT: lambda of: limit_of(ops.curvature_product(of.value_layers, len(of.batch))),
    },
    "conjugate gradient": {
        OURS: _solve,
        PEER: _peer_solve,
        LIMIT: lambda of: limit_of(_products_of(of, _solver(of)())),
    },
}
