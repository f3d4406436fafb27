"""The ``infos`` of a batch of environments, made only for those that somebody asks about."""

from collections.abc import Iterator, Sequence
from typing import Any, overload

import numpy as np


class StepInfos(Sequence[dict[str, Any]]):
    """
    Reads like SB3's list of dictionaries. What has been handed out is kept, so that a wrapper can add to it.

    :param n_envs: number of environments, N
    :param columns: numbers or truth values that every environment has, by name, each of shape (N,)
    """

    def __init__(self, n_envs: int, columns: dict[str, np.ndarray]):
        self.columns = columns
        self._n_envs = n_envs
        self._made: dict[int, dict[str, Any]] = {}

    def __len__(self) -> int:
        return self._n_envs

    @overload
    def __getitem__(self, index: int) -> dict[str, Any]: ...
    @overload
    def __getitem__(self, index: slice) -> list[dict[str, Any]]: ...
    def __getitem__(self, index: int | slice) -> dict[str, Any] | list[dict[str, Any]]:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(self._n_envs))]
        env = range(self._n_envs)[index]
        if env not in self._made:
            self._made[env] = {name: column[env].item() for name, column in self.columns.items()}
        return self._made[env]

    def __iter__(self) -> Iterator[dict[str, Any]]:
        return (self[env] for env in range(self._n_envs))

    def __setitem__(self, index: int, info: dict[str, Any]) -> None:
        self._made[range(self._n_envs)[index]] = info

    def copy(self) -> list[dict[str, Any]]:
        """All of them as a list."""
        return self[:]
