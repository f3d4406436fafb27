"""Trust-region policy optimization with generalized advantage estimation."""

from collections.abc import Callable
from typing import Any, ClassVar, Self, cast

import torch as th
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule
from torch.nn.attention import SDPBackend, sdpa_kernel

from sb3_gae.batch import TrainingBatch, random_subset, standardized
from sb3_gae.borrowed_distribution import borrowed_distribution
from sb3_gae.hyperparameters import check_batch, check_hyperparameters, warn_of_unused
from sb3_gae.lambda_rules import LambdaRule
from sb3_gae.networks.policies import CnnPolicy, MlpPolicy, MultiInputPolicy, SharedMlpPolicy
from sb3_gae.on_policy_algorithm import GAEOnPolicyAlgorithm
from sb3_gae.rollout.evaluation import precision_of, training_batch
from sb3_gae.saving.portable_model import PortableModel
from sb3_gae.saving.resumable import ResumableModel
from sb3_gae.update.adam_fit import adam_fit
from sb3_gae.update.all_or_nothing import all_or_nothing
from sb3_gae.update.policy_step import policy_parameters, policy_step
from sb3_gae.update.shared_parameters import ParameterGroups, SharedParameters, policy_step_radius, shared_parameters
from sb3_gae.update.summary import update_summary
from sb3_gae.update.trust_region import StepRecord, TrustRegionSettings
from sb3_gae.update.value_step import ValueFitRecord, automatic_damping, value_parameters, value_steps
from sb3_gae.workers.ray_vec_env import env_on_workers


