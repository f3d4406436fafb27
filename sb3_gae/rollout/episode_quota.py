"""Which environments still contribute to a batch of whole episodes."""

import numpy as np


class EpisodeQuota:
    """
    Each environment contributes the same number of whole episodes, so that short episodes do not crowd out long ones.

    :param n_envs: number of environments, N
    :param n_episodes: of each environment; None for no quota, when every step counts
    """

    def __init__(self, n_envs: int, n_episodes: int | None):
        self._missing = None if n_episodes is None else np.full(n_envs, n_episodes)

    @property
    def counts(self) -> np.ndarray | None:
        """Whether the next step of each environment belongs to the batch, shape (N,); None if all do."""
        return None if self._missing is None else self._missing > 0

    @property
    def is_met(self) -> bool:
        """Whether every environment has contributed all that it should."""
        return self._missing is not None and not self._missing.any()

    def add(self, dones: np.ndarray) -> None:
        """
        :param dones: whether each environment's episode ended, shape (N,)
        """
        if self._missing is not None:
            np.subtract(self._missing, 1, out=self._missing, where=dones & (self._missing > 0))
