"""What EnvPool steps, what it does not, and plain refusals of what it cannot do."""

import sys
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from envpool_tasks import functions, pool
from gymnasium.wrappers import ClipAction
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_gae import EnvPoolVecEnv
from sb3_gae.vec_env import batched_vec_env
from sb3_gae.vec_env.envpool_vec_env import can_pool

pytest.importorskip("envpool", reason="an optional extra: pip install 'sb3-gae[fast]'")


def changed(change: Callable[[Any], None]) -> gym.Env:
    env = Monitor(gym.make("HalfCheetah-v5"))
    change(env.unwrapped)
    return env


def with_a_heavy_torso(base: Any) -> None:
    base.model.body_mass[1] *= 2.0


def with_a_reward_of_its_own(base: Any) -> None:
    base.control_cost = lambda action: 0.0


CHOICES: dict[str, tuple[Callable[[], gym.Env], bool]] = {
    "task": (lambda: gym.make("HalfCheetah-v5"), True),
    "monitored task": (lambda: Monitor(gym.make("HalfCheetah-v5")), True),
    "with pictures": (lambda: gym.make("HalfCheetah-v5", render_mode="rgb_array", width=64), True),
    "wrapped task": (lambda: ClipAction(gym.make("HalfCheetah-v5")), False),
    "other arguments": (lambda: gym.make("HalfCheetah-v5", ctrl_cost_weight=0.2), False),
    "changed setting": (lambda: changed(lambda base: setattr(base, "_ctrl_cost_weight", 100.0)), False),
    "changed physics": (lambda: changed(with_a_heavy_torso), False),
    "changed method": (lambda: changed(with_a_reward_of_its_own), False),
    "seeded": (lambda: changed(lambda base: base.reset(seed=3)), True),
    "attribute that the task has not": (lambda: changed(lambda base: setattr(base, "nickname", "Bobby")), True),
    "other version": (lambda: gym.make("HalfCheetah-v4"), False),
    "other environment": (lambda: gym.make("CartPole-v1"), False),
}


@pytest.mark.filterwarnings("ignore:.*out of date")
@pytest.mark.parametrize("what", CHOICES)
def test_tasks_of_gymnasium_as_they_are_registered_are_pooled(what: str) -> None:
    make, pooled = CHOICES[what]
    assert can_pool(make()) is pooled
    assert type(batched_vec_env([make] * 2)) is (EnvPoolVecEnv if pooled else DummyVecEnv)
    if not pooled:
        with pytest.raises(ValueError, match="use DummyVecEnv"):
            EnvPoolVecEnv([make])


def test_without_envpool_all_is_as_it_was(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "envpool", None)
    assert type(batched_vec_env(functions("HalfCheetah-v5", 2))) is DummyVecEnv
    with pytest.raises(ImportError, match=r"sb3-gae\[fast\]"):
        EnvPoolVecEnv(functions("HalfCheetah-v5", 2))


def test_tasks_that_differ_are_refused() -> None:
    different = [lambda: gym.make("Walker2d-v5"), lambda: gym.make("HalfCheetah-v5")]
    assert type(batched_vec_env(different)) is DummyVecEnv
    with pytest.raises(ValueError, match="of one task, got HalfCheetah-v5, Walker2d-v5"):
        EnvPoolVecEnv([lambda: gym.make("HalfCheetah-v5"), lambda: gym.make("Walker2d-v5")])


def test_a_step_before_the_first_reset_is_refused() -> None:
    with pytest.raises(gym.error.ResetNeeded):
        pool("HalfCheetah-v5").step(np.zeros((2, 6)))


def test_actions_of_the_wrong_shape_are_refused() -> None:
    env = pool("HalfCheetah-v5")
    env.reset()
    with pytest.raises(ValueError, match=r"`actions` must have shape \(2, 6\), got \(2, 5\)"):
        env.step(np.zeros((2, 5)))


@pytest.mark.parametrize("name", ["state_vector", "set_state", "reset"])
def test_methods_that_would_need_the_state_are_refused(name: str) -> None:
    env = pool("HalfCheetah-v5")
    env.reset()
    with pytest.raises(NotImplementedError, match=f"'{name}'; use DummyVecEnv"):
        env.env_method(name)


@pytest.mark.parametrize("name", ["data", "state_vector", "set_state", "model", "unwrapped"])
def test_the_state_is_not_shown_where_it_stands_still(name: str) -> None:
    with pytest.raises(NotImplementedError, match=f"'{name}'; use DummyVecEnv"):
        pool("HalfCheetah-v5").get_attr(name)


def test_there_are_no_pictures() -> None:
    with pytest.warns(UserWarning, match="no pictures; use DummyVecEnv"):
        assert pool("HalfCheetah-v5").get_images() == [None, None]


def test_closing_twice_does_no_harm() -> None:
    env = pool("HalfCheetah-v5")
    env.reset()
    env.close()
    env.close()
