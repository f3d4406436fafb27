"""Which steps of a rollout belong together, so that statistics over independent groups can be formed (NumPy)."""

import numpy as np

from sb3_gae.checks import check_count


def trajectory_indices(dones: np.ndarray, mask: np.ndarray | None = None) -> np.ndarray:
    """
    Number the trajectories of a rollout, those of the first environment first. One that the rollout's end
    cuts, or that began before the rollout, counts as one as far as it goes.

    :param dones: whether the step was the last one of its episode, shape (T, N)
    :param mask: which steps belong to the batch, None for all, shape (T, N)
    :return: from 0 on, -1 outside ``mask``, shape (T, N)
    """
    belongs = np.ones_like(dones, dtype=bool) if mask is None else mask
    first = np.ones_like(belongs)
    first[1:] = dones[:-1] | ~belongs[:-1]
    indices = np.cumsum((first & belongs).T.ravel()).reshape(dones.T.shape).T - 1
    return np.where(belongs, indices, -1)


def trajectory_groups(dones: np.ndarray, n_groups: int = 16, mask: np.ndarray | None = None) -> np.ndarray:
    """
    Share the trajectories of a rollout among groups that are independent of each other.

    Whole environments go together where there are enough of them; else trajectories are dealt out in turn.
    How they are shared never depends on what happened in them.

    :param dones: whether the step was the last one of its episode, shape (T, N)
    :param n_groups: how many to form; fewer if there are fewer trajectories
    :param mask: which steps belong to the batch, None for all, shape (T, N)
    :return: group of each step from 0 on, -1 outside ``mask``, shape (T, N)
    :raises ValueError: if ``n_groups`` is below 2, or there is only one trajectory
    """
    check_count("n_groups", n_groups, low=2)
    trajectories = trajectory_indices(dones, mask)
    count = int(trajectories.max(initial=-1)) + 1
    if count < 2:
        raise ValueError(f"`dones` must divide the rollout into at least two trajectories, got {count}; collect more steps.")
    n_envs = dones.shape[1]
    if n_envs >= n_groups:
        return np.where(trajectories < 0, -1, np.arange(n_envs) % n_groups)
    return np.where(trajectories < 0, -1, trajectories % min(n_groups, count))
