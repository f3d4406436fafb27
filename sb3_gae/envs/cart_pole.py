"""The paper's cart-pole (section 6.2.2), with the physical parameters of Barto, Sutton and Anderson (1983)."""

import math
from pathlib import Path

import numpy as np
from gymnasium import spaces

from sb3_gae.envs.mujoco_env import MujocoTaskEnv
from sb3_gae.envs.mujoco_task import MujocoTask, PhysicsStates


class CartPole(MujocoTask):
    """
    Reward 1 a step until pole or cart leave their range; see :class:`GaeCartPoleEnv`.

    :param force: that pushes the cart to either side, in N
    :param largest_angle: of the pole from upright, in rad; beyond it the episode ends
    :param largest_position: of the cart from the middle, in m; beyond it the episode ends
    :param reset_noise: by which each number of the first state may differ from 0, in m, rad, m/s and rad/s
    """

    def __init__(
        self,
        force: float = 10.0,
        largest_angle: float = math.radians(12.0),
        largest_position: float = 2.4,
        reset_noise: float = 0.05,
    ):
        super().__init__(Path(__file__).with_name("cart_pole.xml"))
        self.force = force
        self.model.actuator_ctrlrange[:] = -abs(force), abs(force)
        self.largest_angle = largest_angle
        self.largest_position = largest_position
        self.reset_noise = reset_noise
        self.action_space = spaces.Discrete(2)

    def initial_state(self, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Every number up to ``reset_noise`` from an upright pole at rest in the middle."""
        state = rng.uniform(-self.reset_noise, self.reset_noise, 4)
        return state[:2], state[2:]

    def controls(self, actions: np.ndarray) -> np.ndarray:
        """Action 0 pushes to the left, 1 to the right."""
        return np.where(actions.reshape(-1, 1) == 1, self.force, -self.force).astype(np.float64)

    def reward_terms(self, states: PhysicsStates) -> dict[str, np.ndarray]:
        return {"alive_bonus": np.ones(len(states.qpos))}

    def terminated(self, states: PhysicsStates) -> np.ndarray:
        """Whether the cart is too far out or the pole too far from upright."""
        return (np.abs(states.qpos) > (self.largest_position, self.largest_angle)).any(axis=1)


class GaeCartPoleEnv(MujocoTaskEnv):
    """
    ``GaeCartPole-v0``: a cart of 1 kg is to balance a uniform pole of 0.1 kg and 1 m; at most 1 000 steps of 0.02 s.

    **Actions**: Discrete(2), a force of 10 N to the left (0) or to the right (1).

    **Observations**: Box(-inf, inf, (4,)).

    ====== ========================= =======
    Index  Quantity                  Unit
    ====== ========================= =======
    0      position of the cart      m
    1      angle of the pole         rad
    2      velocity of the cart      m/s
    3      angular velocity          rad/s
    ====== ========================= =======

    **Reward**: ``alive_bonus`` of 1 for each step.

    **End**: the pole is more than 12° from upright, or the cart more than 2.4 m from the middle. **Start**: every number
    uniform in ±0.05.

    :param render_mode: ``"human"``, ``"rgb_array"``, ``"depth_array"`` or None
    :param width: of rendered images, in pixels
    :param height: of rendered images, in pixels
    :param task_kwargs: settings of the task: ``force`` (N), ``largest_angle`` (rad), ``largest_position`` (m) and
        ``reset_noise`` (in the unit of each number), by default as above
    :raises ValueError: if ``render_mode`` is unknown
    :raises TypeError: if a setting is unknown
    """

    def __init__(self, render_mode: str | None = None, width: int = 480, height: int = 480, **task_kwargs: float):
        super().__init__(CartPole(**task_kwargs), render_mode, width, height)
