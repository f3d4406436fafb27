"""What SB3's ``Monitor`` does at the beginning and the end of an episode, for environments that it does not step itself."""

import time
from typing import Any

from stable_baselines3.common.monitor import Monitor


def begin_episode(monitor: Monitor) -> None:
    """
    :param monitor: of the environment
    :raises RuntimeError: if the last episode is not over, and the monitor does not allow that
    """
    if not monitor.allow_early_resets and not monitor.needs_reset:
        raise RuntimeError(
            "Tried to reset an environment before done. If you want to allow early resets, "
            "wrap your env with Monitor(env, path, allow_early_resets=True)"
        )
    monitor.rewards = []
    monitor.needs_reset = False


def record_episode(monitor: Monitor, episode_return: float, length: int, info: dict[str, Any]) -> None:
    """
    Write a row of the monitor file and add ``episode`` to the info.

    :param monitor: of the environment
    :param episode_return: sum of the rewards
    :param length: in steps
    :param info: of the last step; ``info_keywords`` are read from it
    """
    seconds = time.time() - monitor.t_start
    episode: dict[str, Any] = {"r": round(episode_return, 6), "l": length, "t": round(seconds, 6)}
    for key in monitor.info_keywords:
        episode[key] = info[key]
    monitor.episode_returns.append(episode_return)
    monitor.episode_lengths.append(length)
    monitor.episode_times.append(seconds)
    monitor.total_steps += length
    monitor.needs_reset = True
    episode.update(monitor.current_reset_info)
    if monitor.results_writer:
        monitor.results_writer.write_row(episode)
    info["episode"] = episode
