"""Environments stepped in a batch: the same numbers as one at a time, and all that SB3 expects of a ``VecEnv``."""

import math
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from envs_for_tests import differing, small_model, state_of, train_once
from gymnasium import spaces
from gymnasium.wrappers import ClipAction, TimeLimit
from headless import run_headless
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor, load_results
from stable_baselines3.common.vec_env import DummyVecEnv, VecCheckNan, VecEnv, VecFrameStack, VecMonitor, VecNormalize

from sb3_gae import TRPOGAE, MujocoVecEnv
from sb3_gae.envs import TASKS, MujocoTask, MujocoTaskEnv, PhysicsStates
from sb3_gae.envs.cart_pole import GaeCartPoleEnv
from sb3_gae.vec_env import StepInfos
from sb3_gae.vec_env.choice import batched_vec_env
from sb3_gae.vec_env.mujoco_vec_env import can_batch

EnvFns = list[Callable[[], gym.Env]]

# Under these a few random steps end an episode, which only the time limit would cut else
EARLY_ENDS: dict[str, dict[str, float]] = {
    "GaeCartPole-v0": {"largest_angle": 0.1},
    "GaeBiped-v0": {"lowest_height": 1.395},
    "GaeQuadruped-v0": {"lowest_height": 0.563},
    "GaeBipedStandup-v0": {},
}

every_task = pytest.mark.parametrize("task_id", TASKS)


def functions(task_id: str, n_envs: int, max_episode_steps: int = 12, **kwargs: Any) -> EnvFns:
    """As ``make_vec_env`` has them."""
    return [lambda: Monitor(gym.make(task_id, max_episode_steps=max_episode_steps, **kwargs))] * n_envs


def both(env_fns: EnvFns, n_threads: int | None = 1) -> tuple[MujocoVecEnv, DummyVecEnv]:
    """The batched environments and SB3's."""
    return MujocoVecEnv(env_fns, n_threads), DummyVecEnv(env_fns)


def random_actions(env: VecEnv, rng: np.random.Generator) -> np.ndarray:
    """Of the whole space, and a little beyond."""
    if isinstance(env.action_space, spaces.Discrete):
        return rng.integers(env.action_space.n, size=env.num_envs)
    return rng.uniform(-1.3, 1.3, (env.num_envs, *env.action_space.shape)).astype(np.float32)


def assert_same_info(found: dict[str, Any], expected: dict[str, Any]) -> None:
    """But for the time of day."""
    assert found.keys() == expected.keys()
    for key, value in expected.items():
        if key == "episode":
            assert {**found[key], "t": 0} == {**value, "t": 0}
        elif key == "terminal_observation":
            np.testing.assert_array_equal(found[key], value)
        else:
            assert found[key] == value, key
            assert type(found[key]) is type(value), key


def assert_same_step(found: Any, expected: Any) -> None:
    """Bit for bit."""
    for batched, single in zip(found[:3], expected[:3], strict=True):
        assert batched.dtype == single.dtype
        np.testing.assert_array_equal(batched, single)
    for batched, single in zip(found[3], expected[3], strict=True):
        assert_same_info(batched, single)


def assert_same_trajectories(batched: VecEnv, dummy: VecEnv, n_steps: int, seed: int = 0) -> list[str]:
    """
    Step both with the same actions.

    :return: how episodes ended
    """
    rng, endings = np.random.default_rng(seed), []
    for env in (batched, dummy):
        env.seed(seed)
    np.testing.assert_array_equal(batched.reset(), dummy.reset())
    for _ in range(n_steps):
        actions = random_actions(dummy, rng)
        expected = dummy.step(actions)
        assert_same_step(batched.step(actions), expected)
        done = [info["TimeLimit.truncated"] for info, over in zip(expected[3], expected[2], strict=True) if over]
        endings += ["truncated" if truncated else "terminated" for truncated in done]
    return endings


# The same as one at a time


@every_task
@pytest.mark.parametrize(("n_envs", "n_threads"), [(1, 1), (2, 1), (3, 2), (5, 2), (8, 3)])
def test_trajectories_are_those_of_single_environments(task_id: str, n_envs: int, n_threads: int) -> None:
    batched, dummy = both(functions(task_id, n_envs), n_threads)
    assert "truncated" in assert_same_trajectories(batched, dummy, n_steps=40)
    if EARLY_ENDS[task_id]:
        batched, dummy = both(functions(task_id, n_envs, **EARLY_ENDS[task_id]), n_threads)
        assert "terminated" in assert_same_trajectories(batched, dummy, n_steps=40)


