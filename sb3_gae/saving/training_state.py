"""What a training needs beside the saved model to go on as if it had not stopped."""

import pickle
from typing import Any

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import Logger

from sb3_gae.saving.callback_state import CallbackStates
from sb3_gae.saving.environment_state import environment_state
from sb3_gae.saving.random_state import random_state

# What was recorded since the last line of the log
_LOG = ("name_to_value", "name_to_count", "name_to_excluded")


def training_state(model: BaseAlgorithm, callbacks: CallbackStates) -> bytes:
    """
    :param model: between two iterations
    :param callbacks: state of its callbacks
    :return: pickled
    """
    env = model.get_env()
    assert env is not None
    return pickle.dumps(
        {
            "environment": environment_state(env),
            "callbacks": callbacks,
            "log": {name: dict(getattr(model.logger, name)) for name in _LOG},
            # Last: the state of an environment may be asked for by code that draws random numbers
            "random": random_state(),
        }
    )


def seed_of_continuation(model: BaseAlgorithm) -> int:
    """
    :param model: whose environments begin new episodes
    :return: a seed for them, so that they do not begin again with those of the start of the training
    """
    return int(np.random.SeedSequence([model.seed or 0, model.num_timesteps]).generate_state(1)[0] % 2**31)


def restore_log(logger: Logger, log: dict[str, dict[str, Any]]) -> None:
    """
    :param logger: of the model
    :param log: what the checkpoint has of it
    """
    for name in _LOG:
        getattr(logger, name).update(log[name])
