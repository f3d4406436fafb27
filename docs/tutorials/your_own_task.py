"""
A task of your own that runs in batches, and a sweep of λ on it.

    python docs/tutorials/your_own_task.py          # a minute; writes swing_up.xml, logs/ and swing_up_lambda.png
"""

from pathlib import Path

import gymnasium
import numpy as np

from sb3_gae.envs import MujocoTask, MujocoTaskEnv, PhysicsStates
from sb3_gae.sweep import draw, run_sweep

# The body: a pendulum with a motor too weak to lift it, and a sensor for what the reward needs
Path("swing_up.xml").write_text("""
<mujoco>
  <option timestep="0.02" integrator="implicitfast"/>
  <worldbody>
    <light pos="0 -1 3"/>
    <camera name="track" pos="0 -3 0" xyaxes="1 0 0 0 0 1"/>
    <body>
      <joint name="hinge" axis="0 1 0" damping="0.05"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.6" size="0.04" mass="1"/>
      <site name="tip" pos="0 0 -0.6"/>
    </body>
  </worldbody>
  <actuator><motor joint="hinge" gear="1.5" ctrllimited="true" ctrlrange="-1 1"/></actuator>
  <sensor><framepos name="tip" objtype="site" objname="tip"/></sensor>
</mujoco>""")


class SwingUp(MujocoTask):
    """The first axis of every array is that of the environments: one function scores one of them, or thousands."""

    def __init__(self):
        super().__init__("swing_up.xml", frame_skip=2)

    def initial_state(self, rng: np.random.Generator):
        return rng.uniform(-0.1, 0.1, 1), rng.uniform(-0.1, 0.1, 1)  # qpos, qvel

    def observations(self, states: PhysicsStates) -> np.ndarray:
        return np.concatenate([np.sin(states.qpos), np.cos(states.qpos), states.qvel], axis=1)

    def reward_terms(self, states: PhysicsStates) -> dict[str, np.ndarray]:
        return {
            "height": states.sensors["tip"][:, 2],
            "torque_cost": -0.01 * np.square(states.controls).sum(axis=1),
        }


class SwingUpEnv(MujocoTaskEnv):
    def __init__(self, render_mode: str | None = None):
        super().__init__(SwingUp(), render_mode)


gymnasium.register("SwingUp-v0", entry_point=SwingUpEnv, max_episode_steps=250)

# Each cell is a training through rl-zoo3; what is done is stored, so that a second call runs nothing again
table = run_sweep(
    env="SwingUp-v0",
    gammas=[0.98],
    lambdas=[0.0, 0.9, 0.96, 1.0],
    seeds=2,
    iterations=15,
    hyperparams={"n_envs": 16, "n_steps": 250},
    name="swing-up",
)
last = table[table.iteration == table.iteration.max()]
print(last.groupby("gae_lambda").mean_return.agg(["mean", "min", "max"]).round(1))
draw("lambda", table, "swing_up_lambda.png")
