"""The steps of a rollout, and how they end."""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple, Protocol, cast, runtime_checkable

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.utils import obs_as_tensor
from stable_baselines3.common.vec_env import VecEnv
from torch import nn

from sb3_gae.checks import check_finite_step, is_about_numbers
from sb3_gae.errors import NumericalError
from sb3_gae.networks.dense_policy import gaussian_layers
from sb3_gae.networks.layers import StepNetwork, pair_up
from sb3_gae.rollout.episode_quota import EpisodeQuota
from sb3_gae.rollout.normalized_steps import step_environments

Observations = np.ndarray | dict[str, np.ndarray]


class TerminalObservation(NamedTuple):
    """
    :param step: of the rollout, at the end of which the time limit struck
    :param env: index of the environment
    :param observation: the last one of the episode, without a batch axis
    """

    step: int
    env: int
    observation: Observations


class RolloutEnd(NamedTuple):
    """
    What a rollout leads on to, which is not among its steps.

    :param terminal: where time limits struck
    :param observations: after the last step, shape (N, ...), or a dictionary of such
    :param dones: whether the last step ended an episode, shape (N,)
    """

    terminal: list[TerminalObservation]
    observations: Observations
    dones: np.ndarray


class RolloutPlan(NamedTuple):
    """
    :param n_steps: the most that each environment takes
    :param n_episodes: that each environment finishes; None for all the steps
    :param use_sde: whether the policy explores by gSDE
    :param sde_sample_freq: steps from one noise matrix to the next; -1 for one at the beginning alone
    """

    n_steps: int
    n_episodes: int | None = None
    use_sde: bool = False
    sde_sample_freq: int = -1


class Step(NamedTuple):
    """
    One step of all environments.

    :param observations: what the actions were chosen on, shape (N, ...), or a dictionary of such
    :param episode_starts: whether it was the first step of its episode, shape (N,)
    :param actions: as the distribution gave them, in the shape of the action space, (N, ...)
    :param clipped_actions: as the environments took them
    :param new_observations: what followed, the first ones of new episodes where one ended
    :param rewards: shape (N,)
    :param dones: whether it was the last step of its episode, shape (N,)
    :param infos: of each environment
    :param n_taken: number of environments that took the step
    """

    observations: Observations
    episode_starts: np.ndarray
    actions: np.ndarray
    clipped_actions: np.ndarray
    new_observations: Observations
    rewards: np.ndarray
    dones: np.ndarray
    infos: list[dict[str, Any]]
    n_taken: int


@runtime_checkable
class CollectsRollouts(Protocol):
    """Environments that take the steps of a whole rollout by themselves, such as those on Ray workers."""

    def collect_rollout(self, policy: ActorCriticPolicy, env: VecEnv, plan: RolloutPlan) -> Iterator[Step]:
        """
        :param policy: in evaluation mode
        :param env: these environments in their wrappers
        :param plan: how many steps to take
        :return: the steps as they would have been taken one by one; those of an environment that has finished its episodes
            before others are empty and end no episode
        """


class ActionSampler:
    """
    Draws the actions of the steps of one rollout.

    A Gaussian MLP is asked for its layers, which draws the same actions as the policy itself, to a rounding of their means,
    without making and checking a distribution in each step.

    :param policy: in evaluation mode
    :param first_env: number of the first environment, for messages
    :raises NumericalError: if the exploration has shrunk to nothing
    """

    def __init__(self, policy: ActorCriticPolicy, first_env: int = 0):
        self._policy = policy
        self._first_env = first_env
        self._mean: StepNetwork | None = None
        layers = pair_up(gaussian_layers(policy))
        # A subclass may do more than multiply and add
        if layers and policy.device.type == "cpu" and all(type(linear) is nn.Linear for linear, _ in layers):
            self._mean, self._std = StepNetwork(layers), policy.log_std.detach().exp().numpy()
            if (self._std == 0.0).any():
                raise NumericalError(
                    "The policy's standard deviation is 0 in single precision; there is nothing left to explore."
                )

    def __call__(self, observations: Observations, step: int) -> np.ndarray:
        """
        :param observations: finite, shape (N, ...), or a dictionary of such
        :param step: of the rollout, for messages
        :return: actions as the distribution gives them, in the shape of the action space, (N, ...)
        :raises NumericalError: if an action, or a parameter of the distribution, is not finite
        """
        if self._mean is None:
            actions = self._ask(observations, step)
        else:
            actions = self._mean(observations.astype(np.float32, copy=False))  # type: ignore[union-attr]
            # As torch's Normal draws it
            actions += th.empty(actions.shape).normal_().numpy() * self._std
        actions = actions.reshape(-1, *self._policy.action_space.shape)  # type: ignore[misc]
        check_finite_step("action", actions, step, self._first_env)
        return actions

    def _ask(self, observations: Observations, step: int) -> np.ndarray:
        try:
            with th.no_grad():
                return self._policy._predict(obs_as_tensor(observations, self._policy.device)).cpu().numpy()
        except (ValueError, RuntimeError) as error:
            # A distribution refuses its parameters by the first. Where `torch.compile` has switched that check off for the
            # whole process, drawing from them fails by the second. And so does much else, which is the user's to know of.
            if isinstance(error, ValueError):
                of_distribution = is_about_numbers(error, self._policy.parameters())
            else:
                of_distribution = not self._has_distribution(observations)
            if not of_distribution:
                raise
            raise NumericalError(f"The action distribution is invalid at step {step} of the rollout: {error}") from error

    def _has_distribution(self, observations: Observations) -> bool:
        with th.no_grad():
            entropy = self._policy.get_distribution(obs_as_tensor(observations, self._policy.device)).entropy()
        return entropy is None or bool(entropy.isfinite().all())