@settings(max_examples=10)
@given(
    task_id=st.sampled_from(list(TASKS)),
    n_envs=st.integers(1, 6),
    n_threads=st.sampled_from([None, 1, 2, 4, 9]),
    max_episode_steps=st.integers(1, 9),
    seed=st.integers(0, 2**32 - 1),
)
def test_trajectories_are_the_same_whatever_the_sizes(
    task_id: str, n_envs: int, n_threads: int | None, max_episode_steps: int, seed: int
) -> None:
    environments = both(functions(task_id, n_envs, max_episode_steps), n_threads)
    assert len(assert_same_trajectories(*environments, n_steps=10, seed=seed)) >= n_envs


@every_task
def test_the_number_of_threads_changes_nothing(task_id: str) -> None:
    env_fns = functions(task_id, 7)
    assert assert_same_trajectories(MujocoVecEnv(env_fns, 1), MujocoVecEnv(env_fns, 4), n_steps=30)


@every_task
def test_environments_without_wrappers_never_end_by_time(task_id: str) -> None:
    never = {"largest_angle": math.inf, "largest_position": math.inf} if task_id == "GaeCartPole-v0" else {}
    batched, dummy = both([lambda: gym.make(task_id, **never).unwrapped] * 2)
    assert_same_trajectories(batched, dummy, n_steps=30)


def test_the_shortest_of_several_time_limits_counts() -> None:
    for outer, inner in ((4, 9), (9, 4)):

        def make(outer: int = outer, inner: int = inner) -> gym.Env:
            return Monitor(TimeLimit(gym.make("GaeBiped-v0", max_episode_steps=inner), outer))

        assert assert_same_trajectories(*both([make] * 2), n_steps=20) == ["truncated"] * 10


# A task of one's own

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


@pytest.fixture
def pendulum(tmp_path: Path) -> Path:
    path = tmp_path / "pendulum.xml"
    path.write_text(PENDULUM)
    return path


def pendulums(path: Path, n_envs: int, **kwargs: Any) -> EnvFns:
    return [lambda: Monitor(TimeLimit(MujocoTaskEnv(PendulumTask(path, **kwargs)), 10))] * n_envs


@pytest.mark.parametrize("frame_skip", [1, 2, 5])
@pytest.mark.parametrize("n_threads", [1, 2])
def test_a_task_of_one_s_own_with_several_physics_steps_in_a_step(pendulum: Path, frame_skip: int, n_threads: int) -> None:
    batched, dummy = both(pendulums(pendulum, 4, frame_skip=frame_skip), n_threads)
    assert batched.get_attr("dt") == [pytest.approx(0.005 * frame_skip)] * 4
    assert set(assert_same_trajectories(batched, dummy, n_steps=40)) == {"terminated", "truncated"}


def test_what_was_returned_is_not_changed_by_later_steps(pendulum: Path) -> None:
    batched, dummy = both(pendulums(pendulum, 3))
    rng = np.random.default_rng(0)
    steps = []
    for env in (batched, dummy):
        env.seed(0)
        env.reset()
    for _ in range(15):
        actions = random_actions(dummy, rng)
        steps.append((batched.step(actions), dummy.step(actions)))
    assert any(expected[2].any() for _, expected in steps)
    # Only now are the infos made
    for found, expected in steps:
        assert_same_step(found, expected)


def test_actions_may_be_changed_between_the_halves_of_a_step() -> None:
    one, other = (MujocoVecEnv(functions("GaeBiped-v0", 2), 1) for _ in range(2))
    actions = np.full((2, 10), 0.5, np.float32)
    for env in (one, other):
        env.seed(0)
        env.reset()
    one.step_async(actions)
    actions[:] = -1.0
    np.testing.assert_array_equal(one.step_wait()[0], other.step(np.full((2, 10), 0.5, np.float32))[0])


# The contract of a VecEnv


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


# Monitor files


def test_monitor_files_are_the_same(tmp_path: Path) -> None:
    tables = []
    for name, vec_env_cls in (("batched", MujocoVecEnv), ("dummy", DummyVecEnv)):
        env = make_vec_env(
            "GaeCartPole-v0",
            n_envs=3,
            seed=4,
            vec_env_cls=vec_env_cls,
            monitor_dir=str(tmp_path / name),
            monitor_kwargs={"info_keywords": ("alive_bonus",)},
        )
        rng = np.random.default_rng(0)
        env.reset()
        for _ in range(80):
            env.step(random_actions(env, rng))
        assert sum(map(len, (monitor.get_episode_rewards() for monitor in env.envs))) > 3
        env.close()
        tables.append([load_results_of(file) for file in sorted((tmp_path / name).iterdir())])
        assert len(load_results(str(tmp_path / name))) == sum(map(len, tables[-1]))
    assert len(tables[0]) == 3
    assert tables[0] == tables[1]


