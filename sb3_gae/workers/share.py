"""A worker's share of a batch: what it is asked for, what comes back, and the batch that the shares make."""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.vec_env import VecEnv

from sb3_gae.rollout.collection import (
    Observations,
    RolloutPlan,
    Step,
    environment_actions,
    reported_episodes,
    take_steps,
)
from sb3_gae.rollout.episode_quota import EpisodeQuota
from sb3_gae.workers.moments import Moments

#: of each key of a Dict observation, or of the observation itself under None
ObservationMoments = dict[str | None, Moments]


class Ending(NamedTuple):
    """
    :param step: of the share, the last of an episode, be it only for the environment's monitor
    :param env: number of the environment in the share
    :param info: of that step
    """

    step: int
    env: int
    info: dict[str, Any]


class Share(NamedTuple):
    """
    T steps of the n environments of one worker.

    :param observations: as the policy saw them, shape (T, n, ...), or a dictionary of such
    :param last_observations: after the last step, shape (n, ...), or a dictionary of such
    :param episode_starts: whether each step was the first of its episode, shape (T, n)
    :param actions: as the distribution gave them, in the shape of the action space, (T, n, ...)
    :param rewards: as the environments gave them, shape (T, n)
    :param dones: whether each step was the last of its episode, shape (T, n)
    :param endings: infos of the last steps of episodes; others stay where they are
    :param moments: of the observations as the environments gave them; empty if nobody keeps statistics of them
    :param seconds: that the worker took
    """

    observations: Observations
    last_observations: Observations
    episode_starts: np.ndarray
    actions: np.ndarray
    rewards: np.ndarray
    dones: np.ndarray
    endings: list[Ending]
    moments: ObservationMoments
    seconds: float

    @property
    def n_bytes(self) -> int:
        """Size of the arrays, in bytes."""
        arrays = [self.episode_starts, self.actions, self.rewards, self.dones]
        for observations in (self.observations, self.last_observations):
            arrays.extend(observations.values() if isinstance(observations, dict) else [observations])
        return sum(array.nbytes for array in arrays)


def collect_share(
    policy: ActorCriticPolicy,
    env: VecEnv,
    observations: Observations,
    episode_starts: np.ndarray,
    plan: RolloutPlan,
    first_env: int = 0,
) -> Share:
    """
    Take the steps of a share, with the policy's own random numbers.

    :param policy: in evaluation mode
    :param env: the environments of one worker
    :param observations: of the environments as they stand, shape (n, ...), or a dictionary of such
    :param episode_starts: whether they stand at the beginning of an episode, shape (n,)
    :param plan: how many steps to take
    :param first_env: number of the first environment in the whole batch, for messages
    :return: the share, without moments and time
    :raises NumericalError: if an observation, action or reward is not finite
    """
    quota = EpisodeQuota(env.num_envs, plan.n_episodes)
    steps: list[Step] = []
    endings: list[Ending] = []
    for step in take_steps(policy, env, observations, episode_starts, plan, quota, first_env):
        reported = reported_episodes(step.dones, step.infos).tolist()
        endings.extend(Ending(len(steps), env_, step.infos[env_]) for env_ in reported)
        quota.add(step.dones)
        # The infos of other steps may be many; they are not kept
        steps.append(step._replace(infos=[]))
    return Share(
        observations=_stacked([step.observations for step in steps]),
        last_observations=steps[-1].new_observations,
        episode_starts=np.stack([step.episode_starts for step in steps]),
        actions=np.stack([step.actions for step in steps]),
        rewards=np.stack([step.rewards for step in steps]),
        dones=np.stack([step.dones for step in steps]),
        endings=endings,
        moments={},
        seconds=0.0,
    )


def batch_steps(policy: ActorCriticPolicy, shares: Sequence[Share], rewards: Sequence[np.ndarray]) -> Iterator[Step]:
    """
    The steps of all workers as if one had taken them, in the order of the environments.

    :param policy: owner of the action space
    :param shares: of the workers. One that met its quota of episodes before others did goes on with empty steps
    :param rewards: of each share as the policy is to learn from them, shape (T, n)
    :return: the steps
    """
    n_steps = max(len(share.dones) for share in shares)
    sizes = [share.dones.shape[1] for share in shares]
    first_envs = np.cumsum([0, *sizes[:-1]]).tolist()
    observations = _side_by_side([share.observations for share in shares], n_steps)
    last = joined([share.last_observations for share in shares])
    starts, actions, all_rewards, dones = (
        _padded_side_by_side(arrays, n_steps)
        for arrays in (
            [share.episode_starts for share in shares],
            [share.actions for share in shares],
            rewards,
            [share.dones for share in shares],
        )
    )
    clipped_actions = environment_actions(policy, actions)
    infos = {
        (ending.step, first + ending.env): ending.info
        for first, share in zip(first_envs, shares, strict=True)
        for ending in share.endings
    }
    for t in range(n_steps):
        yield Step(
            observations=_at(observations, t),
            episode_starts=starts[t],
            actions=actions[t],
            clipped_actions=clipped_actions[t],
            new_observations=_at(observations, t + 1) if t + 1 < n_steps else last,
            rewards=all_rewards[t],
            dones=dones[t],
            infos=[infos.get((t, env), {}) for env in range(sum(sizes))],
            n_taken=sum(size for size, share in zip(sizes, shares, strict=True) if t < len(share.dones)),
        )


def _stacked(observations: list[Observations]) -> Observations:
    if isinstance(first := observations[0], dict):
        return {key: np.stack([part[key] for part in observations]) for key in first}
    return np.stack(observations)  # type: ignore[arg-type]


def joined(observations: Sequence[Observations]) -> Observations:
    """
    :param observations: of each worker, shape (n, ...), or a dictionary of such
    :return: of all, in their order
    """
    if isinstance(first := observations[0], dict):
        return {key: np.concatenate([part[key] for part in observations]) for key in first}
    return np.concatenate(observations)  # type: ignore[arg-type]


def _side_by_side(observations: list[Observations], n_steps: int) -> Observations:
    if isinstance(first := observations[0], dict):
        return {key: _padded_side_by_side([part[key] for part in observations], n_steps) for key in first}
    return _padded_side_by_side(observations, n_steps)  # type: ignore[arg-type]


def _padded_side_by_side(arrays: Sequence[np.ndarray], n_steps: int) -> np.ndarray:
    return np.concatenate([_padded(array, n_steps) for array in arrays], axis=1)


def _padded(array: np.ndarray, n_steps: int) -> np.ndarray:
    missing = n_steps - len(array)
    return np.concatenate([array, np.zeros((missing, *array.shape[1:]), array.dtype)]) if missing else array


def _at(observations: Observations, step: int) -> Observations:
    return {key: part[step] for key, part in observations.items()} if isinstance(observations, dict) else observations[step]
