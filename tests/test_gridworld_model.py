"""The grid itself: where moves lead, what is refused."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sb3_gae.gridworld import MOVE_NAMES, TabularMDP, TabularPolicy, gridworld, optimal_values


def led_to(mdp: TabularMDP, cell: tuple[int, int], move: str) -> dict[tuple[int, int], float]:
    row = mdp.transitions[cell[0] * 5 + cell[1], MOVE_NAMES.index(move)]
    return {divmod(int(state), 5): pytest.approx(row[state]) for state in np.flatnonzero(row)}


def test_moves_slip_to_either_side_and_stop_at_walls() -> None:
    mdp = gridworld(slip=0.2)
    assert led_to(mdp, (3, 2), "left") == {(3, 1): 0.8, (2, 2): 0.1, (4, 2): 0.1}
    assert led_to(mdp, (3, 2), "down") == {(4, 2): 0.8, (3, 1): 0.1, (3, 3): 0.1}
    assert led_to(mdp, (4, 0), "down") == {(4, 0): 0.9, (4, 1): 0.1}
    assert led_to(mdp, (0, 0), "left") == {(0, 0): 0.9, (1, 0): 0.1}
    assert led_to(gridworld(slip=0.0), (1, 1), "up") == {(0, 1): 1.0}


def test_goal_and_trap_pay_on_entry_and_end_the_episode() -> None:
    mdp = gridworld()
    assert np.argwhere(mdp.terminal.reshape(5, 5)).tolist() == [[0, 4], [2, 2]]
    np.testing.assert_array_equal(np.unique(mdp.rewards), [-1.0, 0.0, 1.0])
    assert (mdp.rewards[:, :, 4] == 1.0).all()
    assert (mdp.rewards[:, :, 12] == -1.0).all()
    assert not mdp.transitions[mdp.terminal].any()
    assert mdp.start.argmax() == 20


def test_start_may_be_any_distribution() -> None:
    start = np.zeros((5, 5))
    start[1, 1], start[3, 4] = 0.25, 0.75
    np.testing.assert_array_equal(gridworld(start=start).start.reshape(5, 5), start)
    # Two numbers for each of two rows are probabilities and not a cell
    np.testing.assert_array_equal(gridworld(2, (0, 1), (1, 1), [[0.5, 0.0], [0.5, 0.0]]).start, [0.5, 0.0, 0.5, 0.0])


def test_a_start_in_the_corner_of_a_small_grid_is_a_cell() -> None:
    assert gridworld(2, (0, 1), (1, 1), (1, 0)).start.tolist() == [0.0, 0.0, 1.0, 0.0]


@given(st.integers(2, 6), st.floats(0.0, 1.0), st.integers(0, 10**6))
def test_every_grid_is_an_mdp(size: int, slip: float, seed: int) -> None:
    goal, trap, start = (divmod(int(cell), size) for cell in np.random.default_rng(seed).permutation(size**2)[:3])
    mdp = gridworld(size, goal, trap, start, slip)
    np.testing.assert_allclose(mdp.transitions.sum(axis=2), np.where(mdp.terminal, 0.0, 1.0)[:, None] * np.ones(4))


@pytest.mark.parametrize("gamma", [0.0, 0.9, 1.0])
def test_optimal_values_are_those_of_their_greedy_policy_and_no_policy_has_better(gamma: float) -> None:
    mdp = gridworld()
    best = optimal_values(mdp, gamma)
    worth = np.einsum("sat,sat->sa", mdp.transitions, mdp.rewards + gamma * best)
    np.testing.assert_allclose(best, worth.max(axis=1), atol=1e-9)
    for seed in range(5):
        policy = TabularPolicy(mdp, np.random.default_rng(seed).normal(size=(25, 4)))
        assert (policy.values(gamma) <= best + 1e-9).all()
    if 0.0 < gamma < 1.0:
        greedy = TabularPolicy(mdp, np.where(worth > worth.max(axis=1, keepdims=True) - 1e-12, 100.0, 0.0))
        np.testing.assert_allclose(greedy.values(gamma), best, atol=1e-9)


def test_rewards_for_ever_have_no_optimal_values_without_a_discount() -> None:
    mdp = TabularMDP(np.ones((1, 1, 1)), np.ones((1, 1, 1)), np.ones(1), np.zeros(1, dtype=bool))
    np.testing.assert_allclose(optimal_values(mdp, 0.9), 10.0)
    with pytest.raises(ValueError, match=r"`gamma` = 1\.0"):
        optimal_values(mdp, 1.0)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (dict(size=1), "`size` must be a whole number of at least 2"),
        (dict(slip=1.5), r"`slip` must be a number in \[0, 1\]"),
        (dict(goal=(5, 0)), "`goal` must be a row and a column, each from 0 to 4"),
        (dict(goal=(2, 2)), "`goal` and `trap` must be different cells"),
        (dict(start=(2, 2)), "`start` must give terminal states no probability"),
        (dict(start=(9, 9)), "`start` must be a row and a column"),
        (dict(start=np.ones((5, 5))), "`start` must hold probabilities"),
        (dict(start=[0.5, 0.5]), r"`start` must be a cell or have the shape \(5, 5\)"),
    ],
)
def test_refuses_what_is_no_grid(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        gridworld(**arguments)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (dict(transitions=np.ones((2, 3))), r"`transitions` must have the shape \(S, A, S\), got \(2, 3\)"),
        (dict(transitions=np.ones((25, 4, 25))), "`transitions` must hold probabilities"),
        (dict(rewards=np.ones(25)), r"`rewards` must have the shape \(25, 4, 25\), got \(25,\)"),
        (dict(rewards=np.full((25, 4, 25), np.nan)), "`rewards` must be finite"),
        (dict(terminal=np.zeros(25, dtype=bool)), "`transitions` must hold probabilities"),
    ],
)
def test_refuses_what_is_no_mdp(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        TabularMDP(**vars(gridworld()) | change)
