"""Trainings for the tests of checkpoints: short ones of many kinds, and what must be the same in the end."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from envs_for_tests import SMALL, AnySpacesEnv
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecNormalize

from sb3_gae import TRPOGAE, MujocoVecEnv, ResumableCheckpointCallback
from sb3_gae.saving.checkpoint_file import checkpoints_in

#: two environments take so many steps in an iteration
STEPS = 2 * 32


def cart_poles() -> VecEnv:
    return VecNormalize(make_vec_env("CartPole-v1", 2))


def batched(task_id: str) -> Callable[[], VecEnv]:
    return lambda: VecNormalize(make_vec_env(task_id, 2, vec_env_cls=MujocoVecEnv))


def one_by_one(task_id: str) -> Callable[[], VecEnv]:
    return lambda: DummyVecEnv([lambda: gym.make(task_id)] * 2)


def random_numbers() -> VecEnv:
    return DummyVecEnv([AnySpacesEnv] * 2)


#: how to make the environment, and settings
TRAININGS: dict[str, tuple[Callable[[], VecEnv], dict[str, Any]]] = {
    "CartPole-v1, normalized": (cart_poles, {}),
    "the paper's cart-pole": (batched("GaeCartPole-v0"), {}),
    "the paper's biped": (batched("GaeBiped-v0"), {}),
    "the paper's biped, one by one": (one_by_one("GaeBiped-v0"), {}),
    "HalfCheetah-v5": (one_by_one("HalfCheetah-v5"), {}),
    "Ant-v5": (one_by_one("Ant-v5"), {}),
    "random numbers": (random_numbers, {}),
    "gSDE": (one_by_one("Pendulum-v1"), {"use_sde": True, "sde_sample_freq": 3}),
    "lambda from measurement": (cart_poles, {"gae_lambda": "auto"}),
    "lambda by explained variance": (cart_poles, {"gae_lambda": "explained_variance"}),
    "lambda by schedule": (cart_poles, {"gae_lambda": lambda progress: 0.9 + 0.05 * progress}),
    "whole episodes": (cart_poles, {"n_episodes": 1}),
    "time for a baseline": (cart_poles, {"baseline": "time"}),
    "Adam": (cart_poles, {"vf_optimizer": "adam", "batch_size": 16, "learning_rate": lambda progress: 1e-2 * progress}),
    "samples of the batch": (cart_poles, {"sub_sampling_factor": 2, "curvature_samples": 16}),
}


def make_model(env: VecEnv, **kwargs: Any) -> TRPOGAE:
    return TRPOGAE("MlpPolicy", env, **({"n_steps": STEPS // 2, "policy_kwargs": SMALL, "seed": 3} | kwargs))


def everything(model: TRPOGAE) -> dict[str, Any]:
    """What must be the same bit for bit, with names."""
    found: dict[str, Any] = dict(model.policy.state_dict())
    for group in model.policy.optimizer.state_dict()["state"].values():
        found |= {f"optimizer {name} {len(found)}": value for name, value in group.items()}
    found |= {"numpy": np.random.get_state()[1], "torch": th.get_rng_state(), "lambda": model.gae_lambda}
    found |= {name: getattr(model, name) for name in ("num_timesteps", "_n_updates", "_last_obs", "_last_episode_starts")}
    found["episodes"] = [(episode["r"], episode["l"]) for episode in model.ep_info_buffer]
    if (normalize := model.get_vec_normalize_env()) is not None:
        for name in ("obs_rms", "ret_rms"):
            found |= {f"{name} {part}": value for part, value in vars(getattr(normalize, name)).items()}
        found["returns"] = normalize.returns
    return found


def differences(one: dict[str, Any], other: dict[str, Any]) -> list[str]:
    """Names of what is not the same bit for bit."""
    assert one.keys() == other.keys()
    return [name for name in one if not np.array_equal(np.asarray(one[name]), np.asarray(other[name]))]


def train(folder: Path, iterations: int = 3, **kwargs: Any) -> TRPOGAE:
    """With checkpoints in ``folder``, after each iteration if ``kwargs`` say nothing else."""
    model = make_model(cart_poles())
    return model.learn(
        iterations * STEPS, callback=ResumableCheckpointCallback(**({"save_freq": 1, "save_path": folder} | kwargs))
    )


def steps_in(folder: Path) -> list[int]:
    """After how many iterations the checkpoints were written, the newest first."""
    return [int(path.name.split("_")[-2]) // STEPS for path in checkpoints_in(folder)]


def copy_of(folder: Path, to: Path) -> list[Path]:
    for path in folder.iterdir():
        (to / path.name).write_bytes(path.read_bytes())
    return checkpoints_in(to)
