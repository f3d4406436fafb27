"""``--trained-agent`` of rl-zoo3 goes on from a checkpoint of ours bit for bit."""

import functools
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from stable_baselines3.common.vec_env import VecEnv

from sb3_gae.saving.checkpoint_file import is_whole
from sb3_gae.saving.resumable import ResumableModel

#: of rl-zoo3's ``ExperimentManager``, that have a part in it
METHODS_THAT_RESUME = ("_load_pretrained_agent", "learn")


def add_resuming(manager: type, kind: type[ResumableModel], algo: str) -> None:
    """
    Let an experiment manager continue a training in the place of beginning another with its weights.

    :param manager: rl-zoo3's ``ExperimentManager``
    :param kind: of the model
    :param algo: its name in rl-zoo3
    """
    load, learn = (getattr(manager, name) for name in METHODS_THAT_RESUME)

    @functools.wraps(load)
    def load_or_resume(self: Any, hyperparams: dict[str, Any], env: VecEnv) -> Any:
        if self.algo != algo or not is_whole(Path(self.trained_agent)):
            return load(self, hyperparams, env)
        print(f"Continuing the training of {os.fspath(self.trained_agent)}")
        kwargs = {"tensorboard_log": self.tensorboard_log, "verbose": self.verbose, "device": self.device}
        return kind.resume(self.trained_agent, env, **kwargs)

    @functools.wraps(learn)
    def learn_what_is_left(self: Any, model: Any) -> None:
        if isinstance(model, ResumableModel) and model.is_resumed:
            with_counters: Callable[..., Any] = functools.partial(model.learn, reset_num_timesteps=False)
            self.n_timesteps = max(0, self.n_timesteps - model.num_timesteps)
            model.learn = with_counters  # type: ignore[method-assign]
            try:
                learn(self, model)
            finally:
                del model.learn
        else:
            learn(self, model)

    manager._load_pretrained_agent = load_or_resume  # type: ignore[attr-defined]
    manager.learn = learn_what_is_left  # type: ignore[attr-defined]
