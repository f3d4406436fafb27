"""The preconditioner against dense linear algebra."""

import itertools

import pytest
import torch as th
from torch import nn

from sb3_gae.networks.dense_network import DenseNetwork
from sb3_gae.update.conjugate_gradient import CGStatus, conjugate_gradient
from sb3_gae.update.kronecker import KroneckerPreconditioner


def inputs_of(n_samples: int, n_inputs: int) -> th.Tensor:
    return th.randn(n_samples, n_inputs, generator=th.Generator().manual_seed(0), dtype=th.double)


def network_of(sizes: list[int], inputs: th.Tensor, bias: bool = True) -> DenseNetwork:
    """A tanh network in double precision, with its activations."""
    th.manual_seed(0)
    layers: list[nn.Module] = []
    for n_in, n_out in itertools.pairwise(sizes):
        layers += [nn.Linear(n_in, n_out, bias=bias).double(), nn.Tanh()]
    network = DenseNetwork(layers[:-1], inputs)
    network.forward()
    return network


def dense_gauss_newton(network: DenseNetwork) -> th.Tensor:
    """The mean of JᵀJ, a column at a time."""
    identity = th.eye(network.n_parameters, dtype=th.double)
    columns = [network.gauss_newton_product(column, lambda tangents, rows: tangents) for column in identity]
    return th.stack(columns) / network.batch_size


def ones(network: DenseNetwork) -> th.Tensor:
    return th.ones(network.batch_size, 1, dtype=th.double)


@pytest.mark.parametrize("bias", [True, False])
@pytest.mark.parametrize(("scale", "damping"), [(1.0, 0.1), (7.0, 1e-3), (0.01, 2.0)])
def test_is_the_exact_inverse_for_one_linear_layer(bias: bool, scale: float, damping: float) -> None:
    network = network_of([4, 1], inputs_of(50, 4), bias)
    curvature = scale * dense_gauss_newton(network) + damping * th.eye(network.n_parameters, dtype=th.double)
    vector = th.randn(network.n_parameters, dtype=th.double)
    preconditioned = KroneckerPreconditioner(network, ones(network))(vector, scale, damping)
    th.testing.assert_close(preconditioned, th.linalg.solve(curvature, vector), rtol=1e-9, atol=1e-12)


def test_the_factors_of_a_layer_are_the_second_moments_of_its_inputs_and_of_its_cotangents() -> None:
    inputs = inputs_of(40, 3)
    network = network_of([3, 5, 1], inputs)
    (first, second) = network.layers
    hidden = th.tanh(first[0](inputs)).detach()
    with_one = th.cat([inputs, th.ones(40, 1, dtype=th.double)], dim=1)
    cotangents = (1 - hidden**2) * second[0].weight.detach()
    of_inputs, of_cotangents = network.kronecker_factors(ones(network))[0]
    th.testing.assert_close(of_inputs, sum(th.outer(row, row) for row in with_one) / 40)
    th.testing.assert_close(of_cotangents, sum(th.outer(row, row) for row in cotangents) / 40)


def test_several_blocks_give_the_factors_of_one(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = network_of([3, 5, 1], inputs_of(40, 3)).kronecker_factors(th.ones(40, 1, dtype=th.double))
    monkeypatch.setattr("sb3_gae.networks.dense_network._BLOCK_ROWS", 7)
    pieces = network_of([3, 5, 1], inputs_of(40, 3)).kronecker_factors(th.ones(40, 1, dtype=th.double))
    for layer, layer_in_pieces in zip(whole, pieces, strict=True):
        for factor, factor_in_pieces in zip(layer, layer_in_pieces, strict=True):
            th.testing.assert_close(factor, factor_in_pieces)


def test_with_a_former_one_of_the_network_it_is_what_it_is_without() -> None:
    network = network_of([8, 6, 1], inputs_of(60, 8))
    former = KroneckerPreconditioner(network, ones(network))
    with th.no_grad():
        for parameter in network.parameters:
            parameter.mul_(1.5)
    network.forward()
    alone = network_of([8, 6, 1], inputs_of(60, 8))
    with th.no_grad():
        for parameter, scaled in zip(alone.parameters, network.parameters, strict=True):
            parameter.copy_(scaled)
    alone.forward()
    vector = th.randn(network.n_parameters, dtype=th.double)
    expected = KroneckerPreconditioner(alone, ones(alone))(vector, 3.0, 0.01)
    assert th.equal(KroneckerPreconditioner(network, ones(network), former=former)(vector, 3.0, 0.01), expected)
    assert not th.equal(former(vector, 3.0, 0.01), expected)


def test_is_symmetric_and_positive_definite() -> None:
    network = network_of([4, 6, 1], inputs_of(60, 4))
    precondition = KroneckerPreconditioner(network, ones(network))
    matrix = th.stack([precondition(row, 3.0, 0.01) for row in th.eye(network.n_parameters, dtype=th.double)])
    th.testing.assert_close(matrix, matrix.t())
    assert th.linalg.eigvalsh(matrix).min() > 0


def test_conjugate_gradient_finds_the_same_solution_with_it_and_is_nearer_after_a_few_steps() -> None:
    network = network_of([8, 12, 1], inputs_of(400, 8) * th.logspace(-1, 1, 8, dtype=th.double))
    damping = 1e-3
    curvature = dense_gauss_newton(network) + damping * th.eye(network.n_parameters, dtype=th.double)
    gradient = network.vjp(th.randn(400, 1, dtype=th.double)) / 400
    precondition = KroneckerPreconditioner(network, ones(network))
    solution = th.linalg.solve(curvature, gradient)

    def solved(steps: int, preconditioned: bool) -> th.Tensor:
        with_it = (lambda v: precondition(v, 1.0, damping)) if preconditioned else None
        result = conjugate_gradient(lambda v: curvature @ v, gradient, steps, 1e-10, preconditioner=with_it)
        th.testing.assert_close(result.product, curvature @ result.solution, rtol=1e-6, atol=1e-9)
        return result.solution

    def excess(x: th.Tensor) -> float:
        """How far the quadratic is from its maximum."""
        return float((x - solution) @ curvature @ (x - solution))

    for preconditioned in (False, True):
        th.testing.assert_close(solved(1000, preconditioned), solution, rtol=1e-6, atol=1e-8)
    assert excess(solved(3, preconditioned=True)) < excess(solved(8, preconditioned=False))


def test_progress_tolerance_ends_the_solver_when_a_step_adds_little() -> None:
    curvature = th.diag(th.logspace(0, 6, 30, dtype=th.double))
    vector = th.ones(30, dtype=th.double)
    gains = []
    for steps in range(1, 30):
        x = conjugate_gradient(lambda v: curvature @ v, vector, steps, relative_tolerance=0.0).solution
        gains.append(float(vector @ x - 0.5 * x @ curvature @ x))
    result = conjugate_gradient(lambda v: curvature @ v, vector, 30, progress_tolerance=0.05)
    expected = next(step for step in range(2, 30) if gains[step - 1] - gains[step - 2] <= 0.05 * gains[step - 1])
    assert (result.steps, result.status) == (expected, CGStatus.CONVERGED)


def test_wide_layers_do_without() -> None:
    narrow = DenseNetwork([nn.Linear(512, 4)], th.zeros(2, 512))
    wide = DenseNetwork([nn.Linear(513, 4)], th.zeros(2, 513))
    assert KroneckerPreconditioner.suits(narrow)
    assert not KroneckerPreconditioner.suits(wide)
