r"""A recorded rollout seen with any :math:`\gamma` and :math:`\lambda`, fast enough to follow a dial."""

from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sb3_gae.checks import check_number
from sb3_gae.diagnostics.rollout_file import Rollout
from sb3_gae.estimators.advantages import advantage_grid, td_residuals
from sb3_gae.estimators.group_statistics import Estimate, gradient_errors, squared_norm
from sb3_gae.estimators.response import lagged_signal
from sb3_gae.estimators.trajectory_groups import trajectory_groups, trajectory_indices
from sb3_gae.presets import PAPER_LAMBDAS

#: the paper's biped after a short training, made by ``docs/record_biped.py``
SHIPPED_ROLLOUT = Path(__file__).parent / "biped.npz"
N_GROUPS = 16
N_LAGS = 40


class View(NamedTuple):
    r"""
    Bias and variance are in units of the variance at :math:`\lambda = 1`, which unlike the squared norm of the gradient is
    never lost in noise.

    :param deltas: residuals, shape (T, N)
    :param advantages: with the :math:`\lambda` asked for, shape (T, N)
    :param unbiased: with :math:`\lambda = 1`, shape (T, N)
    :param lambdas: of the curves, the one asked for last, shape (L,)
    :param bias_squared: of the batch's gradient for each of them
    :param variance: likewise
    """

    deltas: np.ndarray
    advantages: np.ndarray
    unbiased: np.ndarray
    lambdas: np.ndarray
    bias_squared: Estimate
    variance: Estimate


class RolloutViewer:
    """
    :param rollout: as loaded
    :raises ValueError: if it has a single trajectory, with which nothing can be compared
    """

    def __init__(self, rollout: Rollout):
        self.rollout = rollout
        self.groups = trajectory_groups(rollout.dones, N_GROUPS, rollout.mask)
        self.trajectories = trajectory_indices(rollout.dones, rollout.mask)
        self._kept: tuple[float, np.ndarray] | None = None

    @property
    def n_trajectories(self) -> int:
        """How many there are to choose from."""
        return int(self.trajectories.max()) + 1

    def steps(self, trajectory: int) -> tuple[np.ndarray, np.ndarray]:
        """
        :param trajectory: from 0 on
        :return: its steps in order, as indices into arrays of shape (T, N)
        """
        steps, environments = np.nonzero(self.trajectories == trajectory)
        return steps, environments

    def view(self, gamma: float, gae_lambda: float) -> View:
        r"""
        :param gamma: discount factor in [0, 1]
        :param gae_lambda: weight of longer estimates in [0, 1]
        :return: see :class:`View`
        :raises ValueError: if a factor is out of range
        """
        check_number("gamma", gamma, 0.0, 1.0)
        check_number("gae_lambda", gae_lambda, 0.0, 1.0)
        rollout = self.rollout
        lambdas = np.array([*PAPER_LAMBDAS, gae_lambda, 1.0])
        arrays = rollout.rewards, rollout.values, rollout.next_values
        advantages = advantage_grid(*arrays, rollout.dones, [gamma], lambdas)[0]
        errors = gradient_errors(self._gradient_sums(advantages), self._group_sizes)
        unit = float(errors.variance.value[-1]) or 1.0
        bias, variance = (
            Estimate(each.value[:-1] / unit, each.standard_error[:-1] / unit)
            for each in (errors.bias_squared, errors.variance)
        )
        return View(td_residuals(*arrays, gamma), advantages[-2], advantages[-1], lambdas[:-1], bias, variance)

    def response(self, gamma: float) -> tuple[np.ndarray, np.ndarray]:
        r"""
        What remains of the response function :math:`\chi(l)` where states do not recur: the squared norm of its product with
        the score, :math:`\|E[\nabla\log\pi(a_t|s_t)\,x_{t+l}]\|^2`, for each delay l.

        :param gamma: discount factor of the shaping, in [0, 1]
        :return: of the rewards and of the residuals, each of shape (``N_LAGS``,) or shorter, in units of the largest
        :raises ValueError: if ``gamma`` is out of range
        """
        check_number("gamma", gamma, 0.0, 1.0)
        shaped = self._shaped_response(gamma)
        return self._reward_response / self._reward_response.max(), shaped / max(float(shaped.max()), 1e-300)

    def _shaped_response(self, gamma: float) -> np.ndarray:
        # λ is turned more often than γ, and plays no part
        if self._kept is None or self._kept[0] != gamma:
            rollout = self.rollout
            deltas = td_residuals(rollout.rewards, rollout.values, rollout.next_values, gamma)
            self._kept = gamma, self._lagged_norms(deltas)
        return self._kept[1]

    @cached_property
    def _group_sizes(self) -> np.ndarray:
        return np.bincount(self.groups[self.rollout.mask])

    @cached_property
    def _reward_response(self) -> np.ndarray:
        return np.maximum(self._lagged_norms(self.rollout.rewards), 0.0) + 1e-300

    def _lagged_norms(self, signal: np.ndarray) -> np.ndarray:
        lagged, known = lagged_signal(signal, self.rollout.dones, N_LAGS, self.rollout.mask)
        groups, mask = self.groups[self.rollout.mask], self.rollout.mask
        steps = np.stack([np.bincount(groups[row], minlength=len(self._group_sizes)) for row in known[:, mask]], axis=1)
        followed = int(steps.all(axis=0).cumprod().sum())
        return squared_norm(self._gradient_sums(lagged[:followed]), steps[:, :followed]).value

    def _gradient_sums(self, signals: np.ndarray) -> np.ndarray:
        """Projected gradients summed over each group, shape (G, K, n), for signals of shape (K, T, N)."""
        groups, flat = self.groups[self.rollout.mask], signals[:, self.rollout.mask]
        members = (np.flatnonzero(groups == group) for group in range(len(self._group_sizes)))
        return np.stack([flat[:, rows] @ self.rollout.scores[rows] for rows in members])
