"""Monitors of environments that are stepped in a batch: their files, their episodes, the resets that they refuse."""

from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from batched_and_single import EARLY_ENDS, assert_same_trajectories, both, functions, random_actions
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.monitor import Monitor, load_results
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_gae import MujocoVecEnv


def test_monitor_files_are_the_same(tmp_path: Path) -> None:
    tables = []
    for name, vec_env_cls in (("batched", MujocoVecEnv), ("dummy", DummyVecEnv)):
        env = make_vec_env(
            "GaeCartPole-v0",
            n_envs=3,
            seed=4,
            vec_env_cls=vec_env_cls,
            monitor_dir=str(tmp_path / name),
            monitor_kwargs={"info_keywords": ("alive_bonus",)},
        )
        rng = np.random.default_rng(0)
        env.reset()
        for _ in range(80):
            env.step(random_actions(env, rng))
        assert sum(map(len, (monitor.get_episode_rewards() for monitor in env.envs))) > 3
        env.close()
        tables.append([load_results_of(file) for file in sorted((tmp_path / name).iterdir())])
        assert len(load_results(str(tmp_path / name))) == sum(map(len, tables[-1]))
    assert len(tables[0]) == 3
    assert tables[0] == tables[1]


def load_results_of(file: Path) -> list[list[str]]:
    """Rows of a monitor file without the times."""
    _, columns, *rows = file.read_text().splitlines()
    assert columns == "r,l,t,alive_bonus"
    assert all(float(row.split(",")[2]) > 0.0 for row in rows)
    return [[value for i, value in enumerate(row.split(",")) if i != 2] for row in rows]


def test_monitors_know_their_episodes() -> None:
    batched, dummy = both(functions("GaeQuadruped-v0", 2, **EARLY_ENDS["GaeQuadruped-v0"]))
    assert assert_same_trajectories(batched, dummy, n_steps=40)
    assert batched.env_method("get_episode_lengths") == dummy.env_method("get_episode_lengths")
    # Monitor adds up by `sum`, which from Python 3.12 on keeps digits that adding one by one loses
    for ours, theirs in zip(*(env.env_method("get_episode_rewards") for env in (batched, dummy)), strict=True):
        assert ours == pytest.approx(theirs, rel=1e-12)
    assert all(len(times) > 0 for times in batched.env_method("get_episode_times"))


def test_early_resets_are_refused_where_monitor_refuses_them() -> None:
    env = MujocoVecEnv([lambda: Monitor(gym.make("GaeBiped-v0", max_episode_steps=3), allow_early_resets=False)], 1)
    env.reset()
    for _ in range(7):
        env.step(np.zeros((1, 10)))
    with pytest.raises(RuntimeError, match="early resets"):
        env.reset()
