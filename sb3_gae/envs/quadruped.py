"""The paper's quadruped (section 6.2.2): run forward on four legs."""

import math
from pathlib import Path

import numpy as np

from sb3_gae.envs.mujoco_env import MujocoTaskEnv
from sb3_gae.envs.run_forward import RunForward

LEGS = ("front_left_leg_force", "back_left_leg_force", "back_right_leg_force", "front_right_leg_force")


class Quadruped(RunForward):
    """
    Reward :math:`v_{fwd} - 10^{-6}|u|^2 - 10^{-3}|f_{impact}|^2 + 0.05`; see :class:`GaeQuadrupedEnv`.

    By default weights, bonus and lowest height are the paper's (section 6.2.2).

    :param torque_cost_weight: of :math:`|u|^2`, the motors' torques in N·m
    :param impact_cost_weight: of :math:`|f_{impact}|^2`, the ground's forces on the legs in N
    :param largest_impact_force: each component of a force is cut to this before it is squared, in N
    :param alive_bonus: for each step
    :param lowest_height: of the torso, in m; below it the episode ends
    :param reset_noise: by which each number of the first state may differ from the standing pose, in m, rad, m/s and rad/s
    """

    def __init__(
        self,
        torque_cost_weight: float = 1e-6,
        impact_cost_weight: float = 1e-3,
        largest_impact_force: float = 1.0,
        alive_bonus: float = 0.05,
        lowest_height: float = 0.2,
        reset_noise: float = 0.02,
    ):
        super().__init__(
            Path(__file__).with_name("quadruped.xml"),
            LEGS,
            torque_cost_weight=torque_cost_weight,
            impact_cost_weight=impact_cost_weight,
            largest_impact_force=largest_impact_force,
            alive_bonus=alive_bonus,
            lowest_height=lowest_height,
            reset_noise=reset_noise,
        )

    def standing_pose(self, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        qpos, qvel = super().standing_pose(rng)
        # Ankles bent until the feet stand below the ends of the legs' lower halves
        qpos[8::2] = math.radians(57.0)
        return qpos, qvel


class GaeQuadrupedEnv(MujocoTaskEnv):
    r"""
    ``GaeQuadruped-v0``: a sphere on four two-joint legs, 14.4 kg in all, is to run along x; at most 2 000 steps of 0.01 s.

    **Actions**: Box(-1, 1, (8,)), parts of the largest torque of 60 N·m: hip and ankle of the front left, back left,
    back right and front right leg.

    **Observations**: Box(-inf, inf, (29,)), positions then velocities.

    ====== ============================================================= =======
    Index  Quantity                                                      Unit
    ====== ============================================================= =======
    0-2    position of the torso: x forward, y left, z up                m
    3-6    orientation of the torso as a quaternion w, x, y, z           –
    7-14   hip and ankle of each leg, ordered as the actions             rad
    15-17  velocity of the torso along x, y, z                           m/s
    18-20  angular velocity of the torso in its own frame                rad/s
    21-28  angular velocities of the joints, ordered as 7-14             rad/s
    ====== ============================================================= =======

    **Reward**, by name in ``info``: ``forward_velocity`` (of the torso along x, m/s), ``torque_cost``
    (:math:`-10^{-6}|u|^2`, u in N·m), ``impact_cost`` (:math:`-10^{-3}|f|^2`, f the ground's force on each leg in N, each
    component cut to ±1) and ``alive_bonus`` (0.05).

    **End**: the torso is lower than 0.2 m. **Start**: the standing pose, every number moved by up to 0.02.

    :param render_mode: ``"human"``, ``"rgb_array"``, ``"depth_array"`` or None
    :param width: of rendered images, in pixels
    :param height: of rendered images, in pixels
    :param task_kwargs: settings of the task: ``torque_cost_weight`` (for torques in N·m), ``impact_cost_weight`` (for forces
        in N), ``largest_impact_force`` (N), ``alive_bonus``, ``lowest_height`` (m) and ``reset_noise`` (in the unit of each
        number), by default as above
    :raises ValueError: if ``render_mode`` is unknown
    :raises TypeError: if a setting is unknown
    """

    def __init__(self, render_mode: str | None = None, width: int = 480, height: int = 480, **task_kwargs: float):
        super().__init__(Quadruped(**task_kwargs), render_mode, width, height)
