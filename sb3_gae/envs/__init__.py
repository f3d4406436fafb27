"""The paper's tasks as gymnasium environments, and what a task of one's own is made of."""

import gymnasium as gym

from sb3_gae.envs.mujoco_env import MujocoTaskEnv
from sb3_gae.envs.mujoco_task import MujocoTask, PhysicsStates

#: id, where its class is, and steps after which an episode is cut
TASKS = {
    "GaeCartPole-v0": ("sb3_gae.envs.cart_pole:GaeCartPoleEnv", 1_000),
    "GaeBiped-v0": ("sb3_gae.envs.biped:GaeBipedEnv", 2_000),
    "GaeQuadruped-v0": ("sb3_gae.envs.quadruped:GaeQuadrupedEnv", 2_000),
    "GaeBipedStandup-v0": ("sb3_gae.envs.biped_standup:GaeBipedStandupEnv", 2_000),
}


def register_tasks() -> None:
    """Make the tasks known to ``gymnasium.make``; can be repeated."""
    for task_id, (entry_point, max_episode_steps) in TASKS.items():
        if task_id not in gym.registry:
            gym.register(task_id, entry_point=entry_point, max_episode_steps=max_episode_steps)


__all__ = ["TASKS", "MujocoTask", "MujocoTaskEnv", "PhysicsStates", "register_tasks"]
