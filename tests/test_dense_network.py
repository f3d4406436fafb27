"""Products of the dense network against Jacobians that autograd makes row by row, and which networks it refuses."""

import itertools

import pytest
import torch as th
from oracles import jacobian
from torch import nn

from sb3_gae.networks import dense_network
from sb3_gae.networks.dense_network import DenseNetwork

ACTIVATIONS: dict[str, nn.Module] = {
    "tanh": nn.Tanh(),
    "sigmoid": nn.Sigmoid(),
    "relu": nn.ReLU(),
    "relu in place": nn.ReLU(inplace=True),
    "leaky relu": nn.LeakyReLU(),
    "steep leaky relu": nn.LeakyReLU(0.4),
    "flat leaky relu": nn.LeakyReLU(0.0),
    "elu": nn.ELU(),
    "elu with alpha": nn.ELU(alpha=0.3),
    "flat elu": nn.ELU(alpha=0.0),
}
each_activation = pytest.mark.parametrize("activation", ACTIVATIONS.values(), ids=ACTIVATIONS.keys())


@pytest.fixture(autouse=True)
def small_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dense_network, "_BLOCK_ROWS", 4)


def layers_with(activation: nn.Module | None, sizes: list[int], bias: bool = True, last: bool = False) -> list[nn.Module]:
    """An MLP in double precision; ``last`` puts an activation after the last layer too."""
    th.manual_seed(0)
    layers: list[nn.Module] = []
    for n_in, n_out in itertools.pairwise(sizes):
        layers += [nn.Linear(n_in, n_out, bias=bias).double(), *([activation] if activation else [])]
    return layers if last or not activation else layers[:-1]


def inputs_for(n_samples: int, n_inputs: int = 3) -> th.Tensor:
    return th.randn(n_samples, n_inputs, generator=th.Generator().manual_seed(1), dtype=th.float64)


def tangents_of(network: DenseNetwork, vector: th.Tensor) -> th.Tensor:
    """How the outputs move along a direction: what a curvature product gives its metric, block by block."""
    blocks: list[th.Tensor] = []

    def metric(tangents: th.Tensor, rows: slice) -> th.Tensor:
        blocks.append(tangents)
        return tangents

    network.gauss_newton_product(vector, metric)
    return th.cat(blocks)


def check_products(layers: list[nn.Module], inputs: th.Tensor) -> None:
    """Outputs, both Jacobian products and a curvature product with a metric of its own for each sample."""
    network, module = DenseNetwork(layers, inputs), nn.Sequential(*layers)
    parameters = list(module.parameters())
    outputs = network.forward()
    th.testing.assert_close(outputs, module(inputs).detach(), rtol=1e-13, atol=1e-13)
    (n_samples, n_outputs), n = outputs.shape, sum(parameter.numel() for parameter in parameters)
    assert [id(parameter) for parameter in network.parameters] == [id(parameter) for parameter in parameters]
    assert (network.n_parameters, network.batch_size) == (n, len(inputs))

    generator = th.Generator().manual_seed(2)
    vector, cotangents, factors = (
        th.randn(*shape, generator=generator, dtype=th.float64)
        for shape in [(n,), (n_samples, n_outputs), (n_samples, n_outputs, n_outputs)]
    )
    dense = jacobian(lambda: module(inputs), parameters).reshape(n_samples, n_outputs, n)
    metrics = factors @ factors.transpose(1, 2)

    def metric(tangents: th.Tensor, rows: slice) -> th.Tensor:
        return th.einsum("bij,bj->bi", metrics[rows], tangents)

    exactly = dict(rtol=1e-11, atol=1e-11)
    th.testing.assert_close(tangents_of(network, vector), th.einsum("bon,n->bo", dense, vector), **exactly)
    th.testing.assert_close(network.vjp(cotangents), th.einsum("bon,bo->n", dense, cotangents), **exactly)
    expected = th.einsum("bin,bij,bjm,m->n", dense, metrics, dense, vector)
    th.testing.assert_close(network.gauss_newton_product(vector, metric), expected, **exactly)


@each_activation
@pytest.mark.parametrize("bias", [True, False], ids=["biases", "no biases"])
def test_products_of_each_activation(activation: nn.Module, bias: bool) -> None:
    layers = layers_with(activation, [3, 5, 4, 2], bias)
    assert DenseNetwork.supports(layers)
    check_products(layers, inputs_for(6))


@pytest.mark.parametrize("n_samples", [1, 3, 4, 5, 8, 9, 13])
def test_products_of_batches_around_the_size_of_a_block(n_samples: int) -> None:
    check_products(layers_with(nn.Tanh(), [3, 4, 2]), inputs_for(n_samples))


