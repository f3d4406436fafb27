"""Weights beside biases, and flat vectors: one is the other in another order."""

import pytest
import torch as th
from hypothesis import given
from hypothesis import strategies as st
from torch import nn

from sb3_gae.networks.joined_layers import joined_columns, joined_parameters, joined_pieces, joined_zeros, separated
from sb3_gae.networks.parameters import flatten

some_layers = st.lists(st.tuples(st.integers(1, 5), st.integers(1, 5), st.booleans()), min_size=1, max_size=4).map(
    lambda shapes: [nn.Linear(n_in, n_out, bias=bias) for n_in, n_out, bias in shapes]
)


def flat_parameters(linears: list[nn.Linear]) -> th.Tensor:
    return flatten(parameter for linear in linears for parameter in linear.parameters())


@given(linears=some_layers)
def test_pieces_of_the_flat_parameters_are_the_joined_ones_and_back(linears: list[nn.Linear]) -> None:
    vector, joined = flat_parameters(linears), joined_parameters(linears)
    pieces = joined_pieces(linears, vector)
    assert all(th.equal(piece, matrix) for piece, matrix in zip(pieces, joined, strict=True))
    assert th.equal(separated(linears, pieces), vector)


@given(linears=some_layers, data=st.data())
def test_a_joined_matrix_does_to_inputs_with_a_one_what_the_layer_does(linears: list[nn.Linear], data: st.DataObject) -> None:
    linear = data.draw(st.sampled_from(linears))
    inputs = th.randn(3, linear.in_features, generator=th.Generator().manual_seed(0))
    followed = th.cat([inputs, th.ones(3, joined_columns(linear) - linear.in_features)], dim=1)
    th.testing.assert_close(followed @ joined_parameters([linear])[0].t(), linear(inputs))


@given(linears=some_layers)
def test_zeros_have_the_shape_and_the_type_of_the_parameters(linears: list[nn.Linear]) -> None:
    doubles = [linear.double() for linear in linears]
    zeros = joined_zeros(doubles)
    assert [matrix.shape for matrix in zeros] == [matrix.shape for matrix in joined_parameters(doubles)]
    assert all(matrix.dtype == th.float64 and not matrix.any() for matrix in zeros)


def test_a_vector_that_is_too_short_is_refused() -> None:
    with pytest.raises(RuntimeError, match="shape"):
        joined_pieces([nn.Linear(3, 2)], th.zeros(5))
