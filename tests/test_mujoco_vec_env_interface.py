"""Environments stepped in a batch do all that SB3 expects of a ``VecEnv``."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from batched_and_single import (
    EARLY_ENDS,
    assert_same_step,
    assert_same_trajectories,
    both,
    every_task,
    functions,
    random_actions,
)
from gymnasium.wrappers import ClipAction, TimeLimit
from headless import run_headless
from pendulum_task import PendulumTask
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecCheckNan, VecEnv, VecFrameStack, VecMonitor, VecNormalize

from sb3_gae import MujocoVecEnv
from sb3_gae.envs import TASKS, MujocoTaskEnv


@every_task
def test_seeds_count_for_one_reset(task_id: str) -> None:
    batched, dummy = both(functions(task_id, 3))
    batched.seed(3)
    dummy.seed(3)
    first = batched.reset()
    np.testing.assert_array_equal(first, dummy.reset())
    assert len({row.tobytes() for row in first}) == 3
    second = batched.reset()
    np.testing.assert_array_equal(second, dummy.reset())
    assert not np.array_equal(first, second)
    batched.seed(3)
    np.testing.assert_array_equal(batched.reset(), first)


class OptionsEnv(MujocoTaskEnv):
    """Reports the options that it is reset with."""

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        observation, _ = super().reset(seed=seed, options=options)
        return observation, {"options": options}


def test_options_count_for_one_reset_and_its_infos_are_kept(pendulum: Path) -> None:
    env = MujocoVecEnv([lambda: TimeLimit(OptionsEnv(PendulumTask(pendulum)), 3)] * 2, 1)
    env.set_options([{"a": 1}, {"a": 2}])
    env.reset()
    assert env.reset_infos == [{"options": {"a": 1}}, {"options": {"a": 2}}]
    env.set_options({"b": 3})
    env.reset()
    assert env.reset_infos == [{"options": {"b": 3}}] * 2
    over = np.zeros(2, dtype=bool)
    for _ in range(3):
        over |= env.step(np.zeros((2, 1)))[2]
    assert over.all()
    assert env.reset_infos == [{"options": None}] * 2, "of the reset that the end of an episode brings"


def test_attributes_are_those_of_the_environments_in_their_present_state() -> None:
    batched, dummy = both(functions("GaeBiped-v0", 3))
    assert_same_trajectories(batched, dummy, n_steps=5)
    for name in ("dt", "render_mode", "spec"):
        assert batched.get_attr(name) == dummy.get_attr(name)
    for found, expected in zip(batched.get_attr("data"), dummy.get_attr("data"), strict=True):
        np.testing.assert_array_equal(found.qpos, expected.qpos)
        np.testing.assert_array_equal(found.qvel, expected.qvel)
        assert found.time == expected.time == pytest.approx(0.05)
    assert len(batched.get_attr("data", [0, 2])) == 2
    assert len(batched.get_attr("data", 1)) == 1


def test_attributes_can_be_set() -> None:
    batched, dummy = both(functions("GaeCartPole-v0", 3))
    for env in (batched, dummy):
        assert not env.has_attr("mark")
        env.set_attr("mark", 1)
        env.set_attr("mark", 2, indices=[0, 2])
        assert env.has_attr("mark")
        assert env.get_attr("mark") == [2, 1, 2]


def test_asking_for_something_disturbs_nothing() -> None:
    batched, dummy = both(functions("GaeQuadruped-v0", 2))
    for env in (batched, dummy):
        env.seed(0)
        env.reset()
    rng = np.random.default_rng(0)
    for _ in range(30):
        actions = random_actions(dummy, rng)
        batched.get_attr("data")
        batched.env_method("get_wrapper_attr", "spec")
        assert_same_step(batched.step(actions), dummy.step(actions))


def test_a_method_can_move_an_environment() -> None:
    batched, dummy = both(functions("GaeBiped-v0", 3))
    assert_same_trajectories(batched, dummy, n_steps=3)
    qpos = np.zeros(17)
    qpos[2:4] = 5.0, 1.0
    for env in (batched, dummy):
        env.env_method("set_state", qpos, np.zeros(16), indices=1)
    rng = np.random.default_rng(1)
    for step in range(12):
        actions = random_actions(dummy, rng)
        found = batched.step(actions)
        assert_same_step(found, dummy.step(actions))
        if step < 8:
            assert (found[0][:, 2] > 3.0).tolist() == [False, True, False]


def test_resetting_one_environment_by_its_method_begins_its_episode_anew() -> None:
    batched, dummy = both(functions("GaeBiped-v0", 2, max_episode_steps=6))
    assert_same_trajectories(batched, dummy, n_steps=4)
    for env in (batched, dummy):
        ((_, info),) = env.env_method("reset", seed=5, indices=1)
        assert info == {}
    rng, done_at = np.random.default_rng(1), []
    for step in range(8):
        actions = random_actions(dummy, rng)
        found = batched.step(actions)
        assert_same_step(found, dummy.step(actions))
        done_at += [(step, env) for env in np.flatnonzero(found[2])]
    assert done_at == [(1, 0), (5, 1), (7, 0)]


def test_a_task_is_shared_so_that_changing_it_changes_every_environment() -> None:
    env = MujocoVecEnv(functions("GaeBiped-v0", 3), 1)
    env.reset()
    assert all(task is env.task for task in env.get_attr("task"))
    env.get_attr("task")[2].alive_bonus = 9.0
    assert [info["alive_bonus"] for info in env.step(np.zeros((3, 10)))[3]] == [9.0] * 3


def test_a_model_is_shared_too() -> None:
    trajectories = []
    for changed in (0, 2):
        env = MujocoVecEnv(functions("GaeBiped-v0", 3), 1)
        env.get_attr("model", [changed])[0].opt.gravity[:] = 0.0
        env.seed(0)
        env.reset()
        trajectories.append(np.stack([env.step(np.zeros((3, 10)))[0] for _ in range(5)]))
    np.testing.assert_array_equal(*trajectories)
    assert (np.abs(np.diff(trajectories[0][:, :, 19], axis=0)) < 1e-2).all(), "nothing falls"


@pytest.mark.parametrize("wrapper", [Monitor, TimeLimit, ClipAction])
def test_wrappers_are_found(wrapper: type[gym.Wrapper]) -> None:
    for env_fns in (functions("GaeCartPole-v0", 2), [lambda: gym.make("GaeCartPole-v0").unwrapped] * 2):
        batched, dummy = both(env_fns)
        assert batched.env_is_wrapped(wrapper) == dummy.env_is_wrapped(wrapper)
        assert batched.env_is_wrapped(wrapper, indices=[1]) == dummy.env_is_wrapped(wrapper, indices=[1])


def test_spaces_and_metadata_are_those_of_the_environments() -> None:
    for task_id in TASKS:
        batched, dummy = both(functions(task_id, 2))
        assert batched.observation_space == dummy.observation_space
        assert batched.action_space == dummy.action_space
        assert (batched.num_envs, batched.metadata, batched.render_mode) == (2, dummy.metadata, None)


VEC_WRAPPERS: dict[str, Callable[[VecEnv], VecEnv]] = {
    "VecNormalize": lambda env: VecNormalize(env, gamma=0.9),
    "VecMonitor": VecMonitor,
    "VecCheckNan": lambda env: VecCheckNan(env, raise_exception=True),
    "VecFrameStack": lambda env: VecFrameStack(env, 3),
}


@pytest.mark.filterwarnings("ignore:The environment is already wrapped with a `Monitor`")
@pytest.mark.parametrize("wrapper", VEC_WRAPPERS)
def test_sb3_s_wrappers_see_the_same(wrapper: str) -> None:
    for task_id in ("GaeCartPole-v0", "GaeQuadruped-v0"):
        batched, dummy = (VEC_WRAPPERS[wrapper](env) for env in both(functions(task_id, 3, **EARLY_ENDS[task_id])))
        assert assert_same_trajectories(batched, dummy, n_steps=30)


def test_a_step_before_the_first_reset_is_refused() -> None:
    env = MujocoVecEnv(functions("GaeBiped-v0", 2), 1)
    with pytest.raises(gym.error.ResetNeeded, match="reset"):
        env.step(np.zeros((2, 10)))


@pytest.mark.parametrize("shape", [(10,), (1, 10), (2, 1), (2, 9), (20,), (2, 1, 10), ()])
def test_actions_of_the_wrong_shape_are_refused(shape: tuple[int, ...]) -> None:
    env = MujocoVecEnv(functions("GaeBiped-v0", 2), 1)
    env.reset()
    with pytest.raises(ValueError, match=r"`actions` must have shape \(2, 10\), got"):
        env.step(np.zeros(shape))


@pytest.mark.parametrize("shape", [(1,), (2, 1), (4,), ()])
def test_discrete_actions_of_the_wrong_shape_are_refused(shape: tuple[int, ...]) -> None:
    env = MujocoVecEnv(functions("GaeCartPole-v0", 2), 1)
    env.reset()
    with pytest.raises(ValueError, match=r"`actions` must have shape \(2,\), got"):
        env.step(np.zeros(shape, int))


def test_closing_twice_does_no_harm() -> None:
    env = MujocoVecEnv(functions("GaeBiped-v0", 2), 2)
    env.reset()
    env.close()
    env.close()


def test_pictures_show_the_present_state() -> None:
    code = """
        import numpy as np
        import gymnasium as gym
        from stable_baselines3.common.vec_env import DummyVecEnv
        from sb3_gae import MujocoVecEnv

        make = lambda: gym.make("GaeBiped-v0", render_mode="rgb_array", width=64, height=48)
        pictures = []
        for env in (MujocoVecEnv([make] * 2, 1), DummyVecEnv([make] * 2)):
            env.seed(0)
            env.reset()
            first = env.get_images()
            for _ in range(10):
                env.step(np.full((2, 10), 0.9, np.float32))
            pictures += [first, env.get_images(), [env.render()]]
            env.close()
        print(*pictures[1][0].shape, *pictures[2][0].shape)
        print(*(np.array_equal(a, b) for i in range(3) for a, b in zip(pictures[i], pictures[3 + i], strict=True)))
        print(not np.array_equal(pictures[0][0], pictures[1][0]), pictures[1][0].std() > 5)
        """
    assert run_headless(code) == [*("48", "64", "3"), *("96", "64", "3"), *["True"] * 5, "True", "True"]


def test_there_are_no_pictures_without_a_render_mode() -> None:
    env = MujocoVecEnv(functions("GaeBiped-v0", 2), 1)
    with pytest.warns(UserWarning, match="render mode is None"):
        assert env.get_images() == [None, None]
