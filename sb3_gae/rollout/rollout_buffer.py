"""Rollout buffers that keep what a sweep over gamma and lambda needs."""

from collections.abc import Generator, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import DictRolloutBuffer, RolloutBuffer
from stable_baselines3.common.type_aliases import DictRolloutBufferSamples, RolloutBufferSamples
from stable_baselines3.common.vec_env import VecNormalize

from sb3_gae.checks import check_unit_interval
from sb3_gae.estimators.advantages import (
    advantage_grid,
    effective_horizon,
    generalized_advantages,
    next_state_values,
    td_residuals,
)
from sb3_gae.estimators.measures import explained_variance


class LambdaSweep(NamedTuple):
    r"""
    One rollout seen with each :math:`\lambda` of a grid, at one :math:`\gamma`; each array has shape (L,).

    :param gae_lambda: the grid
    :param mean_bias: mean over the batch of the advantages' difference from those with :math:`\lambda = 1`,
        which are unbiased for any value function
    :param rms_difference: root of the mean square of that difference: bias and shed noise together
    :param variance: variance of the advantages over the batch
    :param effective_horizon: :math:`1 / (1 - \gamma\lambda)`, in steps
    :param explained_variance: of the :math:`\lambda`-returns by the values
    """

    gae_lambda: np.ndarray
    mean_bias: np.ndarray
    rms_difference: np.ndarray
    variance: np.ndarray
    effective_horizon: np.ndarray
    explained_variance: np.ndarray