def load_results_of(file: Path) -> list[list[str]]:
    """Rows of a monitor file without the times."""
    _, columns, *rows = file.read_text().splitlines()
    assert columns == "r,l,t,alive_bonus"
    assert all(float(row.split(",")[2]) > 0.0 for row in rows)
    return [[value for i, value in enumerate(row.split(",")) if i != 2] for row in rows]


def test_monitors_know_their_episodes() -> None:
    batched, dummy = both(functions("GaeQuadruped-v0", 2, **EARLY_ENDS["GaeQuadruped-v0"]))
    assert assert_same_trajectories(batched, dummy, n_steps=40)
    for name in ("get_episode_rewards", "get_episode_lengths"):
        assert batched.env_method(name) == dummy.env_method(name)
    assert all(len(times) > 0 for times in batched.env_method("get_episode_times"))


def test_early_resets_are_refused_where_monitor_refuses_them() -> None:
    env = MujocoVecEnv([lambda: Monitor(gym.make("GaeBiped-v0", max_episode_steps=3), allow_early_resets=False)], 1)
    env.reset()
    for _ in range(7):
        env.step(np.zeros((1, 10)))
    with pytest.raises(RuntimeError, match="early resets"):
        env.reset()


# Numbers that blow up


@pytest.mark.filterwarnings("ignore:The physics of an environment")
def test_a_blow_up_leaves_the_other_environments_untouched(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its warnings to a file
    for task_id in TASKS:
        keyword = "alive_bonus" if task_id != "GaeBipedStandup-v0" else "torque_cost"
        env_fns: EnvFns = [
            lambda task_id=task_id, keyword=keyword: Monitor(gym.make(task_id), info_keywords=(keyword,))  # type: ignore[misc]
        ] * 4
        batched, dummy = both(env_fns, 2)
        untouched = MujocoVecEnv(env_fns, 1)
        for env in (batched, dummy, untouched):
            env.seed(0)
            env.reset()
        nq, nv = batched.task.model.nq, batched.task.model.nv
        for env in (batched, dummy):
            env.env_method("set_state", np.full(nq, 0.5), np.full(nv, 1e11), indices=2)
        rng, others = np.random.default_rng(0), [0, 1, 3]
        for step in range(4):
            actions = random_actions(dummy, rng)
            found, expected = batched.step(actions), untouched.step(actions)
            assert_same_step(found, dummy.step(actions))
            for i in range(3):
                np.testing.assert_array_equal(found[i][others], expected[i][others])
            if step == 0:
                observations, rewards, dones, infos = found
                assert (rewards[2], dones[2]) == (0.0, True)
                assert infos[2]["numerical_failure"] is True
                assert infos[2]["TimeLimit.truncated"] is True
                assert infos[2][keyword] == infos[2]["episode"][keyword] == 0.0
                assert np.isfinite(infos[2]["terminal_observation"]).all()
                assert not any("numerical_failure" in infos[env] for env in others)
                assert np.abs(observations[2]).max() < 10.0, "it begins anew"
        assert batched.numerical_failures == 1


def test_blow_ups_are_counted_and_warned_of_once(pendulum: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    env = MujocoVecEnv(pendulums(pendulum, 3, frame_skip=2, push=1e11), 1)
    env.reset()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for _ in range(5):
            _, rewards, dones, infos = env.step(np.zeros((3, 1)))
            assert dones.all()
            assert not rewards.any()
            assert [info["episode"]["l"] for info in infos] == [1] * 3
    assert env.numerical_failures == 15
    assert [str(warning.message).split(";")[0] for warning in caught] == [
        "The physics of an environment gave numbers that are not finite"
    ]


class SensingPendulumTask(PendulumTask):
    def observations(self, states: PhysicsStates) -> np.ndarray:
        return np.concatenate([states.sensors["angle"], states.qvel], axis=1)


@pytest.mark.filterwarnings("ignore:The physics of an environment")
@pytest.mark.parametrize("frame_skip", [1, 2, 3])
@pytest.mark.parametrize("gear", [3e7, 3e10, 3e13])
def test_a_blow_up_is_the_same_one_at_a_time(
    pendulum: Path, frame_skip: int, gear: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where only an acceleration is too large for MuJoCo, after which a batch takes no more physics steps."""
    monkeypatch.chdir(tmp_path)
    pendulum.write_text(PENDULUM.replace('joint="hinge" ctrl', f'joint="hinge" gear="{gear}" ctrl'))
    env_fns: EnvFns = [lambda: Monitor(TimeLimit(MujocoTaskEnv(SensingPendulumTask(pendulum, frame_skip)), 10))] * 3
    batched, dummy = both(env_fns)
    assert_same_trajectories(batched, dummy, n_steps=12)
    if gear > 1e10 and frame_skip > 1:
        assert batched.numerical_failures > 0


# Refusals, and what to do instead


def test_an_environment_of_another_kind_is_refused() -> None:
    with pytest.raises(ValueError, match=r"MujocoTask, got .*CartPole.*; use DummyVecEnv"):
        MujocoVecEnv([lambda: gym.make("CartPole-v1")])


def test_a_wrapper_that_would_have_to_see_each_step_is_refused() -> None:
    with pytest.raises(ValueError, match="wrapper ClipAction; use DummyVecEnv, or leave it out"):
        MujocoVecEnv([lambda: Monitor(ClipAction(gym.make("GaeBiped-v0")))])


@pytest.mark.parametrize("other", [("GaeQuadruped-v0", {}), ("GaeBiped-v0", {"alive_bonus": 1.0}), ("GaeBipedStandup-v0", {})])
def test_environments_that_differ_are_refused(other: tuple[str, dict[str, float]]) -> None:
    with pytest.raises(ValueError, match="one task with the same arguments"):
        MujocoVecEnv([lambda: gym.make("GaeBiped-v0"), lambda: gym.make(other[0], **other[1])])


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ((1.0,), (2.0,)),
        ([1.0, 2.0], [1.0]),
        (np.array([1.0]), np.array([2.0])),
        (np.float32(1.0), np.float32(2.0)),
        ({"a": 1}, {"a": 2}),
        ({"a": 1}, {"b": 1}),
        (1, 1.5),
        (None, 0),
    ],
)
def test_settings_of_any_kind_are_compared(pendulum: Path, one: Any, other: Any) -> None:
    same = [lambda: MujocoTaskEnv(PendulumTask(pendulum, goal=one))] * 2
    MujocoVecEnv(same)
    different = [*same, lambda: MujocoTaskEnv(PendulumTask(pendulum, goal=other))]
    with pytest.raises(ValueError, match="one task with the same arguments"):
        MujocoVecEnv(different)
    assert type(batched_vec_env(same)) is MujocoVecEnv
    assert type(batched_vec_env(different)) is DummyVecEnv


class MoreReward(GaeCartPoleEnv):
    def step(self, action: Any) -> Any:
        observation, reward, *others = super().step(action)
        return observation, reward + 100.0, *others


class GenerousMonitor(Monitor):
    def step(self, action: Any) -> Any:
        observation, reward, *others = super().step(action)
        return observation, reward + 100.0, *others


class NamedMonitor(Monitor):
    """With steps of its base."""


@pytest.mark.parametrize(
    ("make", "batched"),
    [
        (MoreReward, False),
        (lambda: GenerousMonitor(gym.make("GaeCartPole-v0")), False),
        (lambda: NamedMonitor(gym.make("GaeCartPole-v0")), True),
    ],
)
def test_steps_of_one_s_own_are_not_passed_by(make: Callable[[], gym.Env], batched: bool) -> None:
    env = batched_vec_env([make] * 2)
    assert type(env) is (MujocoVecEnv if batched else DummyVecEnv)
    env.reset()
    assert env.step(np.zeros(2, dtype=int))[1].tolist() == [1.0 if batched else 101.0] * 2
    if not batched:
        with pytest.raises(ValueError, match="use DummyVecEnv"):
            MujocoVecEnv([make])


def test_models_that_differ_are_refused(pendulum: Path) -> None:
    heavier = pendulum.with_name("heavier.xml")
    heavier.write_text(PENDULUM.replace('mass="1"', 'mass="2"'))
    with pytest.raises(ValueError, match="one task with the same arguments"):
        MujocoVecEnv(pendulums(pendulum, 1) + pendulums(heavier, 1))


def test_one_environment_given_twice_is_refused() -> None:
    env = gym.make("GaeBiped-v0")
    for env_fns in ([], [lambda: env] * 2):
        with pytest.raises(ValueError, match="`env_fns` must make at least one environment, and a new one each"):
            MujocoVecEnv(env_fns)


@pytest.mark.parametrize("n_threads", [0, -1])
def test_a_number_of_threads_below_1_is_refused(n_threads: int) -> None:
    with pytest.raises(ValueError, match=f"`n_threads` must be at least 1 or None, got {n_threads}"):
        MujocoVecEnv(functions("GaeBiped-v0", 2), n_threads)


CHOICES: dict[str, tuple[Callable[[], gym.Env], bool]] = {
    "task": (lambda: gym.make("GaeBiped-v0"), True),
    "monitored task": (lambda: Monitor(gym.make("GaeBiped-v0")), True),
    "bare task": (lambda: gym.make("GaeBiped-v0").unwrapped, True),
    "wrapped task": (lambda: ClipAction(gym.make("GaeBiped-v0")), False),
    "other environment": (lambda: gym.make("CartPole-v1"), False),
}


@pytest.mark.parametrize("what", CHOICES)
def test_environments_are_stepped_in_batches_where_that_is_possible(what: str) -> None:
    make, batched = CHOICES[what]
    assert can_batch(make()) is batched
    env = batched_vec_env([make] * 2)
    assert type(env) is (MujocoVecEnv if batched else DummyVecEnv)
    env.reset()
    env.step(np.stack([env.action_space.sample() for _ in range(2)]))


# Training


@pytest.mark.parametrize("task_id", ["GaeCartPole-v0", "GaeQuadruped-v0"])
def test_training_is_the_same_as_on_single_environments(task_id: str) -> None:
    states = []
    for env in both(functions(task_id, 3, **EARLY_ENDS[task_id])):
        model = small_model(VecNormalize(env), n_steps=32)
        train_once(model)
        assert train_once(model)["train/is_line_search_success"] == 1.0
        states.append((state_of(model.policy), [(episode["r"], episode["l"]) for episode in model.ep_info_buffer]))
    assert differing(states[0][0], states[1][0]) == []
    assert len(states[0][1]) > 3
    assert states[0][1] == states[1][1]


def test_models_and_statistics_are_saved_and_loaded(tmp_path: Path) -> None:
    env_fns = functions("GaeBiped-v0", 2)
    env = VecNormalize(MujocoVecEnv(env_fns, 1))
    model = small_model(env)
    train_once(model)
    model.save(tmp_path / "model.zip")
    env.save(str(tmp_path / "statistics.pkl"))

    fresh = VecNormalize.load(str(tmp_path / "statistics.pkl"), MujocoVecEnv(env_fns, 1))
    np.testing.assert_array_equal(fresh.obs_rms.mean, env.obs_rms.mean)
    loaded = TRPOGAE.load(tmp_path / "model.zip", env=fresh)
    observations = fresh.reset()
    for found, expected in zip(loaded.predict(observations), model.predict(observations), strict=True):
        assert found is expected is None or np.shape(found) == np.shape(expected)
    deterministic = [some.predict(observations, deterministic=True)[0] for some in (loaded, model)]
    np.testing.assert_array_equal(*deterministic)
    train_once(loaded)
    assert loaded.num_timesteps > model.num_timesteps


def test_policies_are_evaluated_on_it() -> None:
    results = []
    for env in both(functions("GaeQuadruped-v0", 2)):
        env.seed(0)
        model = small_model(env)
        results.append(evaluate_policy(model, env, n_eval_episodes=3, return_episode_rewards=True))
    assert results[0] == results[1]
    assert results[0][1] == [12] * 3


# Infos


@pytest.fixture
def infos() -> StepInfos:
    return StepInfos(3, {"speed": np.array([1.0, 2.0, 3.0]), "over": np.array([False, True, False])})


def test_infos_read_like_a_list(infos: StepInfos) -> None:
    expected = [{"speed": 1.0, "over": False}, {"speed": 2.0, "over": True}, {"speed": 3.0, "over": False}]
    assert len(infos) == 3
    assert list(infos) == expected
    assert [infos[i] for i in range(-3, 3)] == expected * 2
    assert infos[1:] == expected[1:]
    assert infos[::-1] == expected[::-1]
    assert infos.copy() == expected
    assert list(reversed(infos)) == expected[::-1]
    assert expected[1] in infos
    assert infos.index(expected[2]) == 2
    assert type(infos[0]["speed"]) is float
    assert type(infos[0]["over"]) is bool


@pytest.mark.parametrize("index", [3, -4])
def test_there_are_no_more_infos_than_environments(infos: StepInfos, index: int) -> None:
    with pytest.raises(IndexError):
        infos[index]
    with pytest.raises(IndexError):
        infos[index] = {}


def test_what_is_written_into_infos_is_kept(infos: StepInfos) -> None:
    infos[1]["mark"] = "here"
    infos[-1] = {"new": 1}
    assert infos[1] == {"speed": 2.0, "over": True, "mark": "here"}
    assert infos[2] == {"new": 1}
    assert "mark" not in infos[0]
    assert [info.get("mark") for info in infos] == [None, "here", None]
