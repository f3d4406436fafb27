"""The paper's tasks as pictures and in a window."""

from typing import Any

import numpy as np
import pytest
from headless import run_headless
from task_facts import every_task, make

from sb3_gae.envs import TASKS


def test_pictures_show_something_and_have_the_size_asked_for() -> None:
    code = """
        import gymnasium as gym
        from sb3_gae.envs import TASKS
        for task_id in TASKS:
            env = gym.make(task_id, render_mode="rgb_array", width=96, height=64)
            env.reset(seed=0)
            first = env.render()
            for _ in range(10):
                env.step(env.action_space.sample())
            second = env.render()
            print(task_id, *first.shape, first.dtype, first.std() > 5, (first != second).any())
            env.close()
            env.close()
        """
    words = run_headless(code)
    assert words == [word for task_id in TASKS for word in (task_id, "64", "96", "3", "uint8", "True", "True")]


@every_task
def test_for_people_each_state_is_shown(task_id: str, monkeypatch: pytest.MonkeyPatch) -> None:
    shown = []

    class Window:
        def __init__(self, model: Any, data: Any, **kwargs: Any):
            self.data = data

        def render(self, mode: str) -> None:
            shown.append((mode, self.data.time))

    monkeypatch.setattr("sb3_gae.envs.mujoco_env.MujocoRenderer", Window)
    env = make(task_id, render_mode="human")
    env.reset(seed=0)
    for _ in range(3):
        env.step(env.action_space.sample())
    assert [mode for mode, _ in shown] == ["human"] * 4
    np.testing.assert_allclose([time for _, time in shown], env.dt * np.arange(4))


@every_task
def test_nothing_is_rendered_without_a_render_mode(task_id: str) -> None:
    env = make(task_id)
    env.reset(seed=0)
    with pytest.warns(UserWarning, match="`render_mode`"):
        assert env.render() is None
    env.close()
