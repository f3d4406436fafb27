"""
Trust-region policy optimization with generalized advantage estimation for Stable-Baselines3.

The paper: Schulman et al., High-Dimensional Continuous Control Using Generalized Advantage Estimation,
arXiv 1506.02438.
"""

from sb3_gae.callbacks import GradientDiagnosticsCallback, LambdaSweepCallback, SaveRolloutCallback
from sb3_gae.diagnostics.rollout_diagnostics import LambdaErrors
from sb3_gae.envs import register_tasks
from sb3_gae.errors import NumericalError, WorkersLostError
from sb3_gae.networks.policies import CnnPolicy, MlpPolicy, MultiInputPolicy, SharedMlpPolicy
from sb3_gae.presets import CARTPOLE_NETWORKS, LOCOMOTION_NETWORKS, PAPER_VALUE_FIT
from sb3_gae.rollout.rollout_buffer import GAEDictRolloutBuffer, GAERolloutBuffer, LambdaSweep
from sb3_gae.saving.checkpoint_callback import ResumableCheckpointCallback
from sb3_gae.trpo_gae import TRPOGAE
from sb3_gae.vec_env import EnvPoolVecEnv, MujocoVecEnv
from sb3_gae.workers import RayVecEnv

__version__ = "0.1.0"

register_tasks()

__all__ = [
    "CARTPOLE_NETWORKS",
    "LOCOMOTION_NETWORKS",
    "PAPER_VALUE_FIT",
    "TRPOGAE",
    "CnnPolicy",
    "EnvPoolVecEnv",
    "GAEDictRolloutBuffer",
    "GAERolloutBuffer",
    "GradientDiagnosticsCallback",
    "LambdaErrors",
    "LambdaSweep",
    "LambdaSweepCallback",
    "MlpPolicy",
    "MujocoVecEnv",
    "MultiInputPolicy",
    "NumericalError",
    "RayVecEnv",
    "ResumableCheckpointCallback",
    "SaveRolloutCallback",
    "SharedMlpPolicy",
    "WorkersLostError",
]