class TRPOGAE(ResumableModel, PortableModel, GAEOnPolicyAlgorithm):
    r"""
    Trust-region policy optimization with generalized advantage estimation and a trust-region value function.

    Paper: https://arxiv.org/abs/1506.02438 (Schulman et al., 2016)

    A drop-in for sb3-contrib's ``TRPO``: arguments of the same name mean the same, with one exception.
    ``target_kl`` bounds the divergence summed over action dimensions, as the paper has it, where sb3-contrib
    takes the mean over them. Each iteration computes the advantages with the value function that the rollout was
    collected with, then steps the policy, and fits the value function last.

    :param policy: ``MlpPolicy``, ``SharedMlpPolicy``, ``CnnPolicy``, ``MultiInputPolicy``, or a class
    :param env: the environment to learn from (if registered in Gym, can be str)
    :param learning_rate: of Adam; read only with ``vf_optimizer="adam"`` (default: 1e-3)
    :param n_steps: steps of each environment in a rollout; the batch is ``n_steps * n_envs``
    :param batch_size: of Adam's minibatches; read only with ``vf_optimizer="adam"`` (default: 128)
    :param gamma: discount factor
    :param cg_max_steps: largest number of conjugate-gradient steps for the policy
    :param cg_damping: added to the diagonal of the Fisher matrix while solving for the direction
    :param line_search_shrinking_factor: each further trial of a step is this times as long
    :param line_search_max_iter: largest number of trials
    :param n_critic_updates: Adam's epochs; read only with ``vf_optimizer="adam"`` (default: 10)
    :param gae_lambda: :math:`\lambda` of the advantages: 0 trusts the value function, 1 the returns. A function of the
        remaining progress for a schedule; ``"auto"`` to choose it by what rollouts show of the policy gradient's
        squared error (:class:`~sb3_gae.lambda_rules.MeasuredLambda`); ``"improvement"`` and ``"explained_variance"`` for rules
        that this is to be compared with; or a rule of :mod:`sb3_gae.lambda_rules`. The attribute ``gae_lambda`` is always
        the number in use
    :param use_sde: whether to use generalized state-dependent exploration
    :param sde_sample_freq: sample a new noise matrix every so many steps; -1 only at the start of a rollout
    :param rollout_buffer_class: a subclass of :class:`~sb3_gae.GAERolloutBuffer`; None to choose by the observations
    :param rollout_buffer_kwargs: passed to the rollout buffer
    :param normalize_advantage: whether to shift and scale the advantages of a batch to mean 0 and deviation 1
    :param target_kl: largest mean KL divergence of a policy step, in nats
    :param sub_sampling_factor: the policy step uses one in this many samples, drawn at random
    :param stats_window_size: episodes to average in the logs
    :param tensorboard_log: directory for TensorBoard (None: no logging)
    :param policy_kwargs: passed to the policy; :data:`~sb3_gae.presets.LOCOMOTION_NETWORKS` and
        :data:`~sb3_gae.presets.CARTPOLE_NETWORKS` are those of the paper
    :param verbose: 0 no output, 1 info, 2 debug
    :param seed: for the pseudo-random generators
    :param device: on which to run
    :param value_lambda: :math:`\lambda` of the value targets; 1 gives the paper's Monte-Carlo returns,
        None the same as ``gae_lambda``, or what its rule says
    :param vf_trust_region: largest mean of :math:`(V - V_{old})^2 / 2\sigma^2` in a value step: the paper's
        :math:`\epsilon`, where :math:`\sigma^2` is the mean squared error before the step. No units
    :param vf_steps: largest number of value steps a rollout
    :param vf_cg_max_steps: largest number of conjugate-gradient steps for a value step
    :param vf_cg_damping: added to the diagonal of the Gauss-Newton matrix while solving, in units of :math:`\sigma^2` before
        the first step of a batch; the larger, the less of the batch's noise is fitted. ``"auto"`` for
        600 over the number of samples (:func:`~sb3_gae.update.value_step.automatic_damping`)
    :param vf_kl_fraction: part of ``target_kl`` by which the value fit of an iteration may move the policy, through
        parameters that both depend on. The policy step then keeps to :math:`(1 - \sqrt f)^2` of ``target_kl``, so that both
        together stay about within it. 0 leaves these parameters to the policy step alone, and without such parameters the
        argument has no effect
    :param cg_tolerance: conjugate gradient ends when a step adds less than this part of what all have added,
        for policy and value function; 0 runs to the largest number of steps or to convergence
    :param vf_optimizer: ``"trust_region"``, or ``"adam"`` for the fit of sb3-contrib's TRPO, which reads no other ``vf_``
        argument
    :param normalize_value: whether the value network's outputs are in units of a running scale of the returns
    :param curvature_samples: largest number of samples that curvature products use, drawn at random; None for all.
        Gradients, objectives and constraints use every sample, but for the policy step's with ``sub_sampling_factor``
    :param n_episodes: collect this many whole episodes of each environment, as the paper does for cart-pole, and use the
        steps of no others; ``n_steps`` is then the most that an environment takes, and should cover the longest
        episodes. None for batches of ``n_steps`` steps
    :param baseline: what advantages are measured against: ``"value"``, the value function, or ``"time"``, the mean return at
        each timestep over the batch's episodes, which is the paper's comparison without a value function (section 6.1).
        With the latter there is no value fit, and ``gae_lambda`` and ``value_lambda`` have no effect
    :param value_fit_first: whether to fit the value function before the policy step and compute the advantages anew, the
        order that the paper warns of (section 5); for comparison
    :param rollout_workers: number of Ray workers that collect the batch, each its share, see
        :class:`~sb3_gae.RayVecEnv`. ``env`` is then an id, a function that makes an environment or a ``VecEnv``, of which each
        worker has one, or a :class:`~sb3_gae.RayVecEnv`. None to collect in this process
    :param foreign_arguments: arguments of PPO and A2C that have no meaning here; each warns and says what to use
    :raises ValueError: if an argument is outside its domain
    :raises TypeError: if an argument is unknown, or the rollout buffer is of another kind
    :raises ImportError: if there is no Ray for ``rollout_workers``
    :raises WorkersLostError: if the workers cannot be started
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": MlpPolicy,
        "CnnPolicy": CnnPolicy,
        "MultiInputPolicy": MultiInputPolicy,
        "SharedMlpPolicy": SharedMlpPolicy,
    }

    def __init__(
        self,
        policy: str | type[ActorCriticPolicy],
        env: GymEnv | str | Callable[[], GymEnv],
        learning_rate: float | Schedule | None = None,
        n_steps: int = 2048,
        batch_size: int | None = None,
        gamma: float = 0.99,
        cg_max_steps: int = 10,
        cg_damping: float = 0.1,
        line_search_shrinking_factor: float = 0.8,
        line_search_max_iter: int = 10,
        n_critic_updates: int | None = None,
        gae_lambda: float | str | Callable[[float], float] | LambdaRule = 0.95,
        use_sde: bool = False,
        sde_sample_freq: int = -1,
        rollout_buffer_class: type[RolloutBuffer] | None = None,
        rollout_buffer_kwargs: dict[str, Any] | None = None,
        normalize_advantage: bool = True,
        target_kl: float = 0.01,
        sub_sampling_factor: int = 1,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        _init_setup_model: bool = True,
        *,
        value_lambda: float | None = None,
        vf_trust_region: float = 0.2,
        vf_steps: int = 5,
        vf_cg_max_steps: int = 10,
        vf_cg_damping: float | str = "auto",
        vf_kl_fraction: float = 0.0,
        cg_tolerance: float = 0.1,
        vf_optimizer: str = "trust_region",
        normalize_value: bool = True,
        curvature_samples: int | None = 8_192,
        n_episodes: int | None = None,
        baseline: str = "value",
        value_fit_first: bool = False,
        rollout_workers: int | None = None,
        **foreign_arguments: Any,
    ):
        # Before anything is started: an unknown argument is an error
        adam_arguments = {"learning_rate": learning_rate, "batch_size": batch_size, "n_critic_updates": n_critic_updates}
        warn_of_unused(adam_arguments, vf_optimizer, foreign_arguments)
        if rollout_workers is not None:
            env = env_on_workers(env, rollout_workers)
        super().__init__(
            policy,
            cast(GymEnv | str, env),
            learning_rate=1e-3 if learning_rate is None else learning_rate,
            n_steps=n_steps,
            gamma=gamma,
            gae_lambda=gae_lambda,
            value_lambda=value_lambda,
            normalize_value=normalize_value,
            n_episodes=n_episodes,
            baseline=baseline,
            use_sde=use_sde,
            sde_sample_freq=sde_sample_freq,
            rollout_buffer_class=rollout_buffer_class,
            rollout_buffer_kwargs=rollout_buffer_kwargs,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            policy_kwargs=policy_kwargs,
            verbose=verbose,
            seed=seed,
            device=device,
        )
        self.batch_size = 128 if batch_size is None else batch_size
        self.n_critic_updates = 10 if n_critic_updates is None else n_critic_updates
        self.cg_max_steps = cg_max_steps
        self.cg_damping = cg_damping
        self.line_search_shrinking_factor = line_search_shrinking_factor
        self.line_search_max_iter = line_search_max_iter
        self.normalize_advantage = normalize_advantage
        self.target_kl = target_kl
        self.sub_sampling_factor = sub_sampling_factor
        self.vf_trust_region = vf_trust_region
        self.vf_steps = vf_steps
        self.vf_cg_max_steps = vf_cg_max_steps
        self.vf_cg_damping = vf_cg_damping
        self.vf_kl_fraction = vf_kl_fraction
        self.cg_tolerance = cg_tolerance
        self.vf_optimizer = vf_optimizer
        self.curvature_samples = curvature_samples
        self.value_fit_first = value_fit_first
        if _init_setup_model:
            self._setup_model()
            self._check_batch()

    def _setup_model(self) -> None:
        super()._setup_model()
        if not any(parameter.requires_grad for parameter in self.policy.parameters()):
            raise ValueError("The policy has no trainable parameters; give it layers, or unfreeze them.")

    def _check_arguments(self) -> None:
        check_hyperparameters(vars(self))

    def _check_batch(self) -> None:
        # Not where a model is loaded: whoever only watches it may do so in a single environment
        check_batch(self.n_steps, self.n_envs, self.sub_sampling_factor, self.n_episodes)

    def _maybe_recommend_cpu(self, mlp_class_name: str = "MlpPolicy") -> None:
        # SB3's own default is the name of its class, which no policy of ours has
        super()._maybe_recommend_cpu(mlp_class_name)

    def train(self) -> None:
        """
        Update policy and value function from the rollout buffer: the policy first, the value function last.

        The paper's reason (section 5): a value function fitted first would overfit the batch, and take the
        residuals and with them the policy's gradient towards zero. ``value_fit_first`` shows it.

        If anything goes wrong, policy and optimiser are left as they were before the call.

        :raises NumericalError: if a gradient or a curvature product is not finite, or the linear algebra breaks down
        :raises ValueError: if the action distribution depends on no trainable parameter
        """
        # Evaluation mode: the line search must compare one function, and batch statistics would move at each trial
        self.policy.set_training_mode(False)
        self._update_learning_rate(self.policy.optimizer)
        batch = self._training_batch()
        parameters = self._parameter_groups(batch)
        if not parameters.of_policy:
            raise ValueError("The action distribution depends on no trainable parameter; give the policy layers.")
        # Attention's fused kernels have no second derivative
        with all_or_nothing(self.policy), borrowed_distribution(self.policy), sdpa_kernel(SDPBackend.MATH):
            if self.value_fit_first:
                value_record = self._fit_value(batch, parameters)
                self._estimate_advantages(self.rollout_buffer)
                policy_record = self._step_policy(self._training_batch(), parameters)
            else:
                policy_record = self._step_policy(batch, parameters)
                value_record = self._fit_value(batch, parameters)
        self._n_updates += 1
        self._log_update(policy_record, value_record, batch.value_targets)

    def _training_batch(self) -> TrainingBatch:
        return training_batch(self.rollout_buffer, self.action_space, precision_of(self.policy))

    def _parameter_groups(self, batch: TrainingBatch) -> ParameterGroups:
        of_policy = policy_parameters(self.policy, batch)
        of_both = shared_parameters(self.policy, batch, of_policy) if self.vf_kl_fraction > 0.0 else []
        return ParameterGroups(of_policy, value_parameters(self.policy, batch, of_policy), of_both)

    def _step_policy(self, batch: TrainingBatch, parameters: ParameterGroups) -> StepRecord:
        advantages = standardized(batch.advantages) if self.normalize_advantage else batch.advantages
        n_samples = max(2, len(batch) // self.sub_sampling_factor)
        if (subset := random_subset(len(batch), n_samples, self.device)) is not None:
            batch, advantages = batch.take(subset), advantages[subset]
        settings = TrustRegionSettings(
            radius=policy_step_radius(self.target_kl, self.vf_kl_fraction) if parameters.of_both else self.target_kl,
            cg_max_steps=self.cg_max_steps,
            cg_damping=self.cg_damping,
            cg_progress_tolerance=self.cg_tolerance,
            shrinking_factor=self.line_search_shrinking_factor,
            max_trials=self.line_search_max_iter,
        )
        curvature_subset = random_subset(len(batch), self.curvature_samples, self.device)
        return policy_step(self.policy, parameters.of_policy, batch, advantages, settings, curvature_subset)

    def _fit_value(self, batch: TrainingBatch, parameters: ParameterGroups) -> ValueFitRecord:
        if self.baseline == "time":
            values = th.as_tensor(self.rollout_buffer.values[self.rollout_buffer.mask])
            return ValueFitRecord([], values, values)
        head = self._value_head()
        # A head that the policy depends on as well keeps its bits
        movable = {id(parameter) for parameter in parameters.of_value}
        if head is not None and all(id(parameter) in movable for parameter in head.parameters()):
            head.update_scale(batch.value_targets)
        if self.vf_optimizer == "adam":
            return adam_fit(self.policy, parameters.of_value, self.rollout_buffer, self.n_critic_updates, self.batch_size)
        damping = self.vf_cg_damping
        settings = TrustRegionSettings(
            radius=self.vf_trust_region,
            cg_max_steps=self.vf_cg_max_steps,
            cg_damping=automatic_damping(len(batch)) if isinstance(damping, str) else damping,
            cg_progress_tolerance=self.cg_tolerance,
            shrinking_factor=self.line_search_shrinking_factor,
            max_trials=self.line_search_max_iter,
            max_scale=1.0,
        )
        curvature_subset = random_subset(len(batch), self.curvature_samples, self.device)
        limit = self.vf_kl_fraction * self.target_kl
        shared = SharedParameters(self.policy, parameters, batch, limit, curvature_subset) if parameters.of_both else None
        return value_steps(self.policy, parameters.of_value, batch, settings, self.vf_steps, curvature_subset, shared)

    def _log_update(self, policy_record: StepRecord, value_record: ValueFitRecord, value_targets: th.Tensor) -> None:
        for name, value in update_summary(policy_record, value_record, value_targets).items():
            self.logger.record(f"train/{name}", value)
        if (head := self._value_head()) is not None:
            self.logger.record("train/value_scale", head.scale.item())
        if hasattr(self.policy, "log_std"):
            self.logger.record("train/std", th.exp(self.policy.log_std).mean().item())
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")

    def learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 1,
        tb_log_name: str = "TRPOGAE",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> Self:
        """
        Learn, one rollout and one update after the other.

        :param total_timesteps: steps of all environments together; the rollout that reaches them is the last
        :param callback: called at each step, and at the beginning and the end of each rollout
        :param log_interval: iterations from one log to the next
        :param tb_log_name: of the run in TensorBoard
        :param reset_num_timesteps: whether the steps are counted from 0; False to go on with a training
        :param progress_bar: whether to show one, for which tqdm and rich must be installed
        :return: this model
        :raises NumericalError: if a number that must be finite is not, or the linear algebra breaks down; policy and optimiser
            are then as they were after the last update
        :raises ValueError: if an attribute has been set to what the constructor refuses, a schedule or rule of
            ``gae_lambda`` leaves [0, 1], the action distribution depends on no trainable parameter, or the environments are
            too few for a batch
        :raises WorkersLostError: if workers are gone and cannot be replaced; the message says how to go on
        """
        # Attributes may have been set since
        self._check_arguments()
        self._check_batch()
        return super().learn(total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar)
