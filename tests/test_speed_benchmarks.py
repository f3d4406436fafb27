"""The arithmetic of the speed benchmarks; to time things is left to `python -m benchmarks.speed`."""

import copy
import math
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch as th
from torch.utils.flop_counter import FlopCounterMode

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.speed import operations as ops
from benchmarks.speed.growth import exponent
from benchmarks.speed.matrix_products import matrix_products
from benchmarks.update_speed import N_ACTIONS, N_STATES, Update, ours
from sb3_gae import TRPOGAE
from sb3_gae.collection import training_batch
from sb3_gae.curvature import hessian_product
from sb3_gae.dense_network import DenseNetwork
from sb3_gae.parameters import flatten

BATCH = 640
HIDDEN = (100, 50, 25)
LAYERS = ops.layers_of(N_STATES, HIDDEN, N_ACTIONS)
VALUE_LAYERS = ops.layers_of(N_STATES, HIDDEN, 1)


def counted(computation: Callable[[], object]) -> int:
    """:return: operations of matrix products as torch counts them"""

    def in_place(into: tuple, left: tuple, right: tuple, **_: object) -> int:
        return 2 * left[0] * left[1] * right[1]

    # torch does not know this one by itself
    with FlopCounterMode(display=False, custom_mapping={th.ops.aten.addmm_: in_place}) as counter:
        computation()
    return counter.get_total_flops()


@pytest.fixture
def network() -> DenseNetwork:
    modules: list[th.nn.Module] = []
    for layer in LAYERS:
        modules += [th.nn.Linear(*layer), th.nn.Tanh()]
    made = DenseNetwork(modules[:-1], th.randn(BATCH, N_STATES))
    made.forward()
    return made


@pytest.fixture(scope="module")
def model() -> TRPOGAE:
    return ours(BATCH)


def test_passes_of_a_network_are_what_torch_counts(network: DenseNetwork) -> None:
    vector, outputs = th.randn(network.n_parameters), th.randn(BATCH, N_ACTIONS)
    passes = {
        ops.operations(ops.forward(LAYERS, BATCH)): network.forward,
        ops.operations(ops.backward(LAYERS, BATCH)): lambda: network.vjp(outputs),
        ops.operations(ops.tangents(LAYERS, BATCH)): lambda: network.jvp(vector),
        ops.operations(ops.curvature_product(LAYERS, BATCH)): lambda: network.gauss_newton_product(vector, lambda x, _: x),
        ops.operations(ops.kronecker_factors(LAYERS, BATCH)): lambda: network.kronecker_factors(outputs),
    }
    assert {expected: counted(computation) for expected, computation in passes.items()} == {each: each for each in passes}
    assert network.n_parameters == ops.n_parameters(LAYERS)


def test_double_backward_is_what_torch_counts(network: DenseNetwork) -> None:
    layers = th.nn.Sequential(*(module for pair in network.layers for module in pair if module is not None))
    outputs = layers(th.cat(network.blocks))
    product = hessian_product(0.5 * (outputs - outputs.detach()).square().mean(), network.parameters)
    vector = flatten(network.parameters)
    assert counted(lambda: product(vector)) == ops.operations(ops.double_backward(LAYERS, BATCH))


@pytest.mark.parametrize("curvature_samples", [None, 200])
def test_an_update_is_what_torch_counts(model: TRPOGAE, curvature_samples: int | None) -> None:
    model = copy.copy(model)
    model.curvature_samples = curvature_samples
    update, batch = Update(model), training_batch(model.rollout_buffer, model.action_space)
    parameters, records = model._parameter_groups(batch), {}
    n_curvature = curvature_samples or BATCH

    def step() -> None:
        records["policy"] = model._step_policy(batch, parameters)

    def fit() -> None:
        records["value"] = model._fit_value(batch, parameters)

    found = [counted(step), counted(fit)]
    update.rewind()
    policy, *steps = (
        ops.solved(record.cg_status, record.cg_steps, record.trials) for record in (records["policy"], *records["value"].steps)
    )
    assert len(steps) > 1
    assert found == [
        ops.operations(ops.policy_step(LAYERS, BATCH, n_curvature, policy)),
        ops.operations(ops.value_fit(VALUE_LAYERS, BATCH, n_curvature, steps)),
    ]


def test_the_limit_multiplies_what_it_is_told_to() -> None:
    products = ops.curvature_product(LAYERS, 10_000)
    assert counted(matrix_products(products)) == ops.operations(products)
    assert ops.operations(ops.times(products, 3)) == 3 * ops.operations(products)


@pytest.mark.parametrize("power", [0.0, 0.5, 1.0, 2.0])
def test_the_exponent_of_a_power_is_found(power: float) -> None:
    sizes = [100, 400, 1600]
    assert exponent(sizes, [3.0 * size**power for size in sizes]) == pytest.approx(power, abs=1e-9)
    assert math.isnan(exponent([100], [1.0]))


def test_noise_of_the_smallest_size_does_not_turn_the_exponent() -> None:
    assert exponent([1, 10, 100], np.array([1.1, 10.0, 100.0])) == pytest.approx(1.0, abs=0.03)