@each_activation
def test_products_with_an_activation_after_the_last_layer(activation: nn.Module) -> None:
    check_products(layers_with(activation, [3, 4, 2], last=True), inputs_for(5))


@pytest.mark.parametrize("sizes", [[3, 2], [3, 1], [1, 1], [3, 4, 2]])
def test_products_of_linear_layers_alone(sizes: list[int]) -> None:
    check_products(layers_with(None, sizes), inputs_for(5, sizes[0]))


def test_products_of_biases_here_and_there_and_of_mixed_activations() -> None:
    th.manual_seed(0)
    layers = [
        nn.Linear(3, 4, bias=False),
        nn.ReLU(),
        nn.Linear(4, 4),
        nn.Linear(4, 3, bias=False),
        nn.Sigmoid(),
        nn.Linear(3, 2),
    ]
    check_products([layer.double() for layer in layers], inputs_for(5))


@each_activation
def test_derivatives_at_zero_are_autograds(activation: nn.Module) -> None:
    layers = layers_with(activation, [2, 3, 2])
    with th.no_grad():
        layers[0].weight[0].zero_()
        layers[0].bias[0].zero_()
    check_products(layers, th.cat([inputs_for(3, 2), th.zeros(2, 2, dtype=th.float64)]))


def test_saturated_activations_keep_their_products_finite() -> None:
    for activation in (nn.Tanh(), nn.Sigmoid(), nn.ELU()):
        check_products(layers_with(activation, [3, 4, 2]), 1e3 * inputs_for(5))


def test_products_belong_to_the_parameters_of_the_last_forward_pass() -> None:
    layers, inputs = layers_with(nn.Tanh(), [3, 4, 2]), inputs_for(9)
    network = DenseNetwork(layers, inputs)
    first = network.forward()
    with th.no_grad():
        for layer in (layers[0], layers[2]):
            layer.weight.mul_(1.5)
            layer.bias.add_(0.1)
    second = network.forward()
    assert not th.allclose(first, second)
    cotangents = th.ones_like(second)
    fresh = DenseNetwork(layers, inputs)
    fresh.forward()
    assert th.equal(network.vjp(cotangents), fresh.vjp(cotangents))
    ones = th.ones(network.n_parameters).double()
    assert th.equal(tangents_of(network, ones), tangents_of(fresh, ones))


@each_activation
@pytest.mark.parametrize("bias", [True, False], ids=["biases", "no biases"])
def test_kronecker_factors_are_moments_of_inputs_and_of_gradients_at_outputs(activation: nn.Module, bias: bool) -> None:
    layers, inputs = layers_with(activation, [3, 5, 2], bias), inputs_for(9)
    cotangents = th.randn(9, 2, generator=th.Generator().manual_seed(2), dtype=th.float64)
    network = DenseNetwork(layers, inputs)
    network.forward()
    hidden = layers[0](inputs).detach().requires_grad_()
    activated = activation(hidden + 0.0)  # a copy, for activations in place
    (at_hidden,) = th.autograd.grad((layers[2](activated) * cotangents).sum(), hidden)
    factors = network.kronecker_factors(cotangents)
    assert len(factors) == 2
    for (of_inputs, of_outputs), features, gradients in zip(
        factors, (inputs, activated.detach()), (at_hidden, cotangents), strict=True
    ):
        if bias:
            features = th.cat([features, th.ones(9, 1)], dim=1)
        th.testing.assert_close(of_inputs, th.einsum("bi,bj->ij", features, features) / 9)
        th.testing.assert_close(of_outputs, th.einsum("bi,bj->ij", gradients, gradients) / 9)


def test_nothing_given_is_modified() -> None:
    layers, inputs = layers_with(nn.ReLU(inplace=True), [3, 4, 2]), inputs_for(5)
    given = [inputs, th.ones(26).double(), th.ones(5, 2).double(), *(p for layer in layers for p in layer.parameters())]
    before = [tensor.detach().clone() for tensor in given]
    network = DenseNetwork(layers, inputs)
    network.forward()
    network.vjp(given[2])
    network.gauss_newton_product(given[1], lambda tangents, rows: tangents)
    assert all(th.equal(tensor, copy) for tensor, copy in zip(given, before, strict=True))


def test_single_precision_stays_single() -> None:
    layers = [layer.float() for layer in layers_with(nn.Tanh(), [3, 4, 2])]
    network = DenseNetwork(layers, inputs_for(5).float())
    assert network.forward().dtype == th.float32
    assert tangents_of(network, th.ones(26)).dtype == network.vjp(th.ones(5, 2)).dtype == th.float32


