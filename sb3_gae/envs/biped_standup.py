"""The paper's biped getting up (section 6.2.2): raise the head from lying on the back."""

import math

import numpy as np

from sb3_gae.envs.biped import Biped
from sb3_gae.envs.mujoco_env import MujocoTaskEnv
from sb3_gae.envs.mujoco_task import PhysicsStates

# Height of the torso at the start, in metres: high enough that no limb begins in the floor and is thrown up by it
_START_HEIGHT = 0.2


class BipedStandup(Biped):
    """
    Reward :math:`-(h_{head} - 1.5)^2 - 10^{-5}|u|^2`, and no end but the time limit; see :class:`GaeBipedStandupEnv`.

    By default the weight and the height are the paper's (section 6.2.2).

    :param torque_cost_weight: of :math:`|u|^2`, the motors' torques in N·m
    :param target_head_height: that the head is to be at, in m
    :param reset_noise: by which place, joints, turn and velocities may differ from lying at rest, in m, rad, m/s and rad/s
    """

    def __init__(self, torque_cost_weight: float = 1e-5, target_head_height: float = 1.5, reset_noise: float = 0.05):
        super().__init__(torque_cost_weight=torque_cost_weight, reset_noise=reset_noise)
        self.target_head_height = target_head_height

    def initial_state(self, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Lying on the back above the floor; place, joints, turn and velocities moved by up to ``reset_noise``."""
        qpos, qvel = super().initial_state(rng)
        half_turn = -math.pi / 4 + 0.5 * rng.uniform(-self.reset_noise, self.reset_noise)
        qpos[2] = _START_HEIGHT
        qpos[3:7] = math.cos(half_turn), 0.0, math.sin(half_turn), 0.0
        return qpos, qvel

    def reward_terms(self, states: PhysicsStates) -> dict[str, np.ndarray]:
        torques = states.controls * self._gears
        return {
            "head_height_cost": -np.square(states.sensors["head_position"][:, 2] - self.target_head_height),
            "torque_cost": -self.torque_cost_weight * np.square(torques).sum(axis=1),
        }

    def terminated(self, states: PhysicsStates) -> np.ndarray:
        return np.zeros(len(states.qpos), dtype=bool)


class GaeBipedStandupEnv(MujocoTaskEnv):
    r"""
    ``GaeBipedStandup-v0``: the biped lies on its back and is to raise its head; at most 2 000 steps of 0.01 s.

    Actions and observations are those of :class:`~sb3_gae.envs.biped.GaeBipedEnv`.

    **Reward**, by name in ``info``: ``head_height_cost`` (:math:`-(h - 1.5)^2`, h the height of the head in m) and
    ``torque_cost`` (:math:`-10^{-5}|u|^2`, u in N·m).

    **End**: never before the time limit. **Start**: on the back; place, joints, turn and velocities moved by up to 0.05.

    :param render_mode: ``"human"``, ``"rgb_array"``, ``"depth_array"`` or None
    :param width: of rendered images, in pixels
    :param height: of rendered images, in pixels
    :param task_kwargs: settings of the task: ``torque_cost_weight`` (for torques in N·m), ``target_head_height`` (m) and
        ``reset_noise`` (in the unit of each number), by default as above
    :raises ValueError: if ``render_mode`` is unknown
    :raises TypeError: if a setting is unknown
    """

    def __init__(self, render_mode: str | None = None, width: int = 480, height: int = 480, **task_kwargs: float):
        super().__init__(BipedStandup(**task_kwargs), render_mode, width, height)
