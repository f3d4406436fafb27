"""Flat vectors of parameters, and batches that are tensors or dictionaries of tensors."""

import numpy as np
import pytest
import torch as th
from oracles import jacobian
from torch import nn

from sb3_gae import batch as batch_module
from sb3_gae.batch import TrainingBatch, batch_size, in_chunks, random_subset, standardized, take
from sb3_gae.networks.parameters import assign, flat_gradient, flatten, influencing_parameters, positions, unflatten

# --- Parameters ---


def shapes() -> list[th.Tensor]:
    return [th.arange(6.0).reshape(2, 3), th.tensor(6.0), th.tensor([]), th.arange(7.0, 9.0)]


def test_flatten_keeps_the_order_of_tensors_and_rows() -> None:
    assert flatten(shapes()).tolist() == list(range(9))


def test_flatten_is_a_copy_without_a_graph() -> None:
    parameter = nn.Parameter(th.ones(3))
    vector = flatten([parameter])
    assert not vector.requires_grad
    vector.zero_()
    assert parameter.tolist() == [1.0, 1.0, 1.0]


def test_assign_undoes_flatten_bit_for_bit() -> None:
    numbers = th.tensor([0.1, -0.0, 1e-45, 3e38, float("nan"), float("inf"), 2.0, 3.0, 4.0])
    parameters = [nn.Parameter(tensor.clone()) for tensor in shapes()]
    assign(parameters, numbers)
    assert np.array_equal(flatten(parameters).numpy().view(np.uint32), numbers.numpy().view(np.uint32))


def test_assign_writes_in_place_and_needs_no_graph() -> None:
    layer = nn.Linear(2, 2)
    weight, storage = layer.weight, layer.weight.data_ptr()
    assign(layer.parameters(), th.arange(6.0))
    assert layer.weight is weight
    assert weight.data_ptr() == storage
    assert weight.requires_grad
    assert weight.tolist() == [[0.0, 1.0], [2.0, 3.0]]


def test_assigned_parameters_share_no_memory_with_the_vector() -> None:
    parameter, vector = nn.Parameter(th.zeros(3)), th.ones(3)
    assign([parameter], vector)
    vector.zero_()
    assert parameter.tolist() == [1.0, 1.0, 1.0]


def test_unflatten_gives_views_in_the_shapes_of_the_parameters() -> None:
    vector = th.arange(9.0)
    for (parameter, piece), original in zip(unflatten(shapes(), vector), shapes(), strict=True):
        assert th.equal(piece, original)
        assert parameter.shape == piece.shape
        piece.add_(1.0)
    assert vector.tolist() == list(range(1, 10))


def test_positions_are_where_the_values_of_some_are_in_the_vector_of_all() -> None:
    everything = shapes()
    some = [everything[3], everything[2], everything[0]]
    assert flatten(everything)[positions(everything, some)].tolist() == flatten(some).tolist()
    # Which tensor it is decides, and not what it holds
    twins = [th.zeros(2), th.zeros(2)]
    assert positions(twins, [twins[1]]).tolist() == [2, 3]


def test_flat_gradient_is_zero_where_there_is_no_dependence() -> None:
    used, unused = nn.Parameter(th.tensor([2.0, 3.0])), nn.Parameter(th.ones(2, 2))
    assert flat_gradient((used**2).sum(), [unused, used]).tolist() == [0.0] * 4 + [4.0, 6.0]


def test_flat_gradient_can_be_differentiated_again() -> None:
    parameter = nn.Parameter(th.tensor([2.0, 3.0], dtype=th.float64))
    gradient = flat_gradient((parameter**3).sum(), [parameter], create_graph=True)
    assert th.equal(jacobian(lambda: gradient, [parameter]), th.diag(6.0 * parameter.detach()))


def test_influencing_parameters_are_found_through_the_graph_in_the_order_given() -> None:
    first, second, frozen, apart = (nn.Parameter(th.ones(2)) for _ in range(4))
    frozen.requires_grad_(False)
    outputs = second * frozen + first
    found = influencing_parameters(outputs, [apart, frozen, first, second])
    assert [id(parameter) for parameter in found] == [id(first), id(second)]


def test_an_influence_whose_gradient_happens_to_be_zero_counts() -> None:
    dead = nn.Parameter(th.tensor(-1.0))
    assert influencing_parameters(th.relu(dead), [dead])[0] is dead


def test_a_detached_influence_does_not_count() -> None:
    first, second = nn.Parameter(th.ones(2)), nn.Parameter(th.ones(2))
    assert [id(found) for found in influencing_parameters(first.detach() * second, [first, second])] == [id(second)]


def test_without_a_graph_or_without_candidates_nothing_is_found() -> None:
    parameter = nn.Parameter(th.ones(2))
    with th.no_grad():
        assert influencing_parameters(parameter * 2, [parameter]) == []
    assert influencing_parameters(parameter * 2, []) == []


# --- Batches ---


