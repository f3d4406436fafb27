"""One environment of a :class:`~sb3_gae.envs.MujocoTask`, as gymnasium has them."""

from typing import Any, ClassVar

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium.envs.mujoco.mujoco_rendering import MujocoRenderer

from sb3_gae.envs.mujoco_task import FULL_PHYSICS, MujocoTask, is_physical, total_reward


class MujocoTaskEnv(gym.Env):
    """
    A gymnasium environment of a task; :class:`~sb3_gae.MujocoVecEnv` steps many of them in one call.

    ``info`` has the terms of the reward by name and, in a step whose numbers blew up, ``numerical_failure``. Such
    a step ends the episode as a time limit would, with the state before it as the last, and all its terms are 0.

    :param task: model, observations, rewards and endings
    :param render_mode: ``"human"``, ``"rgb_array"``, ``"depth_array"`` or None
    :param width: of rendered images, in pixels
    :param height: of rendered images, in pixels
    :param camera_name: of the model's cameras
    :raises ValueError: if ``render_mode`` is unknown
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["human", "rgb_array", "depth_array"]}  # type: ignore[misc]

    def __init__(
        self,
        task: MujocoTask,
        render_mode: str | None = None,
        width: int = 480,
        height: int = 480,
        camera_name: str | None = "track",
    ):
        self.task = task
        self.metadata = {**type(self).metadata, "render_fps": round(1.0 / task.dt)}  # type: ignore[misc]
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise ValueError(f"`render_mode` must be one of {self.metadata['render_modes']} or None, got {render_mode!r}.")
        self.render_mode = render_mode
        self.model, self.data = task.model, mujoco.MjData(task.model)
        self.observation_space, self.action_space = task.observation_space, task.action_space
        self._image = {"width": width, "height": height, "camera_name": camera_name}
        self._renderer: MujocoRenderer | None = None
        self._physics = np.zeros((1, mujoco.mj_stateSize(self.model, FULL_PHYSICS)))
        self._was_reset = False

    def share_task(self, task: MujocoTask) -> None:
        """
        Take part in a batch, whose environments have one model.

        :param task: equal to this environment's own
        """
        self.task, self.model, self.data = task, task.model, mujoco.MjData(task.model)

    @property
    def dt(self) -> float:
        """Seconds in a step."""
        return self.task.dt

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self.set_state(*self.task.initial_state(self.np_random))
        self._was_reset = True
        if self.render_mode == "human":
            self.render()
        return self._observation(), {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """
        Take one control step, which lasts ``dt`` seconds.

        :param action: of the action space
        :return: observation, shape (n,); reward; whether the task has ended; whether the numbers blew up, since a time limit
            is a wrapper's; and the terms of the reward by name
        :raises gymnasium.error.ResetNeeded: if there was no ``reset`` before
        :raises ValueError: if the shape of the action is not that of the action space
        """
        if not self._was_reset:
            raise gym.error.ResetNeeded("Call `reset` before `step`.")
        action = np.asarray(action)
        if action.shape != self.action_space.shape:
            raise ValueError(f"`action` must have shape {self.action_space.shape}, got {action.shape}.")
        before = self.physics_state.copy()
        controls = self.task.controls(action[None])
        self.data.ctrl[:] = controls[0]
        sound = self._advance()
        if not sound:
            self.physics_state = before
        states = self.task.states(self.physics_state, controls, self.data.sensordata[None])
        terms = {name: float(term[0]) for name, term in self.task.reward_terms(states).items()}
        if not sound:
            return self._observation(), 0.0, False, True, dict.fromkeys(terms, 0.0) | {"numerical_failure": True}
        if self.render_mode == "human":
            self.render()
        return self._observation(), float(total_reward(terms)), bool(self.task.terminated(states)[0]), False, dict(terms)

    def _advance(self) -> bool:
        """Take the physics steps of one control step and return whether every one of them gave sound numbers."""
        self.data.warning.number[:] = 0
        for step in range(self.task.frame_skip):
            # The native call of a batch, too, goes no further after a warning
            if step > 0 and self.data.warning.number.any():
                return False
            mujoco.mj_step(self.model, self.data)
            if not is_physical(self.physics_state)[0]:
                return False
        return True

    @property
    def physics_state(self) -> np.ndarray:
        """The full physics state, shape (1, n_state)."""
        mujoco.mj_getState(self.model, self.data, self._physics[0], FULL_PHYSICS)
        return self._physics

    @physics_state.setter
    def physics_state(self, state: np.ndarray) -> None:
        mujoco.mj_setState(self.model, self.data, np.ascontiguousarray(state.reshape(-1)), FULL_PHYSICS)
        mujoco.mj_forward(self.model, self.data)

    def set_state(self, qpos: np.ndarray, qvel: np.ndarray) -> None:
        """
        Begin anew from a state of one's own.

        :param qpos: shape (nq,)
        :param qvel: shape (nv,)
        :raises ValueError: if a shape is wrong
        """
        if np.shape(qpos) != (self.model.nq,) or np.shape(qvel) != (self.model.nv,):
            raise ValueError(
                f"`qpos` and `qvel` must have shapes ({self.model.nq},) and ({self.model.nv},), "
                f"got {np.shape(qpos)} and {np.shape(qvel)}."
            )
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:], self.data.qvel[:] = qpos, qvel
        mujoco.mj_forward(self.model, self.data)
        self._was_reset = True

    def state_dict(self) -> dict[str, Any]:
        """
        :return: what the next steps and resets depend on; of the task nothing, whose arguments are to be the same
        """
        return {"physics": self.physics_state[0].copy(), "np_random": self.np_random, "was_reset": self._was_reset}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """
        :param state: what :meth:`state_dict` returned, in this process or an earlier one
        """
        self.physics_state = state["physics"]
        self.np_random, self._was_reset = state["np_random"], state["was_reset"]

    def _observation(self) -> np.ndarray:
        states = self.task.states(self.physics_state, self.data.ctrl[None], self.data.sensordata[None])
        return self.task.observations(states)[0].copy()

    def render(self) -> Any:
        if self.render_mode is None:
            gym.logger.warn("Nothing to render: give `render_mode` when making the environment.")
            return None
        if self._renderer is None:
            self._renderer = MujocoRenderer(self.model, self.data, **self._image)  # type: ignore[arg-type]
        # A step leaves bodies and cameras where they were at its beginning
        mujoco.mj_fwdPosition(self.model, self.data)
        return self._renderer.render(self.render_mode)

    def close(self) -> None:
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None
