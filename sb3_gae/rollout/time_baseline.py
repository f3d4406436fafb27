"""The baseline that knows nothing but the time: the paper's "No VF" (section 6.1)."""

import numpy as np

from sb3_gae.estimators.advantages import discounted_returns, next_state_values
from sb3_gae.rollout.rollout_buffer import GAERolloutBuffer


def timesteps(episode_starts: np.ndarray, elapsed: np.ndarray) -> np.ndarray:
    """
    :param episode_starts: whether each step was the first of its episode, shape (T, N)
    :param elapsed: steps that the episodes had taken before the first row, shape (N,)
    :return: steps since the start of the episode, shape (T, N)
    """
    steps = np.arange(len(episode_starts))[:, None]
    last_start = np.maximum.accumulate(np.where(episode_starts, steps, -1), axis=0)
    return np.where(last_start >= 0, steps - last_start, steps + elapsed)


class TimeBaseline:
    """
    The mean over a batch's episodes of the discounted return from each timestep on.

    An episode that the batch or a time limit cuts goes on, as far as this baseline knows, with the mean that the batch
    before had for the next timestep, and with nothing where that batch had no episode so long.
    """

    def __init__(self) -> None:
        self._elapsed = np.zeros(0, dtype=np.int64)
        self._means = np.zeros(0)

    def fill(self, rollout_buffer: GAERolloutBuffer, last_dones: np.ndarray, gamma: float) -> np.ndarray:
        """
        Take the place of the value function in a full buffer, and remember this batch for the next.

        :param rollout_buffer: full, its values and those of terminal observations are replaced
        :param last_dones: whether the last step of each environment ended its episode, shape (N,)
        :param gamma: discount factor
        :return: values of the states after the last step, shape (N,)
        """
        buffer = rollout_buffer
        if self._elapsed.shape != (buffer.n_envs,):
            # The first rollout, or the first in other environments than before
            self._elapsed = np.zeros(buffer.n_envs, dtype=np.int64)
        steps = timesteps(buffer.episode_starts, self._elapsed)
        after = steps + 1
        bootstrap_values = self._of(after)
        next_values = next_state_values(
            np.zeros_like(bootstrap_values), bootstrap_values[-1], buffer.terminated, buffer.truncated, bootstrap_values
        )
        returns = discounted_returns(buffer.rewards.astype(np.float64), next_values, buffer.dones, gamma)
        counts = np.bincount(steps[buffer.mask])
        self._means = np.bincount(steps[buffer.mask], returns[buffer.mask]) / np.maximum(counts, 1)
        self._elapsed = np.where(last_dones, 0, after[-1])
        values, bootstrap_values = (array.astype(np.float32) for array in (self._of(steps), bootstrap_values))
        buffer.set_values(values, buffer.log_probs, bootstrap_values)
        return bootstrap_values[-1]

    def _of(self, steps: np.ndarray) -> np.ndarray:
        """The mean at each timestep, 0 where no episode was so long."""
        means = np.append(self._means, 0.0)
        return means[np.minimum(steps, len(means) - 1)]
