"""Environments go on from a checkpoint where they were, or begin anew where they cannot say it."""

import warnings
from pathlib import Path
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
import pytest
from envs_for_tests import SMALL
from resuming import STEPS, cart_poles, differences, everything, make_model
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecFrameStack, VecMonitor, VecNormalize

from sb3_gae import TRPOGAE, ResumableCheckpointCallback


def test_an_environment_that_is_built_otherwise_is_refused(checkpoints: Path) -> None:
    with pytest.raises(ValueError, match="`env` must be made as that of the checkpoint, of 1 VecNormalize, 1 DummyVecEnv, 2"):
        TRPOGAE.resume(checkpoints, make_vec_env("CartPole-v1", 2))
    with pytest.raises(ValueError, match="`env` must be made as that"):
        TRPOGAE.resume(checkpoints, VecNormalize(make_vec_env("CartPole-v1", 3)))


@pytest.mark.parametrize("make", [lambda: SubprocVecEnv([lambda: gym.make("CartPole-v1")] * 2), lambda: boxes()])
def test_environments_that_cannot_say_where_they_are_begin_anew(make: Any, tmp_path: Path) -> None:
    def trained_on(resumed: bool) -> TRPOGAE:
        env = VecNormalize(make())
        try:
            if not resumed:
                return make_model(env).learn(2 * STEPS, callback=ResumableCheckpointCallback(1, tmp_path))
            with pytest.warns(UserWarning, match="has no state of the environments.*begin new episodes"):
                model = TRPOGAE.resume(tmp_path, env)
            statistics = everything(model)["obs_rms count"]
            model.learn(STEPS, callback=ResumableCheckpointCallback(1, tmp_path), reset_num_timesteps=False)
            assert everything(model)["obs_rms count"] > statistics > 2 * STEPS
            return model
        finally:
            env.close()

    first = trained_on(False)
    before = everything(first)
    second = trained_on(True)
    assert second.num_timesteps == 3 * STEPS and second._n_updates == 3
    assert before.keys() == everything(second).keys()


def boxes() -> DummyVecEnv:
    """Box2D cannot be pickled."""
    return DummyVecEnv([lambda: gym.make("LunarLander-v3")] * 2)


def test_new_episodes_can_be_asked_for_and_are_not_those_of_the_beginning(checkpoints: Path) -> None:
    model = TRPOGAE.resume(checkpoints, cart_poles(), force_reset=True)
    model.learn(0, reset_num_timesteps=False)
    anew = make_model(cart_poles())
    anew.learn(0)
    assert model.env is not None and anew.env is not None
    one, other = (env.get_original_obs() for env in (model.env, anew.env))  # type: ignore[attr-defined]
    assert not np.array_equal(one, other)
    assert model._last_episode_starts is not None and model._last_episode_starts.all()


@pytest.mark.filterwarnings("ignore:The environment is already wrapped")
def test_wrappers_of_all_kinds_go_on(tmp_path: Path) -> None:
    def make(folder: str) -> VecNormalize:
        (tmp_path / folder).mkdir(exist_ok=True)
        files = iter(range(9))
        one = lambda: Monitor(gym.make("CartPole-v1"), str(tmp_path / folder / str(next(files))))  # noqa: E731
        return VecNormalize(VecFrameStack(VecMonitor(DummyVecEnv([one] * 2)), 3))

    third = make("three")
    whole = make_model(make("one")).learn(4 * STEPS, callback=ResumableCheckpointCallback(1, tmp_path / "a"))
    make_model(make("two")).learn(2 * STEPS, callback=ResumableCheckpointCallback(1, tmp_path / "b"))
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        resumed = TRPOGAE.resume(tmp_path / "b", third)
    resumed.learn(2 * STEPS, reset_num_timesteps=False)
    assert differences(everything(whole), everything(resumed)) == []


class Cart(gym.Wrapper):
    """Speaks for itself."""

    calls: ClassVar[list[str]] = []

    def state_dict(self) -> dict[str, Any]:
        self.calls.append("asked")
        return {"answer": 42}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.calls.append(f"told {state}")


def test_an_environment_can_speak_for_itself(tmp_path: Path) -> None:
    make = lambda: DummyVecEnv([lambda: Cart(gym.make("CartPole-v1"))] * 2)  # noqa: E731
    Cart.calls.clear()
    make_model(make()).learn(STEPS, callback=ResumableCheckpointCallback(1000, tmp_path))
    TRPOGAE.resume(tmp_path, make())
    assert Cart.calls == ["asked"] * 4 + ["told {'answer': 42}"] * 2


def test_an_ordinary_environment_is_wrapped_as_for_a_new_model(tmp_path: Path) -> None:
    kwargs: Any = {"n_steps": 32, "policy_kwargs": SMALL, "seed": 0}
    model = TRPOGAE("MlpPolicy", "CartPole-v1", **kwargs)
    model.learn(32, callback=ResumableCheckpointCallback(1, tmp_path))
    resumed = TRPOGAE.resume(tmp_path, gym.make("CartPole-v1"))
    assert np.array_equal(resumed._last_obs, model._last_obs)  # type: ignore[arg-type]
