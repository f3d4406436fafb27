"""A MuJoCo task as a model and functions of arrays, so that one state and a batch of states are scored by the same code."""

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from gymnasium import spaces

# What `mujoco.rollout` takes and returns: time, positions, velocities, and the state of actuators and plugins
FULL_PHYSICS = mujoco.mjtState.mjSTATE_FULLPHYSICS

# Larger than this, MuJoCo itself calls a number bad
_LARGEST = 1e10


@dataclass(frozen=True)
class PhysicsStates:
    """
    A batch of N states, each after one control step.

    Positions and velocities are of the new state. MuJoCo computes sensors at the beginning of a physics step,
    so these are of the state before the last of the control step's physics steps.

    :param qpos: generalized positions, shape (N, nq)
    :param qvel: generalized velocities, shape (N, nv)
    :param controls: what the actuators were given during the step, shape (N, nu)
    :param sensors: for each sensor of the model its readings, shape (N, dimension)
    """

    qpos: np.ndarray
    qvel: np.ndarray
    controls: np.ndarray
    sensors: Mapping[str, np.ndarray]


class MujocoTask:
    """
    What is specific to a task. Subclasses say how a state is observed and rewarded, and when an episode ends.

    The solver's warm start is off, since it is no part of a state: a step is then a function of state and controls
    alone, whether it is taken one environment at a time or in a batch. So is MuJoCo's automatic reset, which would hide
    numbers that have blown up.

    :param model_path: of the MJCF file
    :param frame_skip: physics steps in a control step
    :raises ValueError: if the file is not there, or ``frame_skip`` is not a positive whole number
    """

    observation_space: spaces.Box
    action_space: spaces.Space

    def __init__(self, model_path: str | os.PathLike[str], frame_skip: int = 1):
        if not Path(model_path).is_file():
            raise ValueError(f"`model_path` must be an MJCF file, but there is none at {model_path}.")
        if not isinstance(frame_skip, int) or frame_skip < 1:
            raise ValueError(f"`frame_skip` must be a whole number of at least 1, got {frame_skip!r}.")
        self.model = mujoco.MjModel.from_xml_path(str(model_path))
        self.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_WARMSTART | mujoco.mjtDisableBit.mjDSBL_AUTORESET
        self.frame_skip = frame_skip
        self._sensors = {
            self.model.sensor(i).name: slice(adr, adr + dim)
            for i, (adr, dim) in enumerate(zip(self.model.sensor_adr, self.model.sensor_dim, strict=True))
        }
        self._initial_data = mujoco.MjData(self.model)
        # MuJoCo has zeros where a model gives no range
        self.model.actuator_ctrlrange[self.model.actuator_ctrllimited == 0] = -np.inf, np.inf
        bounds = self.model.actuator_ctrlrange.astype(np.float32)
        self.action_space = spaces.Box(bounds[:, 0], bounds[:, 1], dtype=np.float32)
        states = self.states(*(np.zeros((1, n)) for n in self._sizes))
        size = self.observations(states).shape[1]
        self.observation_space = spaces.Box(-np.inf, np.inf, (size,), np.float64)

    @property
    def dt(self) -> float:
        """Seconds in a control step."""
        return float(self.model.opt.timestep) * self.frame_skip

    @property
    def _sizes(self) -> tuple[int, int, int]:
        return mujoco.mj_stateSize(self.model, FULL_PHYSICS), self.model.nu, self.model.nsensordata

    def states(self, physics: np.ndarray, controls: np.ndarray, sensor_data: np.ndarray) -> PhysicsStates:
        """
        :param physics: full physics states, shape (N, n_state)
        :param controls: shape (N, nu)
        :param sensor_data: shape (N, n_sensordata)
        :return: views of them by name
        """
        nq, nv = self.model.nq, self.model.nv
        sensors = {name: sensor_data[:, part] for name, part in self._sensors.items()}
        return PhysicsStates(physics[:, 1 : 1 + nq], physics[:, 1 + nq : 1 + nq + nv], controls, sensors)

    def initial_state(self, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """
        :param rng: of one environment
        :return: positions, shape (nq,), and velocities, shape (nv,); those of the model unless a subclass says otherwise
        """
        return self._initial_data.qpos.copy(), self._initial_data.qvel.copy()

    def controls(self, actions: np.ndarray) -> np.ndarray:
        """
        :param actions: of the action space, shape (N, ...)
        :return: what the actuators get, within their range, shape (N, nu)
        """
        bounds = self.model.actuator_ctrlrange
        return np.clip(actions, bounds[:, 0], bounds[:, 1], dtype=np.float64)

    def observations(self, states: PhysicsStates) -> np.ndarray:
        """
        :param states: N states; at the beginning of an episode the sensors are read anew for the state itself
        :return: shape (N, n)
        """
        return np.concatenate([states.qpos, states.qvel], axis=1)

    def reward_terms(self, states: PhysicsStates) -> dict[str, np.ndarray]:
        """
        :param states: N states
        :return: the terms of the reward, each of shape (N,); the reward is their sum
        :raises NotImplementedError: unless a subclass says what they are
        """
        raise NotImplementedError

    def terminated(self, states: PhysicsStates) -> np.ndarray:
        """
        :param states: N states
        :return: whether the episode has ended, shape (N,); never unless a subclass says otherwise
        """
        return np.zeros(len(states.qpos), dtype=bool)


def is_physical(physics: np.ndarray) -> np.ndarray:
    """
    :param physics: full physics states, shape (N, n_state)
    :return: whether every number is finite and not absurd, shape (N,)
    """
    # NaN compares false
    return np.logical_and.reduce(np.abs(physics) < _LARGEST, axis=1)


def total_reward(terms: dict[str, Any]) -> Any:
    """
    :param terms: of the reward, each a number or of shape (N,)
    :return: their sum, always added in the same order
    """
    return sum(terms.values())
