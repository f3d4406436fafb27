"""Arguments of the paper's tasks, good ones and bad ones."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from task_facts import every_task, make, random_action

from sb3_gae.envs import MujocoTask, MujocoTaskEnv

SETTINGS: dict[str, dict[str, float]] = {
    "GaeCartPole-v0": {"force": 3.0, "largest_angle": 0.02, "largest_position": 0.01, "reset_noise": 0.0},
    "GaeBiped-v0": {
        "torque_cost_weight": 0.5,
        "impact_cost_weight": 0.5,
        "largest_impact_force": 3.0,
        "alive_bonus": 7.0,
        "lowest_height": 9.0,
        "reset_noise": 0.0,
    },
    "GaeBipedStandup-v0": {"torque_cost_weight": 0.5, "target_head_height": 3.0, "reset_noise": 0.0},
}
SETTINGS["GaeQuadruped-v0"] = SETTINGS["GaeBiped-v0"]


@pytest.mark.parametrize(("task_id", "name"), [(task_id, name) for task_id in SETTINGS for name in SETTINGS[task_id]])
def test_each_setting_changes_the_task(task_id: str, name: str) -> None:
    value = SETTINGS[task_id][name]
    env = make(task_id, **{name: value})
    assert getattr(env.task, name) == value
    different = rollout_with_infos(make(task_id)) != rollout_with_infos(env)
    assert different, "and not only an attribute"


def rollout_with_infos(env: MujocoTaskEnv) -> list[Any]:
    rng = np.random.default_rng(0)
    rows: list[Any] = [env.reset(seed=0)[0].tolist()]
    for _ in range(60):
        observation, *rest = env.step(random_action(env, rng))
        rows.append([observation.tolist(), *rest])
    return rows


def test_settings_scale_what_they_name() -> None:
    def info_of(**kwargs: float) -> dict[str, float]:
        env = make("GaeBiped-v0", reset_noise=0.0, **kwargs)
        env.reset(seed=0)
        for _ in range(5):
            _, _, _, _, info = env.step(np.full(10, 0.01, np.float32))
        return info

    usual = info_of()
    assert usual["impact_cost"] < 0.0, "it stands on its feet"
    assert info_of(torque_cost_weight=3e-5)["torque_cost"] == pytest.approx(3 * usual["torque_cost"])
    assert info_of(impact_cost_weight=3e-5)["impact_cost"] == pytest.approx(3 * usual["impact_cost"])
    assert info_of(alive_bonus=7.0)["alive_bonus"] == 7.0


@every_task
def test_a_setting_that_there_is_not_is_refused(task_id: str) -> None:
    with pytest.raises(TypeError, match="no_such_setting"):
        make(task_id, no_such_setting=1.0)


@every_task
def test_a_step_before_the_first_reset_is_refused(task_id: str) -> None:
    env = make(task_id)
    with pytest.raises(gym.error.ResetNeeded, match="reset"):
        env.step(env.action_space.sample())


@every_task
def test_an_unknown_render_mode_is_refused(task_id: str) -> None:
    with pytest.raises(ValueError, match=r"`render_mode` must be one of .*rgb_array.*, got 'holographic'"):
        type(make(task_id))(render_mode="holographic")


@every_task
def test_a_state_of_the_wrong_size_is_refused(task_id: str) -> None:
    env = make(task_id)
    nq, nv = env.model.nq, env.model.nv
    for qpos, qvel in ((nq + 1, nv), (nq, nv + 1), (1, 1)):
        with pytest.raises(ValueError, match=rf"must have shapes \({nq},\) and \({nv},\), got \({qpos},\) and \({qvel},\)"):
            env.set_state(np.zeros(qpos), np.zeros(qvel))


@every_task
def test_an_action_of_the_wrong_shape_is_refused(task_id: str) -> None:
    env = make(task_id)
    env.reset(seed=0)
    for shape in ((7,), (1, *env.action_space.shape)):
        with pytest.raises(ValueError, match=r"`action` must have shape \(.*\), got \("):
            env.step(np.zeros(shape, np.float32))


def test_a_model_that_is_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="`model_path` must be an MJCF file, but there is none at"):
        MujocoTask(tmp_path / "none.xml")


@pytest.mark.parametrize("frame_skip", [0, -1, 1.5])
def test_a_frame_skip_that_is_no_positive_whole_number_is_refused(frame_skip: Any) -> None:
    path = Path(mujoco.__file__)
    with pytest.raises(ValueError, match="`frame_skip` must be a whole number of at least 1"):
        MujocoTask(path, frame_skip)


def test_an_actuator_without_a_range_has_none(tmp_path: Path) -> None:
    """MuJoCo's own range is then [0, 0], which would cut every action to nothing."""
    (tmp_path / "model.xml").write_text("""
        <mujoco><worldbody><body><joint name="j" type="slide"/><geom size="0.1"/></body></worldbody>
        <actuator><motor joint="j"/><motor joint="j" ctrlrange="-2 1"/></actuator></mujoco>""")
    task = MujocoTask(tmp_path / "model.xml")
    np.testing.assert_array_equal(task.action_space.low, [-np.inf, -2.0])
    np.testing.assert_array_equal(task.controls(np.array([[70.0, 70.0]])), [[70.0, 1.0]])
