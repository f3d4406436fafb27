r"""
Finite Markov decision processes that end, and the gridworld among them.

Shapes: ``S`` is the number of states, ``A`` the number of actions.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from sb3_gae.checks import check_count, check_number

#: moves of the gridworld, in the order of its actions, as steps of (row, column)
MOVES = ((-1, 0), (0, 1), (1, 0), (0, -1))
MOVE_NAMES = ("up", "right", "down", "left")

# Of value iteration; enough for a discount of 0.9997
_MOST_ITERATIONS = 100_000

Cell = tuple[int, int]


@dataclass(frozen=True)
class TabularMDP:
    r"""
    States, actions, probabilities, rewards. An episode ends when a terminal state is entered, and is never cut.

    :param transitions: :math:`P(s'|s,a)`, shape (S, A, S); zero for terminal states, which nothing follows
    :param rewards: :math:`R(s,a,s')`, shape (S, A, S)
    :param start: probability of starting in each state, shape (S,); none of it in terminal states
    :param terminal: whether an episode ends there, shape (S,)
    :raises ValueError: if shapes do not fit, or probabilities are not such
    """

    transitions: np.ndarray
    rewards: np.ndarray
    start: np.ndarray
    terminal: np.ndarray

    def __post_init__(self) -> None:
        shape = np.shape(self.transitions)
        if len(shape) != 3 or shape[0] != shape[2] or 0 in shape:
            raise ValueError(f"`transitions` must have the shape (S, A, S), got {shape}.")
        for name, right in {"rewards": shape, "start": shape[:1], "terminal": shape[:1]}.items():
            if np.shape(getattr(self, name)) != right:
                raise ValueError(f"`{name}` must have the shape {right}, got {np.shape(getattr(self, name))}.")
        if not np.isfinite(self.rewards).all():
            raise ValueError("`rewards` must be finite.")
        _check_probabilities("transitions", self.transitions, np.where(self.terminal, 0.0, 1.0)[:, None])
        _check_probabilities("start", self.start, np.ones(()))
        if self.start[self.terminal].any():
            raise ValueError("`start` must give terminal states no probability.")

    @property
    def n_states(self) -> int:
        """S, terminal states among them."""
        return self.transitions.shape[0]

    @property
    def n_actions(self) -> int:
        """A."""
        return self.transitions.shape[1]


def gridworld(
    size: int = 5,
    goal: Cell = (0, 4),
    trap: Cell = (2, 2),
    start: Cell | ArrayLike = (4, 0),
    slip: float = 0.1,
) -> TabularMDP:
    """
    A square of cells with a goal worth +1 and a trap worth -1, where episodes end.

    State ``row * size + column`` is a cell, row 0 on top; the actions are ``MOVES``. A move against a wall stays
    in place. With the default ``slip`` what follows an action is noisy, so that even the exact value function
    leaves temporal-difference residuals some variance, while the intended move still decides.

    :param size: rows, and columns
    :param goal: row and column
    :param trap: row and column
    :param start: row and column, or a probability for each cell, shape (size, size)
    :param slip: probability of moving at a right angle to the intended direction, half of it to either side
    :return: S = ``size**2`` states, A = 4 actions
    :raises ValueError: if a cell lies outside, goal, trap and start are not different, or a probability is none
    """
    check_count("size", size, low=2)
    check_number("slip", slip, 0.0, 1.0)
    ends = {_state(name, cell, size): reward for name, cell, reward in (("goal", goal, 1.0), ("trap", trap, -1.0))}
    if len(ends) < 2:
        raise ValueError(f"`goal` and `trap` must be different cells, got {goal} twice.")
    terminal = np.isin(np.arange(size**2), list(ends))
    moved = np.stack([_moves_one_way(move, size) for move in MOVES], axis=1)
    # The neighbours of a move in the circle of directions are those at a right angle to it
    transitions = (1.0 - slip) * moved + 0.5 * slip * (np.roll(moved, 1, axis=1) + np.roll(moved, -1, axis=1))
    transitions[terminal] = 0.0
    rewards = np.zeros_like(transitions)
    for state, reward in ends.items():
        rewards[:, :, state] = reward
    return TabularMDP(transitions, rewards, _start_probabilities(start, size), terminal)


def optimal_values(mdp: TabularMDP, gamma: float, tolerance: float = 1e-12) -> np.ndarray:
    r"""
    Values of the best policy, :math:`\max_\pi V^{\pi,\gamma}`, by value iteration from zero.

    :param mdp: with ``gamma`` = 1, one in which no policy earns rewards for ever
    :param gamma: discount factor in [0, 1]
    :param tolerance: iteration ends when no value changes by more
    :return: shape (S,)
    :raises ValueError: if ``gamma`` is out of range, or so large that the values do not settle
    """
    check_number("gamma", gamma, 0.0, 1.0)
    rewards = np.einsum("sat,sat->sa", mdp.transitions, mdp.rewards)
    values = np.zeros(mdp.n_states)
    for _ in range(_MOST_ITERATIONS):
        better = (rewards + gamma * mdp.transitions @ values).max(axis=1)
        change, values = float(np.abs(better - values).max()), better
        if change <= tolerance:
            return values
    raise ValueError(f"With `gamma` = {gamma} the values did not settle; where rewards go on for ever it must be smaller.")


def _moves_one_way(move: Cell, size: int) -> np.ndarray:
    """Where the same move leads from every cell: a matrix of zeros and ones, shape (S, S)."""
    rows, columns = np.divmod(np.arange(size**2), size)
    led_to = np.clip(rows + move[0], 0, size - 1) * size + np.clip(columns + move[1], 0, size - 1)
    return np.eye(size**2)[led_to]


def _start_probabilities(start: Cell | ArrayLike, size: int) -> np.ndarray:
    if np.shape(start) == (2,) and np.asarray(start).dtype.kind == "i":
        return np.eye(size**2)[_state("start", start, size)]  # type: ignore[arg-type]
    if np.shape(start) != (size, size):
        raise ValueError(f"`start` must be a cell or have the shape {(size, size)}, got the shape {np.shape(start)}.")
    return np.asarray(start, dtype=np.float64).flatten()


def _state(name: str, cell: Sequence[int], size: int) -> int:
    if np.shape(cell) != (2,) or not all(0 <= index < size for index in cell):
        raise ValueError(f"`{name}` must be a row and a column, each from 0 to {size - 1}, got {cell!r}.")
    return int(cell[0]) * size + int(cell[1])


def _check_probabilities(name: str, array: np.ndarray, sums: np.ndarray) -> None:
    if not (np.asarray(array) >= 0.0).all() or not np.allclose(np.sum(array, axis=-1), sums, rtol=0.0, atol=1e-9):
        raise ValueError(f"`{name}` must hold probabilities: none below 0, the last axis summing to 1 (to 0 where terminal).")
