"""A run through rl-zoo3: its own experiment manager, its own settings file with one task in it."""

import argparse
from pathlib import Path
from typing import Any

import yaml
from rl_zoo3.exp_manager import ExperimentManager
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.utils import set_random_seed

from benchmarks.peers.algorithms import OURS
from benchmarks.peers.checkpoint import Checkpoint
from benchmarks.peers.clock import TrainingClock
from benchmarks.peers.plan import Cell
from benchmarks.peers.protocol import evaluation_interval
from benchmarks.peers.recorder import Recorder
from benchmarks.peers.zoo_callbacks import StartClock, StopClock
from sb3_gae import ResumableCheckpointCallback
from sb3_gae.saving.checkpoint_file import newest_checkpoint, timesteps_of

_CHECKPOINTS = "checkpoints"


def checkpoint_in(folder: Path, cell: Cell) -> Checkpoint | None:
    """
    :param folder: of the run
    :param cell: that is run
    :return: from where it can go on; None if it has to begin anew
    """
    if cell.algorithm != OURS:
        return None
    try:
        path, _ = newest_checkpoint(folder / _CHECKPOINTS)
    except (FileNotFoundError, ValueError):
        return None
    return Checkpoint(path, timesteps_of(path))


def run_in_zoo(
    cell: Cell, settings: dict[str, Any], folder: Path, clock: TrainingClock, recorder: Recorder, checkpoint: Checkpoint | None
) -> int:
    """
    Train.

    :param cell: of the plan
    :param settings: of the run, as a file of rl-zoo3 has them
    :param folder: of the run
    :param clock: of the training
    :param recorder: evaluates
    :param checkpoint: to go on from
    :return: steps of the training
    """
    file = folder / "settings.yml"
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(yaml.safe_dump({cell.task: settings}))
    # As the command `python -m rl_zoo3.train` does
    set_random_seed(cell.seed)
    manager = ExperimentManager(
        argparse.Namespace(),
        cell.algorithm,
        cell.task,
        str(folder / "zoo"),
        n_timesteps=cell.steps,
        eval_freq=-1,
        seed=cell.seed,
        log_interval=-1,
        verbose=0,
        device="cpu",
        config=str(file),
        trained_agent="" if checkpoint is None else str(checkpoint.path),
    )
    made = manager.setup_experiment()
    assert made is not None
    model, _ = made
    stop = StopClock(clock, recorder, cell.steps)
    callbacks: list[BaseCallback] = [stop]
    if cell.algorithm == OURS:
        interval = max(1, evaluation_interval(cell.steps) // manager.n_envs)
        callbacks.append(ResumableCheckpointCallback(interval, folder / _CHECKPOINTS, keep=2))
    manager.callbacks += [*callbacks, StartClock(clock, stop)]
    manager.learn(model)
    return int(model.num_timesteps)
