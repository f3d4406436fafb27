"""Environments stepped in batches by native code, behind SB3's ``VecEnv``."""

from sb3_gae.vec_env.choice import batched_vec_env
from sb3_gae.vec_env.envpool_vec_env import EnvPoolVecEnv
from sb3_gae.vec_env.mujoco_vec_env import MujocoVecEnv
from sb3_gae.vec_env.step_infos import StepInfos

__all__ = ["EnvPoolVecEnv", "MujocoVecEnv", "StepInfos", "batched_vec_env"]
