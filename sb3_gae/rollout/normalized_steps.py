"""Steps through SB3's ``VecNormalize`` in a fraction of its time: of a few environments it is as dear as the policy."""

import numpy as np
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import VecEnv, VecNormalize
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn

_FLOATS = (np.float32, np.float64)
#: methods that are done here in place of calling them
_DONE_HERE = {"step", "step_async", "step_wait", "_update_reward", "normalize_obs", "_normalize_obs"}


def step_environments(env: VecEnv, actions: np.ndarray) -> VecEnvStepReturn:
    """
    The same as ``env.step(actions)``, to the last bit of the statistics that ``VecNormalize`` keeps.

    :param env: environments in their wrappers; what is not an outermost ``VecNormalize`` of arrays is stepped as it is
    :param actions: of the environments, shape (N, ...)
    :return: observations, rewards, ends of episodes and infos
    """
    if not (type(env) is VecNormalize and _is_unpatched(env) and env.norm_obs and type(env.obs_rms) is RunningMeanStd):
        return env.step(actions)
    observations, rewards, dones, infos = env.venv.step(actions)
    assert isinstance(observations, np.ndarray)
    env.old_obs, env.old_reward = observations, rewards
    if env.training:
        _update(env.obs_rms, observations)
        env.returns = env.returns * env.gamma + rewards
        _update(env.ret_rms, env.returns)
    if dones.any():
        for index in np.flatnonzero(dones).tolist():
            if "terminal_observation" in infos[index]:
                infos[index]["terminal_observation"] = env.normalize_obs(infos[index]["terminal_observation"])
        env.returns[dones] = 0
    return _normalized(env, env.obs_rms, observations), env.normalize_reward(rewards), dones, infos


def _is_unpatched(env: VecNormalize) -> bool:
    """Whether nobody has put a function in the place of a method of this one object."""
    return _DONE_HERE.isdisjoint(vars(env))


def _update(statistics: RunningMeanStd, rows: np.ndarray) -> None:
    """``RunningMeanStd.update``, whose time goes into the Python of ``np.mean`` and ``np.var``."""
    if rows.dtype not in _FLOATS:
        statistics.update(rows)
        return
    n_rows = len(rows)
    mean = np.add.reduce(rows, axis=0) / n_rows
    squares = rows - mean
    squares *= squares
    statistics.update_from_moments(mean, np.add.reduce(squares, axis=0) / n_rows, n_rows)


def _normalized(env: VecNormalize, statistics: RunningMeanStd, observations: np.ndarray) -> np.ndarray:
    scaled = observations - statistics.mean
    scaled /= np.sqrt(statistics.var + env.epsilon)
    scaled.clip(-env.clip_obs, env.clip_obs, out=scaled)
    return scaled.astype(np.float32)
