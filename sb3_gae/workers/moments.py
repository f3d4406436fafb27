"""Count, mean and variance of data that lies in several places, merged without an error beyond rounding."""

from typing import NamedTuple, Self

import numpy as np
from stable_baselines3.common.running_mean_std import RunningMeanStd

# Rows that are put together before their moments are taken: enough for the sums to be fast, little memory
_BLOCK = 4_096


class Moments(NamedTuple):
    """
    :param n_rows: number of rows
    :param mean: over the rows, in float64
    :param squares: sum over the rows of the squared differences from the mean, in float64
    """

    n_rows: int
    mean: np.ndarray
    squares: np.ndarray

    @classmethod
    def of(cls, rows: np.ndarray) -> Self:
        """
        :param rows: shape (B, ...), at least one
        :return: their moments
        """
        data = np.asarray(rows, dtype=np.float64)
        mean = data.mean(axis=0)
        return cls(len(data), mean, np.square(data - mean).sum(axis=0))

    def merged(self, other: "Moments") -> "Moments":
        """
        As if both had been one (Chan, Golub and LeVeque 1979).

        :param other: of other rows
        :return: moments of all
        """
        n_rows = self.n_rows + other.n_rows
        delta = other.mean - self.mean
        mean = self.mean + delta * (other.n_rows / n_rows)
        squares = self.squares + other.squares + np.square(delta) * (self.n_rows * other.n_rows / n_rows)
        return Moments(n_rows, mean, squares)

    def add_to(self, statistics: RunningMeanStd) -> None:
        """
        :param statistics: of ``VecNormalize``, which then know these rows as well
        """
        statistics.update_from_moments(self.mean, self.squares / self.n_rows, self.n_rows)


class RunningMoments:
    """Moments of rows that come a few at a time."""

    def __init__(self) -> None:
        self._waiting: list[np.ndarray] = []
        self._n_waiting = 0
        self._merged: Moments | None = None

    def add(self, rows: np.ndarray) -> None:
        """
        :param rows: shape (B, ...), not written to afterwards
        """
        self._waiting.append(rows)
        self._n_waiting += len(rows)
        if self._n_waiting >= _BLOCK:
            self._merge()

    def total(self) -> Moments:
        """
        :return: of all rows so far, at least one
        """
        if self._waiting:
            self._merge()
        assert self._merged is not None, "no rows"
        return self._merged

    def _merge(self) -> None:
        block = Moments.of(np.concatenate(self._waiting))
        self._merged = block if self._merged is None else self._merged.merged(block)
        self._waiting, self._n_waiting = [], 0