def some_batch(n_samples: int = 6) -> TrainingBatch:
    numbers = th.arange(float(n_samples))
    return TrainingBatch({"a": numbers[:, None], "b": -numbers[:, None, None]}, numbers.long(), 10 * numbers, 100 * numbers)


def test_taking_from_a_batch_takes_the_same_samples_of_everything() -> None:
    taken = some_batch().take(th.tensor([4, 1]))
    assert len(taken) == 2
    assert taken.observations["a"].tolist() == [[4.0], [1.0]]
    assert taken.observations["b"].tolist() == [[[-4.0]], [[-1.0]]]
    assert taken.actions.tolist() == [4, 1]
    assert taken.advantages.tolist() == [40.0, 10.0]
    assert taken.value_targets.tolist() == [400.0, 100.0]


def test_what_is_taken_is_a_copy() -> None:
    batch = some_batch()
    taken = batch.take(th.tensor([2]))
    taken.advantages.zero_()
    taken.observations["a"].zero_()
    assert batch.advantages[2] == 20.0
    assert batch.observations["a"][2] == 2.0


def test_size_and_samples_of_observations_of_both_kinds() -> None:
    tensor = th.arange(12.0).reshape(6, 2)
    for observations in (tensor, {"x": tensor, "y": tensor[:, 0]}):
        assert batch_size(observations) == 6
        assert batch_size(take(observations, slice(1, 4))) == 3
        assert batch_size(take(observations, th.tensor([0, 0, 5, 5]))) == 4


@pytest.mark.parametrize(("n_samples", "at_most"), [(5, None), (5, 5), (5, 6), (1, 1)])
def test_no_subset_is_drawn_where_everything_fits(n_samples: int, at_most: int | None) -> None:
    state = np.random.get_state()[1].copy()
    assert random_subset(n_samples, at_most, th.device("cpu")) is None
    assert np.array_equal(np.random.get_state()[1], state)


def test_a_subset_is_sorted_without_repetition_and_repeats_under_a_seed() -> None:
    np.random.seed(0)
    first, second = (random_subset(100, 30, th.device("cpu")) for _ in range(2))
    np.random.seed(0)
    assert th.equal(random_subset(100, 30, th.device("cpu")), first)
    assert not th.equal(first, second)
    assert len(first) == 30
    assert (first.diff() > 0).all()
    assert 0 <= first[0] <= first[-1] < 100


def test_every_sample_has_the_same_chance_of_being_in_a_subset() -> None:
    np.random.seed(0)
    counts = th.zeros(8)
    for _ in range(2000):
        counts[random_subset(8, 2, th.device("cpu"))] += 1
    # Five deviations of a binomial of 2000 draws at 1/4
    assert (counts - 500).abs().max() < 5 * (2000 * 0.25 * 0.75) ** 0.5


@pytest.mark.parametrize("chunk_values", [1, 3, 4, 7, 12, 1000])
@pytest.mark.parametrize("dictionary", [False, True], ids=["tensor", "dictionary"])
def test_pieces_give_what_the_whole_gives_and_bound_the_rows(
    chunk_values: int, dictionary: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(batch_module, "_CHUNK_VALUES", chunk_values)
    tensor, other = th.arange(12.0).reshape(6, 2), 100 * th.arange(6.0)
    observations = {"x": tensor, "y": tensor[:, :1]} if dictionary else tensor
    rows, values_of_a_row = [], 3 if dictionary else 2

    def function(part, of_other: th.Tensor) -> th.Tensor:
        rows.append(batch_size(part))
        assert not th.is_grad_enabled()
        return sum(each.sum(dim=1) for each in part.values()) + of_other if dictionary else part.sum(dim=1) + of_other

    result = in_chunks(function, observations, other)
    expected = tensor.sum(dim=1) + other + (tensor[:, 0] if dictionary else 0.0)
    assert th.equal(result, expected)
    assert sum(rows) == 6
    assert max(rows) <= max(1, chunk_values // values_of_a_row)


def test_pieces_are_without_a_graph() -> None:
    parameter = nn.Parameter(th.ones(2))
    assert not in_chunks(lambda part: part @ parameter, th.ones(3, 2)).requires_grad
    assert th.is_grad_enabled()


@pytest.mark.parametrize("constant", [0.1, -1e30, 1e-30, 0.0])
def test_standardizing_equal_advantages_gives_zeros_and_not_rounding_blown_up(constant: float) -> None:
    advantages = th.full((1000,), constant)
    assert th.equal(standardized(advantages), th.zeros(1000))


@pytest.mark.parametrize("scale", [1e-30, 1.0, 1e30])
def test_standardizing_gives_mean_0_and_deviation_1_at_any_scale(scale: float) -> None:
    advantages = scale * th.tensor([1.0, 2.0, 4.0])
    expected = th.tensor([1.0, 2.0, 4.0], dtype=th.double)
    expected = (expected - expected.mean()) / expected.std()
    th.testing.assert_close(standardized(advantages).double(), expected, rtol=1e-5, atol=1e-6)
