"""What is known of the paper's tasks from elsewhere, and how tests play them."""

from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

from sb3_gae.envs import TASKS, MujocoTaskEnv


@dataclass(frozen=True)
class Facts:
    """
    What is known of a task from elsewhere.

    :param gears: largest torque of each motor in N·m; none where actions are discrete
    :param limbs: bodies whose contacts with the floor cost, each with all that hangs on it
    """

    n_observations: int
    dt: float
    max_episode_steps: int
    gears: tuple[float, ...] = ()
    torque_cost_weight: float = 0.0
    impact_cost_weight: float = 0.0
    limbs: tuple[str, ...] = ()
    alive_bonus: float | None = None
    lowest_height: float | None = None


BIPED_GEARS = (100.0,) * 6 + (20.0,) * 4
QUADRUPED_LEGS = ("front_left_leg", "back_left_leg", "back_right_leg", "front_right_leg")
FACTS = {
    "GaeCartPole-v0": Facts(4, 0.02, 1000, alive_bonus=1.0),
    "GaeBiped-v0": Facts(33, 0.01, 2000, BIPED_GEARS, 1e-5, 1e-5, ("right_thigh", "left_thigh"), 0.2, 0.8),
    "GaeQuadruped-v0": Facts(29, 0.01, 2000, (60.0,) * 8, 1e-6, 1e-3, QUADRUPED_LEGS, 0.05, 0.2),
    "GaeBipedStandup-v0": Facts(33, 0.01, 2000, BIPED_GEARS, 1e-5),
}
CONTINUOUS = [task_id for task_id, facts in FACTS.items() if facts.gears]
LOCOMOTION = [task_id for task_id, facts in FACTS.items() if facts.lowest_height]

every_task = pytest.mark.parametrize("task_id", TASKS)


def make(task_id: str, **kwargs: Any) -> MujocoTaskEnv:
    """The environment without its wrappers."""
    env = gym.make(task_id, **kwargs).unwrapped
    assert isinstance(env, MujocoTaskEnv)
    return env


def random_action(env: gym.Env, rng: np.random.Generator) -> Any:
    """Of the whole space, and a little beyond."""
    if isinstance(env.action_space, spaces.Discrete):
        return rng.integers(env.action_space.n)
    return rng.uniform(-1.2, 1.2, env.action_space.shape).astype(np.float32)


def rollout(env: gym.Env, seed: int, n_steps: int = 60) -> np.ndarray:
    """Observations, rewards and endings of random actions, with a reset every 20 steps."""
    rng = np.random.default_rng(seed)
    rows = []
    for step in range(n_steps):
        if step % 20 == 0:
            observation, _ = env.reset(seed=seed if step == 0 else None)
            rows.append([*observation, 0.0, 0.0])
        observation, reward, terminated, _, _ = env.step(random_action(env, rng))
        rows.append([*observation, reward, terminated])
    return np.array(rows)
