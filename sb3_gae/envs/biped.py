"""The paper's 3D biped (section 6.2.2): run forward."""

from pathlib import Path

from sb3_gae.envs.mujoco_env import MujocoTaskEnv
from sb3_gae.envs.run_forward import RunForward

LEGS = ("right_leg_force", "left_leg_force")


class Biped(RunForward):
    """
    Reward :math:`v_{fwd} - 10^{-5}|u|^2 - 10^{-5}|f_{impact}|^2 + 0.2`; see :class:`GaeBipedEnv`.

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
        torque_cost_weight: float = 1e-5,
        impact_cost_weight: float = 1e-5,
        largest_impact_force: float = 1.0,
        alive_bonus: float = 0.2,
        lowest_height: float = 0.8,
        reset_noise: float = 0.02,
    ):
        super().__init__(
            Path(__file__).with_name("biped.xml"),
            LEGS,
            torque_cost_weight=torque_cost_weight,
            impact_cost_weight=impact_cost_weight,
            largest_impact_force=largest_impact_force,
            alive_bonus=alive_bonus,
            lowest_height=lowest_height,
            reset_noise=reset_noise,
        )


class GaeBipedEnv(MujocoTaskEnv):
    r"""
    ``GaeBiped-v0``: a body of 36.4 kg with ten motors is to run along x; at most 2 000 steps of 0.01 s.

    **Actions**: Box(-1, 1, (10,)), parts of the largest torque, which is 100 N·m at hips and knees and 20 N·m at shoulders.

    ====== ============================== =======
    Index  Actuator                       N·m at 1
    ====== ============================== =======
    0, 3   hip abduction (right, left)    100
    1, 4   hip flexion                    100
    2, 5   knee flexion                   100
    6, 8   shoulder flexion               20
    7, 9   shoulder abduction             20
    ====== ============================== =======

    **Observations**: Box(-inf, inf, (33,)), positions then velocities.

    ====== ============================================================= =======
    Index  Quantity                                                      Unit
    ====== ============================================================= =======
    0-2    position of the torso: x forward, y left, z up                m
    3-6    orientation of the torso as a quaternion w, x, y, z           –
    7-9    right leg: hip abduction, hip flexion, knee flexion           rad
    10-12  left leg: likewise                                            rad
    13-14  right arm: shoulder flexion, shoulder abduction               rad
    15-16  left arm: likewise                                            rad
    17-19  velocity of the torso along x, y, z                           m/s
    20-22  angular velocity of the torso in its own frame                rad/s
    23-32  angular velocities of the joints, ordered as 7-16             rad/s
    ====== ============================================================= =======

    **Reward**, by name in ``info``: ``forward_velocity`` (of the torso along x, m/s), ``torque_cost``
    (:math:`-10^{-5}|u|^2`, u in N·m), ``impact_cost`` (:math:`-10^{-5}|f|^2`, f the ground's force on each leg in N, each
    component cut to ±1) and ``alive_bonus`` (0.2).

    **End**: the torso is lower than 0.8 m. **Start**: the standing pose, every number moved by up to 0.02.

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
        super().__init__(Biped(**task_kwargs), render_mode, width, height)