def environment_actions(policy: ActorCriticPolicy, actions: np.ndarray) -> np.ndarray:
    """
    :param policy: owner of the action space
    :param actions: as the distribution gave them, in the shape of the action space, (N, ...)
    :return: within the bounds of the action space: scaled if the policy squashes, else clipped
    """
    space = policy.action_space
    if not isinstance(space, spaces.Box):
        return actions
    return policy.unscale_action(actions) if policy.squash_output else np.clip(actions, space.low, space.high)


def take_steps(
    policy: ActorCriticPolicy,
    env: VecEnv,
    observations: Observations,
    episode_starts: np.ndarray,
    plan: RolloutPlan,
    quota: EpisodeQuota,
    first_env: int = 0,
) -> Iterator[Step]:
    """
    The steps of a rollout, each taken when it is asked for.

    :param policy: in evaluation mode
    :param env: to step
    :param observations: of the environments as they stand, shape (N, ...), or a dictionary of such
    :param episode_starts: whether they stand at the beginning of an episode, shape (N,)
    :param plan: how many steps to take
    :param quota: whoever takes the steps adds the endings; the last step is the one that meets it
    :param first_env: number of the first environment, for messages
    :return: at most ``plan.n_steps`` steps of all environments
    :raises NumericalError: if an observation, action or reward is not finite
    """
    if plan.use_sde:
        _reset_noise(policy, env.num_envs)
    sample = ActionSampler(policy, first_env)
    for step in range(plan.n_steps):
        if quota.is_met:
            return
        if plan.use_sde and plan.sde_sample_freq > 0 and step % plan.sde_sample_freq == 0:
            _reset_noise(policy, env.num_envs)
        actions = sample(observations, step)
        clipped_actions = environment_actions(policy, actions)
        result = step_environments(env, clipped_actions)
        new_observations, infos = cast(Observations, result[0]), result[3]
        # Environments of one's own may return lists and floats
        rewards, dones = np.asarray(result[1]), np.asarray(result[2], dtype=bool)
        check_finite_step("reward", rewards, step, first_env)
        check_finite_step("observation", new_observations, step + 1, first_env)
        yield Step(
            observations, episode_starts, actions, clipped_actions, new_observations, rewards, dones, infos, env.num_envs
        )
        observations, episode_starts = new_observations, dones


def _reset_noise(policy: ActorCriticPolicy, n_envs: int) -> None:
    # Nothing differentiates by the noise, and a policy that holds a graph cannot be copied
    with th.no_grad():
        policy.reset_noise(n_envs)


def reported_episodes(dones: np.ndarray, infos: Sequence[dict[str, Any]], counts: np.ndarray | None = None) -> np.ndarray:
    """
    :param dones: whether each environment's episode ended, shape (N,)
    :param infos: of the step
    :param counts: whether the step belongs to the batch, shape (N,); None if all do
    :return: environments whose ``Monitor`` may have an episode to report. A wrapper around it may have hidden that it ended
    """
    if counts is not None:
        return np.flatnonzero(dones & counts)
    if not isinstance(infos, list | tuple):
        # Of a batch, which no wrapper has seen one by one: there looking at an info makes it
        return np.flatnonzero(dones)
    return np.array([env for env, info in enumerate(infos) if dones[env] or "episode" in info], dtype=np.int64)


def terminal_observations(step: int, dones: np.ndarray, infos: list[dict[str, Any]]) -> list[TerminalObservation]:
    """
    :param step: of the rollout
    :param dones: whether each environment's episode ended, shape (N,)
    :param infos: of the step
    :return: those whose episode was cut by a time limit, so that what would have followed counts
    :raises NumericalError: if such an observation is not finite
    """
    endings = [
        TerminalObservation(step, env, infos[env]["terminal_observation"])
        for env in np.flatnonzero(dones).tolist()
        if infos[env].get("TimeLimit.truncated", False) and infos[env].get("terminal_observation") is not None
    ]
    for ending in endings:
        check_finite_step("terminal observation", stacked([ending.observation]), step, ending.env)
    return endings


def stacked(observations: list[Observations]) -> Observations:
    """
    :param observations: of single environments, without a batch axis
    :return: shape (n, ...), or a dictionary of such
    """
    if isinstance(observations[0], dict):
        return {key: np.stack([observation[key] for observation in observations]) for key in observations[0]}
    return np.stack(observations)  # type: ignore[arg-type]
