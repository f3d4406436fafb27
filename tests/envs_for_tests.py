"""Tiny environments for the tests of the algorithm, and what many of these tests do with a model."""

import copy
import time
from collections.abc import Callable, Iterable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from sb3_gae import TRPOGAE

VECTOR = spaces.Box(-1.0, 1.0, (3,), np.float32)
CHANNEL_FIRST = spaces.Box(0, 255, (1, 36, 36), np.uint8)
ACTIONS = spaces.Box(-1.0, 1.0, (2,), np.float32)

#: networks that take no time
SMALL: dict[str, Any] = {"net_arch": [8]}


class AnySpacesEnv(gym.Env):
    """
    Random observations of any space and a reward for large actions. Actions outside their space are an error.

    Episodes take ``length`` steps and are by turns terminated and truncated.
    """

    def __init__(
        self,
        observation_space: spaces.Space = VECTOR,
        action_space: spaces.Space = ACTIONS,
        length: int = 5,
        reward_scale: float = 1.0,
    ):
        self.observation_space = copy.deepcopy(observation_space)
        self.action_space = copy.deepcopy(action_space)
        self.length = length
        self.reward_scale = reward_scale
        self.steps = 0
        self.episodes = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        if seed is not None:
            self.observation_space.seed(seed)
        self.steps = 0
        self.episodes += 1
        return self.observe(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        assert self.action_space.contains(action), f"{action!r} is not in {self.action_space}"
        self.steps += 1
        over, terminates = self.steps == self.length, self.episodes % 2 == 1
        return self.observe(), self.reward(action), over and terminates, over and not terminates, {}

    def observe(self) -> Any:
        return self.observation_space.sample()

    def reward(self, action: Any) -> float:
        return self.reward_scale * (float(np.mean(action)) + 0.1 * float(self.np_random.normal()))


class Endless(gym.Wrapper):
    """Outside `Monitor`: goes on after an end without a word of it."""

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.env.step(action)
        if terminated or truncated:
            observation, _ = self.env.reset()
        return observation, float(reward), False, False, info


class SlowEnv(AnySpacesEnv):
    """Gives a test the time to kill its process in the middle of a share."""

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        time.sleep(0.01)
        return super().step(action)


class BadNumberEnv(AnySpacesEnv):
    """
    Lets one number go bad.

    :param what: ``"reward"``, ``"observation"``, or the key of an observation
    :param bad: what it becomes
    :param at: after how many steps, counted over all episodes; 0 is the first reset
    """

    def __init__(self, what: str, bad: float, at: int, observation_space: spaces.Space = VECTOR, length: int = 5):
        super().__init__(observation_space, length=length)
        self.what, self.bad, self.at = what, bad, at
        self.total_steps = 0
        self.went_bad = False

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.total_steps += 1
        return super().step(action)

    def reward(self, action: Any) -> float:
        return self.bad if self.what == "reward" and self.total_steps == self.at else super().reward(action)

    def observe(self) -> Any:
        observation = super().observe()
        if self.total_steps == self.at and self.what != "reward" and not self.went_bad:
            # Once: the observation that follows a terminal one after a reset is good
            self.went_bad = True
            (observation[self.what] if isinstance(observation, dict) else observation)[-1] = self.bad
        return observation


def vec_env(make: Callable[[], gym.Env] = AnySpacesEnv, n_envs: int = 2) -> VecEnv:
    """Several environments of one kind."""
    return DummyVecEnv([make] * n_envs)


def vec_env_of(envs: Iterable[gym.Env]) -> VecEnv:
    """These environments."""
    return DummyVecEnv([lambda env=env: env for env in envs])


def train_once(model: OnPolicyAlgorithm, callback: BaseCallback | None = None) -> dict[str, float]:
    """Collect one rollout, train on it, and return what was logged about it."""
    model.learn(model.n_steps * model.n_envs, callback=callback, reset_num_timesteps=False)
    return dict(model.logger.name_to_value)


def state_of(module: th.nn.Module) -> dict[str, th.Tensor]:
    """A copy of everything that a module holds, buffers included."""
    return {name: tensor.detach().clone() for name, tensor in module.state_dict().items()}


def optimizer_state(model: OnPolicyAlgorithm) -> dict[str, th.Tensor]:
    """A copy of what the optimiser remembers."""
    state = model.policy.optimizer.state_dict()["state"]
    return {f"{name} {part}": tensor.clone() for name, parts in state.items() for part, tensor in parts.items()}


def differing(before: dict[str, th.Tensor], after: dict[str, th.Tensor]) -> list[str]:
    """Names of the tensors that are not the same bit for bit."""
    assert before.keys() == after.keys()
    return [name for name in before if not th.equal(before[name], after[name])]


def action_distributions(policy: Any, observations: Any) -> list[th.distributions.Distribution]:
    """The action distribution as torch knows it: one, or one for each action of a MultiDiscrete space."""
    with th.no_grad():
        found = copy.copy(policy.get_distribution(observations)).distribution
    return found if isinstance(found, list) else [found]


def distribution_bits(policy: Any, observations: Any) -> list[th.Tensor]:
    """All numbers that define the action distribution, to be compared bit for bit."""
    return [
        tensor
        for part in action_distributions(policy, observations)
        for tensor in ([part.mean, part.stddev] if isinstance(part, th.distributions.Normal) else [part.logits])
    ]


class KLProbe(BaseCallback):
    """Remembers the policy that collected the last rollout, to measure how far the update went."""

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        self.observations = self.locals["rollout_buffer"].batch().observations
        self.old = action_distributions(self.model.policy, self.observations)

    def kl(self) -> float:
        """Mean divergence of the policy as it is now, summed over action dimensions."""
        new = action_distributions(self.model.policy, self.observations)
        parts = [th.distributions.kl_divergence(p, q) for p, q in zip(self.old, new, strict=True)]
        return float(sum(part.reshape(len(part), -1).sum(dim=1).mean() for part in parts))


def policy_name(observation_space: spaces.Space) -> str:
    if isinstance(observation_space, spaces.Dict):
        return "MultiInputPolicy"
    return "CnnPolicy" if observation_space.dtype == np.uint8 else "MlpPolicy"


def small_model(env: VecEnv, policy: Any = None, **kwargs: Any) -> TRPOGAE:
    kwargs = {"n_steps": 16, "policy_kwargs": SMALL, "seed": 0} | kwargs
    return TRPOGAE(policy or policy_name(env.observation_space), env, **kwargs)


def short_model(env: Any = None, policy: Any = "MlpPolicy", **kwargs: Any) -> TRPOGAE:
    """Its rollouts have 8 steps."""
    return small_model(env or vec_env(), policy, **({"n_steps": 8} | kwargs))


def check_training(model: TRPOGAE, iterations: int = 2) -> None:
    """Each update moves the policy, by as much as is logged and no more than allowed, and actions lie in their space."""
    for _ in range(iterations):
        probe = KLProbe()
        logged = train_once(model, probe)
        assert logged["train/is_line_search_success"] == 1.0
        assert 0.0 < logged["train/kl_divergence_loss"] <= model.target_kl
        assert probe.kl() == pytest.approx(logged["train/kl_divergence_loss"], rel=1e-3, abs=1e-6)
        assert logged["train/vf_steps"] >= 1
        assert logged["train/vf_kl_divergence"] <= model.vf_trust_region
    trained = [parameter for parameter in model.policy.parameters() if parameter.requires_grad]
    assert all(tensor.isfinite().all() for tensor in (*trained, *model.policy.buffers()))
    observations = model.get_env().reset()
    for deterministic in (True, False):
        actions, _ = model.predict(observations, deterministic=deterministic)
        assert len(actions) == model.n_envs
        assert all(model.action_space.contains(action) for action in actions)
