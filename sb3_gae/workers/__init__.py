"""Rollouts collected by Ray workers, behind SB3's ``VecEnv``. Ray itself is imported when workers are made."""

from sb3_gae.workers.ray_vec_env import RayVecEnv

__all__ = ["RayVecEnv"]
