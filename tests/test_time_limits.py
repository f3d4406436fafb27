"""Rollouts beside SB3's, in which time limits end episodes."""

from typing import Any

import numpy as np
import pytest
import torch as th
from envs_for_tests import SMALL, AnySpacesEnv, train_once, vec_env_of
from gymnasium.wrappers import TimeLimit
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper

from sb3_gae import TRPOGAE


class NoTerminalObservations(VecEnvWrapper):
    """Does not tell what was seen when a time limit struck."""

    def reset(self) -> Any:
        return self.venv.reset()

    def step_wait(self) -> Any:
        observations, rewards, dones, infos = self.venv.step_wait()
        for info in infos:
            info.pop("terminal_observation", None)
        return observations, rewards, dones, infos


class Endings(BaseCallback):
    """What the environments said at each step."""

    def __init__(self) -> None:
        super().__init__()
        self.rewards: list[np.ndarray] = []
        self.terminal: dict[tuple[int, int], np.ndarray] = {}
        self.terminated: list[tuple[int, int]] = []

    def _on_step(self) -> bool:
        step = len(self.rewards)
        self.rewards.append(self.locals["rewards"].copy())
        for env, (done, info) in enumerate(zip(self.locals["dones"], self.locals["infos"], strict=True)):
            if done and info["TimeLimit.truncated"]:
                self.terminal[step, env] = info["terminal_observation"]
            elif done:
                self.terminated.append((step, env))
        return True


def mixed_endings() -> VecEnv:
    """Episodes terminated and truncated by turns, episodes always cut by a time limit, and episodes never cut by it."""
    return vec_env_of([AnySpacesEnv(), AnySpacesEnv(length=4), TimeLimit(AnySpacesEnv(), 3), TimeLimit(AnySpacesEnv(), 8)])


@pytest.mark.parametrize("policy", ["MlpPolicy", ActorCriticPolicy])
def test_the_buffer_keeps_rewards_endings_and_terminal_values_apart(policy: Any) -> None:
    model = TRPOGAE(policy, mixed_endings(), n_steps=16, policy_kwargs=SMALL, seed=0)
    train_once(model)
    endings = Endings()
    values = {}

    class Values(BaseCallback):
        def _on_step(self) -> bool:
            return True

        def _on_rollout_end(self) -> None:
            for where, observation in endings.terminal.items():
                values[where] = self.model.policy.predict_values(th.as_tensor(observation)[None]).item()

    model.learn(16 * 4, callback=[endings, Values()], reset_num_timesteps=False)
    buffer = model.rollout_buffer
    np.testing.assert_array_equal(buffer.rewards, np.array(endings.rewards))
    assert sorted(zip(*np.nonzero(buffer.truncated), strict=True)) == sorted(endings.terminal)
    assert sorted(zip(*np.nonzero(buffer.terminated), strict=True)) == sorted(endings.terminated)
    assert len(endings.terminal) > 5 and len(endings.terminated) > 3
    for where, value in values.items():
        assert buffer.bootstrap_values[where] == pytest.approx(value, rel=1e-5, abs=1e-6)
    assert np.count_nonzero(buffer.bootstrap_values) == len(values)


def same_rollout(env: Any, **kwargs: Any) -> tuple[TRPOGAE, PPO]:
    """Ours and SB3's, after both collected with the same networks and the same random numbers."""
    settings: dict[str, Any] = {"n_steps": 16, "gamma": 0.9, "gae_lambda": 0.8, "policy_kwargs": SMALL, "seed": 1}

    def collect(model: Any) -> Any:
        model.train = lambda: None
        return model.learn(model.n_steps * model.n_envs)

    # One after the other: the constructor seeds the random numbers that the rollout then uses
    ours = collect(TRPOGAE(ActorCriticPolicy, env(), **settings, **kwargs))
    return ours, collect(PPO("MlpPolicy", env(), batch_size=32, **settings))


@pytest.mark.parametrize("hidden", [False, True], ids=["terminal observations", "no terminal observations"])
def test_a_rollout_is_sb3s_but_for_the_rewards_at_time_limits(hidden: bool) -> None:
    ours, theirs = same_rollout(lambda: NoTerminalObservations(mixed_endings()) if hidden else mixed_endings())
    buffer, expected = ours.rollout_buffer, theirs.rollout_buffer
    for name in ("observations", "actions", "episode_starts"):
        np.testing.assert_array_equal(getattr(buffer, name), getattr(expected, name), err_msg=name)
    for name in ("values", "log_probs", "advantages", "returns"):
        np.testing.assert_allclose(getattr(buffer, name), getattr(expected, name), rtol=1e-4, atol=1e-5, err_msg=name)
    bootstrapped = buffer.rewards + 0.9 * buffer.bootstrap_values
    np.testing.assert_allclose(bootstrapped, expected.rewards, atol=1e-5)
    assert buffer.truncated.any() != hidden
    assert (np.abs(bootstrapped - buffer.rewards) > 1e-3).any() != hidden


def test_value_lambda_changes_the_targets_and_not_the_advantages() -> None:
    ours, theirs = same_rollout(mixed_endings, value_lambda=1.0)
    np.testing.assert_allclose(ours.rollout_buffer.advantages, theirs.rollout_buffer.advantages, rtol=1e-4, atol=1e-5)
    assert np.abs(ours.rollout_buffer.returns - theirs.rollout_buffer.returns).max() > 1e-2
