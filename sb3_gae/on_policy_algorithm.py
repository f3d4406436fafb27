"""What an algorithm that learns from generalized advantage estimates does before it learns: batches and their advantages."""

import io
import pathlib
import warnings
from collections.abc import Callable, Iterator
from typing import Any, Self, cast

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.type_aliases import GymEnv, Schedule
from stable_baselines3.common.vec_env import VecEnv

from sb3_gae.checks import check_finite_parameters, check_finite_rollout, check_finite_step, check_number
from sb3_gae.lambda_rules import LambdaRule, lambda_rule
from sb3_gae.networks.value_head import ValueHead
from sb3_gae.rollout.collection import (
    CollectsRollouts,
    Observations,
    RolloutEnd,
    RolloutPlan,
    Step,
    TerminalObservation,
    reported_episodes,
    take_steps,
    terminal_observations,
)
from sb3_gae.rollout.episode_quota import EpisodeQuota
from sb3_gae.rollout.evaluation import evaluate_rollout, reward_returns
from sb3_gae.rollout.rollout_buffer import GAEDictRolloutBuffer, GAERolloutBuffer
from sb3_gae.rollout.threads import threads_for_steps
from sb3_gae.rollout.time_baseline import TimeBaseline


class GAEOnPolicyAlgorithm(OnPolicyAlgorithm):
    r"""
    Collects batches, and estimates their values, advantages and value targets. A subclass learns from them in ``train``,
    says in ``_check_arguments`` what it refuses, and calls ``_setup_model`` at the end of its constructor.

    :param policy: a class, or a name of ``policy_aliases``
    :param env: the environment to learn from (if registered in Gym, can be str)
    :param learning_rate: of the policy's optimiser
    :param gae_lambda: :math:`\lambda` of the advantages, or where it comes from, see :class:`~sb3_gae.TRPOGAE`
    :param value_lambda: :math:`\lambda` of the value targets; None the same as ``gae_lambda``, or what its rule says
    :param normalize_value: whether the value network's outputs are in units of a running scale of the returns
    :param n_episodes: whole episodes of each environment in a batch; None for batches of ``n_steps`` steps
    :param baseline: ``"value"``, or ``"time"`` for the mean return at each timestep
    :param arguments: others of SB3's ``OnPolicyAlgorithm``, but for those of its loss, ``supported_action_spaces`` and
        ``_init_setup_model``
    """

    rollout_buffer: GAERolloutBuffer

    def __init__(
        self,
        policy: str | type[ActorCriticPolicy],
        env: GymEnv | str,
        learning_rate: float | Schedule,
        *,
        gae_lambda: float | str | Callable[[float], float] | LambdaRule,
        value_lambda: float | None,
        normalize_value: bool,
        n_episodes: int | None,
        baseline: str,
        **arguments: Any,
    ):
        super().__init__(
            policy,
            env,
            learning_rate,
            gae_lambda=gae_lambda,  # type: ignore[arg-type]
            # No loss adds these up: policy and value function have steps of their own
            ent_coef=0.0,
            vf_coef=0.0,
            max_grad_norm=0.0,
            supported_action_spaces=(spaces.Box, spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary),
            # By the subclass, when it has all its attributes
            _init_setup_model=False,
            **arguments,
        )
        self.value_lambda = value_lambda
        self.normalize_value = normalize_value
        self.n_episodes = n_episodes
        self.baseline = baseline
        self._numerical_failures = 0
        self._time_baseline = TimeBaseline()
        self._lambda_rule: LambdaRule | None = None

    def _setup_model(self) -> None:
        if (rule := lambda_rule(self.gae_lambda)) is not None:
            self._lambda_rule, self.gae_lambda = rule, rule.value(1.0)
        self._check_arguments()
        if self.rollout_buffer_class is None:
            is_dict = isinstance(self.observation_space, spaces.Dict)
            self.rollout_buffer_class = GAEDictRolloutBuffer if is_dict else GAERolloutBuffer
        super()._setup_model()

    def _check_arguments(self) -> None:
        """Refuse attributes that are outside their domains, before the networks are built."""

    def collect_rollouts(  # type: ignore[override]
        self, env: VecEnv, callback: BaseCallback, rollout_buffer: GAERolloutBuffer, n_rollout_steps: int
    ) -> bool:
        """
        Fill the buffer with steps of the current policy, and compute their values and advantages.

        :param env: the training environments
        :param callback: called at each step, and at the beginning and the end
        :param rollout_buffer: to be filled
        :param n_rollout_steps: steps of each environment
        :return: False if the callback ended training before the buffer was full
        :raises NumericalError: if a parameter of the policy, an observation, action, reward or value is not finite
        :raises ValueError: if a schedule or rule of ``gae_lambda`` leaves [0, 1]
        :raises WorkersLostError: if the environments are on workers that are gone and cannot be replaced
        """
        assert self._last_obs is not None and self._last_episode_starts is not None, "No previous observation was provided"
        # First, so that a callback finds everything as the last iteration left it
        callback.on_rollout_start()
        if self._total_timesteps > 0:
            # SB3 does so only after a rollout, and a second `learn` would begin where the first has ended
            self._update_current_progress_remaining(self.num_timesteps, self._total_timesteps)
        quota = EpisodeQuota(env.num_envs, self.n_episodes)
        if self.n_episodes is not None and not self._last_episode_starts.all():
            self._last_obs, self._last_episode_starts = cast(Observations, env.reset()), np.ones(env.num_envs, dtype=bool)
        check_finite_parameters(self.policy)
        check_finite_step("observation", self._last_obs, 0)
        self.policy.set_training_mode(False)
        rollout_buffer.reset()
        with threads_for_steps(self.policy, env.num_envs):
            terminal = self._collect_steps(env, callback, rollout_buffer, n_rollout_steps, quota)
        if terminal is None:
            return False

        if self.n_episodes is not None:
            self._finish_episodes(rollout_buffer, quota)
        self._rollout_end = RolloutEnd(terminal, self._last_obs, self._last_episode_starts)
        if self._lambda_rule is not None:
            self.gae_lambda = self._lambda_rule.value(self._current_progress_remaining)
            check_number("gae_lambda", self.gae_lambda, 0.0, 1.0)
        self._estimate_advantages(rollout_buffer)
        if self._lambda_rule is not None:
            self._learn_lambda(self._lambda_rule, rollout_buffer)
        callback.update_locals(locals())
        callback.on_rollout_end()
        return True

    def _collect_steps(
        self,
        env: VecEnv,
        callback: BaseCallback,
        rollout_buffer: GAERolloutBuffer,
        n_rollout_steps: int,
        quota: EpisodeQuota,
    ) -> list[TerminalObservation] | None:
        """Take the steps of a rollout, and return where time limits struck; nothing if the callback ended training."""
        terminal: list[TerminalObservation] = []
        for n_steps, step in enumerate(self._steps(env, n_rollout_steps, quota)):
            actions, clipped_actions, new_obs = step.actions, step.clipped_actions, step.new_observations
            rewards, dones, infos = step.rewards, step.dones, step.infos
            self.num_timesteps += step.n_taken
            callback.update_locals(locals())
            if not callback.on_step():
                return None

            counts = quota.counts
            truncated = np.zeros(env.num_envs, dtype=bool)
            if (reported := reported_episodes(dones, infos, counts)).size:
                self._update_info_buffer([infos[index] for index in reported.tolist()], dones[reported])
            if dones.any():
                endings = self._record_endings(n_steps, dones, dones if counts is None else dones & counts, infos)
                terminal.extend(endings)
                truncated[[ending.env for ending in endings]] = True
            rollout_buffer.add_step(step.observations, actions, rewards, step.episode_starts, dones, truncated, counts)
            quota.add(dones)
            self._last_obs = new_obs
            self._last_episode_starts = dones
        # For the end of the rollout, when the number of steps is one more
        n_steps = rollout_buffer.pos
        callback.update_locals(locals())
        return terminal

    def _steps(self, env: VecEnv, n_rollout_steps: int, quota: EpisodeQuota) -> Iterator[Step]:
        """Taken here, or collected by environments that do so themselves."""
        assert self._last_obs is not None and self._last_episode_starts is not None
        plan = RolloutPlan(n_rollout_steps, self.n_episodes, self.use_sde, self.sde_sample_freq)
        if isinstance(base := env.unwrapped, CollectsRollouts):
            return base.collect_rollout(self.policy, env, plan)
        return take_steps(self.policy, env, self._last_obs, self._last_episode_starts, plan, quota)

    def _record_endings(
        self, step: int, dones: np.ndarray, counted: np.ndarray, infos: list[dict[str, Any]]
    ) -> list[TerminalObservation]:
        """Log what else is said of ends, and return the episodes of the batch that a time limit ended."""
        self._numerical_failures += sum(bool(infos[index].get("numerical_failure")) for index in np.flatnonzero(dones))
        if self._numerical_failures:
            self.logger.record("rollout/numerical_failures", self._numerical_failures)
        return terminal_observations(step, counted, infos)

    def _learn_lambda(self, rule: LambdaRule, rollout_buffer: GAERolloutBuffer) -> None:
        self.logger.record("gae_lambda/value", self.gae_lambda)
        for name, value in rule.learn_from(self.policy, rollout_buffer).items():
            self.logger.record(f"gae_lambda/{name}", value)

    def _finish_episodes(self, rollout_buffer: GAERolloutBuffer, quota: EpisodeQuota) -> None:
        rollout_buffer.finish()
        if not quota.is_met:
            warnings.warn(
                f"`n_steps` = {self.n_steps} ended before every environment had finished `n_episodes` = {self.n_episodes}; "
                "the last episodes are cut there and their rest is estimated. Raise `n_steps`.",
                stacklevel=2,
            )

    def _estimate_advantages(self, rollout_buffer: GAERolloutBuffer) -> None:
        """Values, advantages and targets of a full buffer, all with the value function as it is now."""
        rollout_buffer.gamma, rollout_buffer.gae_lambda = self.gamma, self.gae_lambda
        rollout_buffer.value_lambda = self.value_lambda
        if self.value_lambda is None and self._lambda_rule is not None:
            rollout_buffer.value_lambda = self._lambda_rule.target_lambda
        if (head := self._value_head()) is not None and head.is_as_constructed:
            head.initialize_scale(rollout_buffer.to_torch(reward_returns(rollout_buffer)))
        last_values = evaluate_rollout(self.policy, rollout_buffer, self._rollout_end)
        if self.baseline == "time":
            # The return less its mean: neither lambda has a part in it
            rollout_buffer.gae_lambda, rollout_buffer.value_lambda = 1.0, None
            last_values = th.as_tensor(self._time_baseline.fill(rollout_buffer, self._rollout_end.dones, self.gamma))
        rollout_buffer.compute_returns_and_advantage(last_values, self._rollout_end.dones)
        check_finite_rollout("advantage", rollout_buffer.advantages)
        check_finite_rollout("value target", rollout_buffer.returns)

    def _value_head(self) -> ValueHead | None:
        """The layer whose scale follows the returns, if it is to and can."""
        head = getattr(self.policy, "value_net", None)
        if not self.normalize_value or self.baseline != "value" or not isinstance(head, ValueHead):
            return None
        # Nor can it follow in weights that are computed from others, as `weight_norm` has them
        is_plain = "weight" in dict(head.named_parameters(recurse=False))
        return head if is_plain and all(parameter.requires_grad for parameter in head.parameters()) else None

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_rollout_end"]

    @classmethod
    def load(
        cls,
        path: str | pathlib.Path | io.BufferedIOBase,
        env: GymEnv | None = None,
        device: th.device | str = "auto",
        custom_objects: dict[str, Any] | None = None,
        print_system_info: bool = False,
        force_reset: bool = True,
        **kwargs: Any,
    ) -> Self:
        if "gae_lambda" in kwargs or "gae_lambda" in (custom_objects or {}):
            # A rule that was saved would overrule it
            kwargs["_lambda_rule"] = None
        return super().load(path, env, device, custom_objects, print_system_info, force_reset, **kwargs)