# --- What it refuses ---


class MyLinear(nn.Linear):
    """Looks like a linear layer and need not act like one."""


@pytest.mark.parametrize("scale", [1e-30, 1e-10, 1e-3, 0.1, 1.0])
def test_outputs_in_single_precision_are_as_exact_as_torchs_whatever_their_size(scale: float) -> None:
    """A rounding of 1 in each hidden unit would be all there is of small ones."""
    doubles = layers_with(nn.Tanh(), [3, 4, 4, 2], bias=False)
    inputs = inputs_for(9) * scale
    exact = nn.Sequential(*doubles)(inputs).detach()
    singles = [layer.float() for layer in doubles]
    error = (DenseNetwork(singles, inputs.float()).forward().double() - exact).square().mean().sqrt()
    assert error < 1e-5 * exact.square().mean().sqrt()


class MyTanh(nn.Tanh):
    """Looks like tanh and need not act like it."""


@pytest.mark.parametrize(
    "layers",
    [
        [],
        [nn.Linear(2, 2), nn.GELU(), nn.Linear(2, 2)],
        [nn.Linear(2, 2), nn.SiLU(), nn.Linear(2, 2)],
        [nn.Linear(2, 2), nn.PReLU(), nn.Linear(2, 2)],
        # What comes out of these does not tell on which side of zero the input was
        [nn.Linear(2, 2), nn.LeakyReLU(-0.1), nn.Linear(2, 2)],
        [nn.Linear(2, 2), nn.ELU(-1.0), nn.Linear(2, 2)],
        [nn.Linear(2, 2), MyTanh(), nn.Linear(2, 2)],
        [nn.Linear(2, 2), nn.Dropout(), nn.Linear(2, 2)],
        [nn.Linear(2, 2), nn.LayerNorm(2), nn.Linear(2, 2)],
        [nn.Linear(2, 2), nn.Sequential(nn.Tanh()), nn.Linear(2, 2)],
        [nn.Tanh(), nn.Linear(2, 2)],
        [nn.Tanh()],
        [nn.Linear(2, 2), nn.Tanh(), nn.ReLU(), nn.Linear(2, 2)],
        [nn.Conv1d(2, 2, 1), nn.Tanh(), nn.Linear(2, 2)],
        [nn.Bilinear(2, 2, 2)],
        [MyLinear(2, 2)],
        [nn.utils.parametrizations.spectral_norm(nn.Linear(2, 2))],
        [nn.utils.parametrizations.weight_norm(nn.Linear(2, 2))],
    ],
    ids=lambda layers: "-".join(type(layer).__name__ for layer in layers) or "nothing",
)
def test_other_layers_and_orders_are_refused(layers: list[nn.Module]) -> None:
    assert not DenseNetwork.supports(layers)


@pytest.mark.parametrize("which", ["weight", "bias"])
def test_frozen_parameters_are_refused(which: str) -> None:
    layers = layers_with(nn.Tanh(), [3, 4, 2])
    getattr(layers[2], which).requires_grad_(False)
    assert not DenseNetwork.supports(layers)


def test_a_layer_that_occurs_twice_is_refused() -> None:
    layer = nn.Linear(3, 3)
    assert not DenseNetwork.supports([layer, nn.Tanh(), layer])


def test_tied_weights_are_refused() -> None:
    first, second = nn.Linear(3, 3), nn.Linear(3, 3)
    second.weight = first.weight
    assert not DenseNetwork.supports([first, nn.Tanh(), second])


@pytest.mark.parametrize("index", [0, 1, 2])
@pytest.mark.parametrize(
    "register",
    [
        "register_forward_hook",
        "register_forward_pre_hook",
        "register_full_backward_hook",
        "register_full_backward_pre_hook",
    ],
)
def test_hooks_are_refused_while_they_are_there(index: int, register: str) -> None:
    layers = layers_with(nn.Tanh(), [3, 4, 2])
    hook = getattr(layers[index], register)(lambda *_: None)
    assert not DenseNetwork.supports(layers)
    hook.remove()
    assert DenseNetwork.supports(layers)


@pytest.mark.parametrize("which", ["weight", "bias"])
def test_hooks_on_gradients_of_parameters_are_refused_while_they_are_there(which: str) -> None:
    layers = layers_with(nn.Tanh(), [3, 4, 2])
    hook = getattr(layers[2], which).register_hook(lambda gradient: 0.0 * gradient)
    assert not DenseNetwork.supports(layers)
    hook.remove()
    assert DenseNetwork.supports(layers)
