"""A run of tianshou: its high-level builders, and its trainer with a function of ours between two updates."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from tianshou.data import Batch
from tianshou.env import BaseVectorEnv, VectorEnvNormObs
from tianshou.highlevel.config import OnPolicyTrainingConfig
from tianshou.highlevel.env import EnvFactoryRegistered, EnvMode, VectorEnvType
from tianshou.highlevel.experiment import ExperimentConfig, NPGExperimentBuilder, TRPOExperimentBuilder
from tianshou.highlevel.params.algorithm_params import NPGParams, TRPOParams
from tianshou.highlevel.params.lr_scheduler import LRSchedulerFactoryFactoryLinear
from tianshou.highlevel.world import World
from tianshou.trainer import OnPolicyTrainerParams
from tianshou.utils.torch_utils import policy_within_training_step

from benchmarks.peers.algorithms import TIANSHOU_TRPO
from benchmarks.peers.clock import TrainingClock
from benchmarks.peers.evaluation import Act
from benchmarks.peers.plan import Cell
from benchmarks.peers.recorder import Recorder


class NormalizedTasks(EnvFactoryRegistered):
    """
    Environments with normalised observations, as the published examples have them.

    One after another in this process: subprocesses are slower where a run has one core.

    :param task: id of the environment
    """

    def __init__(self, task: str):
        super().__init__(task=task, venv_type=VectorEnvType.DUMMY)

    def create_venv(self, num_envs: int, mode: EnvMode, seed: int | None = None) -> BaseVectorEnv:
        return VectorEnvNormObs(super().create_venv(num_envs, mode, seed), update_obs_rms=mode == EnvMode.TRAINING)


def run_in_tianshou(cell: Cell, settings: dict[str, Any], folder: Path, clock: TrainingClock, recorder: Recorder) -> int:
    """
    Train.

    :param cell: of the plan
    :param settings: of the run, from :mod:`~benchmarks.peers.tianshou_settings`
    :param folder: of the run, where nothing is written
    :param clock: of the training
    :param recorder: evaluates
    :return: steps of the training
    """
    config = OnPolicyTrainingConfig(
        # One epoch, as tianshou's own evaluation at the end of each is not of use here; the learning rate falls over it all
        max_epochs=1,
        epoch_num_steps=cell.steps,
        num_test_envs=1,
        **{name: settings[name] for name in _OF_THE_TRAINER},
    )
    world = _world(cell, settings, config, folder)
    act = agent_of(world)
    per_update = config.num_training_envs * math.ceil(settings["collection_step_num_env_steps"] / config.num_training_envs)
    due = 0

    def between_updates(epoch: int, steps: int) -> None:
        nonlocal due
        clock.stop()
        if steps >= due:
            recorder.evaluate(steps, act)
            due = recorder.next_after(steps)
        clock.start()

    assert world.training_collector is not None
    clock.start()
    world.algorithm.run_training(
        OnPolicyTrainerParams(
            training_collector=world.training_collector,
            max_epochs=config.max_epochs,
            epoch_num_steps=config.epoch_num_steps,
            collection_step_num_env_steps=config.collection_step_num_env_steps,
            update_step_num_repetitions=config.update_step_num_repetitions,
            batch_size=config.batch_size,
            training_fn=between_updates,
            show_progress=False,
        )
    )
    clock.stop()
    steps = per_update * math.ceil(cell.steps / per_update)
    recorder.evaluate(steps, act)
    return steps


_OF_THE_TRAINER = (
    "num_training_envs",
    "buffer_size",
    "collection_step_num_env_steps",
    "update_step_num_repetitions",
    "batch_size",
)


def _world(cell: Cell, settings: dict[str, Any], config: OnPolicyTrainingConfig, folder: Path) -> World:
    experiment = ExperimentConfig(
        seed=cell.seed, device="cpu", watch=False, persistence_enabled=False, persistence_base_dir=str(folder)
    )
    params = {**settings["params"], "lr_scheduler": LRSchedulerFactoryFactoryLinear(config), "deterministic_eval": True}
    factory = NormalizedTasks(cell.task)
    builder: Any
    if cell.algorithm == TIANSHOU_TRPO:
        builder = TRPOExperimentBuilder(factory, experiment, config).with_trpo_params(TRPOParams(**params))
    else:
        builder = NPGExperimentBuilder(factory, experiment, config).with_npg_params(NPGParams(**params))
    hidden = settings["hidden_sizes"]
    builder = builder.with_actor_factory_default(hidden, th.nn.Tanh, continuous_unbounded=True)
    return builder.with_critic_factory_default(hidden, th.nn.Tanh).build().create_experiment_world()


def agent_of(world: World) -> Act:
    """
    :param world: of an experiment
    :return: its deterministic policy for raw observations
    """
    policy = world.algorithm.policy
    training_envs = world.envs.training_envs
    assert isinstance(training_envs, VectorEnvNormObs)

    def act(observations: np.ndarray) -> np.ndarray:
        seen = training_envs.get_obs_rms().norm(observations)
        # In a training step the policy would be asked for noise
        with th.no_grad(), policy_within_training_step(policy, enabled=False):
            action = policy(Batch(obs=seen, info={})).act
        return policy.map_action(action.cpu().numpy())

    return act
