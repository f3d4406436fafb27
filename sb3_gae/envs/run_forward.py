"""What the paper's running robots have in common (section 6.2.2): to go forward, gently, and to stay up."""

from pathlib import Path

import numpy as np

from sb3_gae.envs.mujoco_task import MujocoTask, PhysicsStates


class RunForward(MujocoTask):
    r"""
    Reward :math:`v_{fwd} - c_u|u|^2 - c_f|f_{impact}|^2 + b`; it ends when the torso is too low.

    :param xml_path: of the robot, whose sensors are ``torso_velocity`` and a force of the ground for each leg
    :param legs: names of these forces
    :param torque_cost_weight: :math:`c_u`, torques in N·m
    :param impact_cost_weight: :math:`c_f`, forces in N
    :param largest_impact_force: each component of a force is cut to this before it is squared, in N
    :param alive_bonus: b, for each step
    :param lowest_height: of the torso, in m
    :param reset_noise: by which each number of the first state may differ from the standing pose
    """

    def __init__(
        self,
        xml_path: str | Path,
        legs: tuple[str, ...],
        *,
        torque_cost_weight: float,
        impact_cost_weight: float,
        largest_impact_force: float,
        alive_bonus: float,
        lowest_height: float,
        reset_noise: float,
    ):
        super().__init__(xml_path)
        self.legs = legs
        self.torque_cost_weight = torque_cost_weight
        self.impact_cost_weight = impact_cost_weight
        self.largest_impact_force = largest_impact_force
        self.alive_bonus = alive_bonus
        self.lowest_height = lowest_height
        self.reset_noise = reset_noise
        self._gears = self.model.actuator_gear[:, 0].copy()

    def initial_state(self, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """The standing pose, every number moved by up to ``reset_noise``."""
        qpos, qvel = self.standing_pose(rng)
        noise = self.reset_noise
        return qpos + rng.uniform(-noise, noise, qpos.shape), qvel + rng.uniform(-noise, noise, qvel.shape)

    def standing_pose(self, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """
        :param rng: for poses that are drawn
        :return: positions and velocities to start near
        """
        return super().initial_state(rng)

    def reward_terms(self, states: PhysicsStates) -> dict[str, np.ndarray]:
        torques = states.controls * self._gears
        return {
            "forward_velocity": states.sensors["torso_velocity"][:, 0],
            "torque_cost": -self.torque_cost_weight * np.square(torques).sum(axis=1),
            "impact_cost": -self.impact_cost_weight * self.squared_impacts(states),
            "alive_bonus": np.full(len(torques), self.alive_bonus),
        }

    def squared_impacts(self, states: PhysicsStates) -> np.ndarray:
        """
        :param states: N states
        :return: sum of the squares of the ground's forces on the legs, each component cut, in N², shape (N,)
        """
        forces = np.concatenate([states.sensors[name] for name in self.legs], axis=1)
        return np.square(np.clip(forces, -self.largest_impact_force, self.largest_impact_force)).sum(axis=1)

    def terminated(self, states: PhysicsStates) -> np.ndarray:
        """Whether the torso is lower than ``lowest_height``."""
        return states.qpos[:, 2] < self.lowest_height
