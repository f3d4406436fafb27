"""
The wrappers around environments on workers: which there can be, how workers apply them, and what these then learn.

A wrapper stands in the process of the learner and sees no step of a share. So the workers put copies of it around their
own environments, with the statistics of the beginning of the batch, and send back what it is to learn.
"""

import functools
import pickle
from collections.abc import Mapping, Sequence
from typing import cast

import numpy as np
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, VecNormalize, VecTransposeImage
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

from sb3_gae.rollout.collection import Observations
from sb3_gae.workers.moments import Moments, RunningMoments
from sb3_gae.workers.share import ObservationMoments, Share

# Observations of each environment below which the statistics are those of the first moments of episodes, and would
# magnify what comes later beyond all bounds
_FEW = 10


#: of VecNormalize a pickled copy, of VecTransposeImage whether it leaves images as they are
SentWrapper = bytes | bool


def wrappers_around(env: VecEnv) -> list[VecEnvWrapper]:
    """
    :param env: environments on workers, in their wrappers
    :return: the wrappers, the innermost first
    :raises ValueError: if workers cannot do what one of them does
    """
    found: list[VecEnvWrapper] = []
    while isinstance(env, VecEnvWrapper):
        if not isinstance(env, VecNormalize | VecTransposeImage):
            raise ValueError(
                f"{type(env).__name__} around a RayVecEnv would not see the steps that workers take; have it in the function "
                "that makes their environments. VecNormalize and VecTransposeImage can stand outside."
            )
        found.append(env)
        env = env.venv
    found.reverse()
    if any(isinstance(wrapper, VecNormalize) for wrapper in found[1:]):
        raise ValueError("VecNormalize must stand directly around the RayVecEnv, and only one; put other wrappers around it.")
    return found


def normalizer_of(wrappers: Sequence[VecEnvWrapper]) -> VecNormalize | None:
    """
    :param wrappers: what :func:`wrappers_around` found
    :return: the one that normalizes, if there is one
    """
    return wrappers[0] if wrappers and isinstance(wrappers[0], VecNormalize) else None


def wrappers_to_send(wrappers: Sequence[VecEnvWrapper]) -> list[SentWrapper]:
    """
    :param wrappers: what :func:`wrappers_around` found
    :return: what :func:`wrap` makes copies of
    """
    return [_sent(wrapper) for wrapper in wrappers]


def _sent(wrapper: VecEnvWrapper) -> SentWrapper:
    if isinstance(wrapper, VecNormalize):
        return pickle.dumps(_at_rest(wrapper))
    return bool(cast(VecTransposeImage, wrapper).skip)


def wrap(env: VecEnv, sent: Sequence[SentWrapper]) -> VecEnv:
    """
    :param env: of one worker
    :param sent: what :func:`wrappers_to_send` returned
    :return: the environments in copies of the wrappers, which learn nothing
    """
    for content in sent:
        if isinstance(content, bool):
            env = VecTransposeImage(env, skip=content)
        else:
            normalize = pickle.loads(content)
            normalize.set_venv(env)
            env = normalize
    return env


def seen_through(env: VecEnv, observations: Observations) -> Observations:
    """
    :param env: what :func:`wrap` returned
    :param observations: as the environments give them
    :return: as the wrappers show them
    """
    if isinstance(env, VecNormalize):
        return env.normalize_obs(seen_through(env.venv, observations))
    if isinstance(env, VecTransposeImage):
        return env.transpose_observations(seen_through(env.venv, observations))
    return observations


class ObservationWatch(VecEnvWrapper):
    """
    Takes the moments of what the environments show after each step, and remembers the last of it.

    :param venv: the environments of one worker
    :param with_moments: whether anybody wants them
    """

    def __init__(self, venv: VecEnv, with_moments: bool):
        super().__init__(venv)
        self._with_moments = with_moments
        self._moments: dict[str | None, RunningMoments] = {}
        self.observations: Observations | None = None

    def reset(self) -> VecEnvObs:
        return self.venv.reset()

    def step_wait(self) -> VecEnvStepReturn:
        result = self.venv.step_wait()
        self.observations = cast(Observations, result[0])
        if self._with_moments:
            parts = self.observations if isinstance(self.observations, dict) else {None: self.observations}
            for key, part in parts.items():
                self._moments.setdefault(key, RunningMoments()).add(part)
        return result

    def total(self) -> ObservationMoments:
        """
        :return: the moments of all steps
        """
        return {key: moments.total() for key, moments in self._moments.items()}


def learn_from_shares(normalize: VecNormalize, shares: Sequence[Share]) -> None:
    """
    Add the steps of a batch to the statistics, each step of each worker once.

    :param normalize: around the environments
    :param shares: of the workers, in their order
    """
    if not normalize.training:
        return
    if normalize.norm_obs:
        statistics: Mapping[str | None, RunningMeanStd]
        statistics = normalize.obs_rms if isinstance(normalize.obs_rms, dict) else {None: normalize.obs_rms}
        for key, its_statistics in statistics.items():
            functools.reduce(Moments.merged, (share.moments[key] for share in shares)).add_to(its_statistics)
    returns = []
    first_env = 0
    for share in shares:
        envs = slice(first_env, first_env := first_env + share.dones.shape[1])
        start = normalize.returns[envs]
        returns.append(running_returns(share.rewards, share.episode_starts, start, normalize.gamma))
        normalize.returns[envs] = np.where(share.dones[-1], 0.0, returns[-1][-1])
    functools.reduce(Moments.merged, (Moments.of(part.reshape(-1)) for part in returns)).add_to(normalize.ret_rms)


def running_returns(rewards: np.ndarray, episode_starts: np.ndarray, start: np.ndarray, gamma: float) -> np.ndarray:
    r"""
    What ``VecNormalize`` scales rewards by: :math:`R_t = r_t + \gamma R_{t-1}`, begun anew with each episode.

    :param rewards: shape (T, n)
    :param episode_starts: whether each step was the first of its episode, shape (T, n)
    :param start: :math:`R` before the first step, shape (n,)
    :param gamma: discount factor
    :return: in float64, shape (T, n)
    """
    returns = np.empty(rewards.shape)
    for t, (reward, begins) in enumerate(zip(rewards, episode_starts, strict=True)):
        start = returns[t] = np.where(begins, 0.0, start) * gamma + reward
    return returns


def _at_rest(normalize: VecNormalize) -> VecNormalize:
    # Not by ``copy``, which takes away what pickling it then looks for
    resting = object.__new__(type(normalize))
    vars(resting).update(vars(normalize))
    # Rewards are needed as they are, for the statistics; the learner scales them
    resting.training, resting.norm_reward = False, False
    if normalize.norm_obs:
        if isinstance(normalize.obs_rms, dict):
            resting.obs_rms = {key: _worth_applying(part, normalize) for key, part in normalize.obs_rms.items()}
        else:
            resting.obs_rms = _worth_applying(normalize.obs_rms, normalize)
    return resting


def _worth_applying(statistics: RunningMeanStd, normalize: VecNormalize) -> RunningMeanStd:
    knows_enough = not normalize.training or statistics.count >= _FEW * normalize.num_envs
    return statistics if knows_enough else RunningMeanStd(shape=statistics.mean.shape)
