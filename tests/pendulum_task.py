"""A task of one's own for the tests of batches, whose numbers can be made to blow up."""

from pathlib import Path
from typing import Any

import numpy as np
from batched_and_single import EnvFns
from gymnasium.wrappers import TimeLimit
from stable_baselines3.common.monitor import Monitor

from sb3_gae.envs import MujocoTask, MujocoTaskEnv, PhysicsStates

PENDULUM = """
    <mujoco>
      <option timestep="0.005"/>
      <worldbody><body>
        <joint name="hinge" axis="0 1 0" damping="0.1"/>
        <geom type="capsule" fromto="0 0 0 0 0 -1" size="0.02" mass="1"/>
      </body></worldbody>
      <actuator><motor joint="hinge" ctrlrange="-2 2"/></actuator>
      <sensor><jointpos name="angle" joint="hinge"/></sensor>
    </mujoco>"""


class PendulumTask(MujocoTask):
    """What it returns are parts of the arrays that it gets."""

    def __init__(self, model_path: Path, frame_skip: int = 1, push: float = 0.0, goal: Any = None):
        super().__init__(model_path, frame_skip)
        self.push = push
        self.goal = goal

    def initial_state(self, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        return rng.uniform(-1.0, 1.0, 1), np.array([self.push])

    def observations(self, states: PhysicsStates) -> np.ndarray:
        return states.qpos

    def reward_terms(self, states: PhysicsStates) -> dict[str, np.ndarray]:
        return {"angle": states.sensors["angle"][:, 0], "speed": states.qvel[:, 0]}

    def terminated(self, states: PhysicsStates) -> np.ndarray:
        return states.qpos[:, 0] > 0.3


def pendulums(path: Path, n_envs: int, **kwargs: Any) -> EnvFns:
    return [lambda: Monitor(TimeLimit(MujocoTaskEnv(PendulumTask(path, **kwargs)), 10))] * n_envs