class GAERolloutBuffer(RolloutBuffer):
    r"""
    SB3's rollout buffer with the rewards as the environment gave them, and the endings of episodes told apart.

    SB3 adds :math:`\gamma V` of the terminal observation to the reward at a time limit, which ties the stored rewards
    to one :math:`\gamma`. Here ``rewards``, ``terminated``, ``truncated`` and ``bootstrap_values`` stay apart.
    All arrays have shape (T, N) (``observations`` and ``actions`` with further axes), also after :meth:`get`.

    In batches of whole episodes an environment that has contributed all of its own is stepped on until the others have,
    and ``mask``, shape (T, N), says which steps belong to the batch: only those come out of :meth:`get`, :meth:`batch`
    and :meth:`lambda_sweep`. What the arrays hold elsewhere means nothing.

    When one of SB3's own algorithms fills the buffer, it has already mixed those values into the rewards;
    its endings then all count as terminations, which is what SB3 makes of them.

    :param buffer_size: steps of each environment, T
    :param observation_space: of the environment
    :param action_space: of the environment
    :param device: where :meth:`get` and :meth:`batch` put their tensors
    :param gae_lambda: weight of longer estimates in ``advantages``
    :param gamma: discount factor
    :param n_envs: number of environments, N
    :param value_lambda: weight of longer estimates in ``returns``, the targets of the value function; 1 gives
        the Monte-Carlo returns of the paper. None means the same as ``gae_lambda``
    """

    terminated: np.ndarray
    truncated: np.ndarray
    bootstrap_values: np.ndarray
    last_values: np.ndarray
    mask: np.ndarray

    def __init__(self, *args: Any, value_lambda: float | None = None, **kwargs: Any):
        self.value_lambda = value_lambda
        super().__init__(*args, **kwargs)

    def reset(self) -> None:
        super().reset()
        shape = (self.buffer_size, self.n_envs)
        self.terminated = np.zeros(shape, dtype=bool)
        self.truncated = np.zeros(shape, dtype=bool)
        self.bootstrap_values = np.zeros(shape, dtype=np.float32)
        self.last_values = np.zeros(self.n_envs, dtype=np.float32)
        self.mask = np.ones(shape, dtype=bool)
        self._endings_known = False

    @property
    def n_samples(self) -> int:
        """Steps that belong to the batch."""
        return int(np.count_nonzero(self.mask))

    @property
    def dones(self) -> np.ndarray:
        """Whether each step was the last of its episode, shape (T, N)."""
        return self.terminated | self.truncated

    @property
    def next_values(self) -> np.ndarray:
        """
        Value of the state that each step led to, see :func:`~sb3_gae.estimators.advantages.next_state_values`.

        Shape (T, N).
        """
        return next_state_values(self.values, self.last_values, self.terminated, self.truncated, self.bootstrap_values)

    def add_step(
        self,
        obs: np.ndarray | dict[str, np.ndarray],
        action: np.ndarray,
        reward: np.ndarray,
        episode_start: np.ndarray,
        done: np.ndarray,
        truncated: np.ndarray,
        counts: np.ndarray | None = None,
    ) -> None:
        """
        Store one step of all environments; values and log-probabilities follow for all steps at once.

        :param obs: what the action was chosen on, shape (N, ...)
        :param action: shape (N, n_actions)
        :param reward: as the environment gave it, shape (N,)
        :param episode_start: whether the step was the first of its episode, shape (N,)
        :param done: whether it was the last of its episode, shape (N,)
        :param truncated: whether it was so because of a time limit, shape (N,)
        :param counts: whether it belongs to the batch, shape (N,); None if all do
        """
        if counts is not None:
            self.mask[self.pos] = counts
        self._store_observations(obs)
        if isinstance(self.action_space, spaces.Box):
            self.actions = _able_to_hold(action, self.actions)
        self.actions[self.pos] = action.reshape(self.n_envs, self.action_dim)
        self.rewards[self.pos] = reward
        self.episode_starts[self.pos] = episode_start
        self.terminated[self.pos] = done & ~truncated
        self.truncated[self.pos] = truncated
        self._endings_known = True
        self.pos += 1
        self.full = self.pos == self.buffer_size

    def _store_observations(self, obs: Any) -> None:
        self.observations = _able_to_hold(obs, self.observations)
        self.observations[self.pos] = obs.reshape(self.n_envs, *self.obs_shape)

    def finish(self) -> None:
        """Call the buffer full: what has been stored is the whole batch."""
        self.mask[self.pos :] = False
        self.full = True

    def set_values(self, values: np.ndarray, log_probs: np.ndarray, bootstrap_values: np.ndarray) -> None:
        """
        :param values: of the stored observations, shape (T, N)
        :param log_probs: of the stored actions, shape (T, N)
        :param bootstrap_values: of the terminal observations, read only where ``truncated``, shape (T, N)
        """
        self.values, self.log_probs, self.bootstrap_values = values, log_probs, bootstrap_values

    def compute_returns_and_advantage(self, last_values: th.Tensor, dones: np.ndarray) -> None:
        """
        Fill ``advantages`` and ``returns``.

        :param last_values: value of the state after the last step, shape (N,)
        :param dones: whether the last step ended an episode, shape (N,)
        """
        self.last_values = last_values.detach().cpu().numpy().flatten().astype(np.float32)
        if not self._endings_known:
            self.terminated = np.concatenate([self.episode_starts[1:], np.asarray(dones)[None]]).astype(bool)
        next_values = self.next_values
        self.advantages = self._advantages(self.gae_lambda, next_values)
        same = self.value_lambda is None or self.value_lambda == self.gae_lambda
        targets = self.advantages if same else self._advantages(self.value_lambda, next_values)  # type: ignore[arg-type]
        self.returns = targets + self.values

    def _advantages(self, gae_lambda: float, next_values: np.ndarray) -> np.ndarray:
        deltas = td_residuals(self.rewards, self.values, next_values, self.gamma)
        return generalized_advantages(deltas, self.dones, self.gamma, gae_lambda)

    def advantage_grid(self, gammas: Sequence[float], lambdas: Sequence[float]) -> np.ndarray:
        r"""
        Advantages of the stored rollout for every pair of :math:`\gamma` and :math:`\lambda`, the values held fixed.

        :param gammas: discount factors, each in [0, 1], shape (G,)
        :param lambdas: weights of longer estimates, each in [0, 1], shape (L,)
        :return: shape (G, L, T, N); meaningless outside ``mask``
        :raises ValueError: if the buffer is not full, or a factor is out of range
        """
        self._check_full()
        check_unit_interval("gammas", gammas)
        check_unit_interval("lambdas", lambdas)
        return advantage_grid(self.rewards, self.values, self.next_values, self.dones, gammas, lambdas)

    def lambda_sweep(self, lambdas: Sequence[float], gamma: float | None = None) -> LambdaSweep:
        r"""
        What each :math:`\lambda` trades: bias against :math:`\lambda = 1`, variance, horizon, explained variance.

        :param lambdas: weights of longer estimates, each in [0, 1], shape (L,)
        :param gamma: discount factor, None for the buffer's own
        :return: a summary for each
        :raises ValueError: if the buffer is not full, or a factor is out of range
        """
        gamma = self.gamma if gamma is None else gamma
        grid = self.advantage_grid([gamma], [*lambdas, 1.0])[0][:, self.mask].astype(np.float64)
        advantages, unbiased = grid[:-1], grid[-1]
        values = self.values[self.mask].astype(np.float64)
        return LambdaSweep(
            gae_lambda=np.asarray(lambdas, dtype=np.float64),
            mean_bias=(advantages - unbiased).mean(axis=1),
            rms_difference=np.sqrt(np.square(advantages - unbiased).mean(axis=1)),
            variance=advantages.var(axis=1),
            effective_horizon=effective_horizon(gamma, lambdas),
            explained_variance=np.array([explained_variance(values, row + values) for row in advantages]),
        )

    def get(self, batch_size: int | None = None) -> Generator[Any, None, None]:
        """
        Random minibatches; unlike SB3's own, this leaves the arrays as they are.

        :param batch_size: None for everything at once
        :return: samples in a random order
        :raises ValueError: if the buffer is not full
        """
        self._check_full()
        indices = np.flatnonzero(self.mask)[np.random.permutation(self.n_samples)]
        for start in range(0, len(indices), batch_size or len(indices)):
            yield self._get_samples(indices[start : start + (batch_size or len(indices))])

    def batch(self) -> RolloutBufferSamples:
        """
        Everything in the order of storage, time first; on the CPU without a copy unless steps are masked.

        :return: tensors of ``n_samples`` samples, T times N unless steps are masked
        :raises ValueError: if the buffer is not full
        """
        self._check_full()
        return self._get_samples(slice(None) if self.mask.all() else np.flatnonzero(self.mask))

    def _get_samples(self, batch_inds: np.ndarray | slice, env: VecNormalize | None = None) -> Any:
        return RolloutBufferSamples(self._samples_of(self.observations, batch_inds), *self._scalars_of(batch_inds))

    def _scalars_of(self, batch_inds: np.ndarray | slice) -> list[th.Tensor]:
        # Cast as SB3 does: log-probabilities of MultiBinary actions want floats
        actions = self.actions.astype(np.float32, copy=False)
        arrays = [actions, self.values, self.log_probs, self.advantages, self.returns]
        return [self._samples_of(array, batch_inds) for array in arrays]

    def _samples_of(self, array: np.ndarray, batch_inds: np.ndarray | slice) -> th.Tensor:
        return self.to_torch(array.reshape(-1, *array.shape[2:])[batch_inds], copy=False)

    def _check_full(self) -> None:
        if not self.full:
            raise ValueError(f"The buffer holds {self.pos} of {self.buffer_size} steps; collect a whole rollout first.")


class GAEDictRolloutBuffer(GAERolloutBuffer, DictRolloutBuffer):
    """The same for Dict observations: ``observations`` is a dictionary of arrays of shape (T, N, ...)."""

    observations: dict[str, np.ndarray]

    def _store_observations(self, obs: Any) -> None:
        for key, array in self.observations.items():
            self.observations[key] = array = _able_to_hold(obs[key], array)
            array[self.pos] = obs[key].reshape(array.shape[1:])

    def _get_samples(self, batch_inds: np.ndarray | slice, env: VecNormalize | None = None) -> Any:
        observations = {key: self._samples_of(array, batch_inds) for key, array in self.observations.items()}
        return DictRolloutBufferSamples(observations, *self._scalars_of(batch_inds))


def _able_to_hold(values: np.ndarray, array: np.ndarray) -> np.ndarray:
    """
    The array itself, or a copy as wide as the values where these are floats and it would cut them to whole numbers.

    SB3 gives an array the type of its space. But ``VecNormalize`` makes floats of vectors of integers and leaves their space
    as it is, and a Gaussian policy draws floats for a space of integers.
    """
    return array.astype(values.dtype) if array.dtype.kind in "iu" and values.dtype.kind == "f" else array
