"""
Keys of our own in rl-zoo3's hyperparameter files.

``batched_envs``
    whether training environments are stepped in batches by native code where that is possible. Environments for
    evaluation are made as ever.
``eval_freq``
    steps between evaluations where the command line leaves the zoo's own number, which would have tasks of many
    million steps evaluated for longer than trained.
"""

import functools
from typing import Any

from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from sb3_gae.checks import check_count
from sb3_gae.vec_env.choice import batched_vec_env

BATCHED_ENVS, EVAL_FREQ = "batched_envs", "eval_freq"

#: of rl-zoo3's ``ExperimentManager``, that read the keys
METHODS_WITH_KEYS = ("_preprocess_hyperparams", "create_envs")

# Of rl-zoo3's command line
_DEFAULT_EVAL_FREQ = 25_000


def add_keys(manager: type) -> None:
    """
    Let an experiment manager understand the keys.

    :param manager: rl-zoo3's ``ExperimentManager``
    """
    preprocess, create_envs = (getattr(manager, name) for name in METHODS_WITH_KEYS)

    @functools.wraps(preprocess)
    def preprocess_without_our_keys(self: Any, hyperparams: dict[str, Any]) -> Any:
        self.batched_envs = hyperparams.pop(BATCHED_ENVS, False)
        if not isinstance(self.batched_envs, bool):
            raise ValueError(f"`{BATCHED_ENVS}` must be True or False, got {self.batched_envs!r}.")
        eval_freq = hyperparams.pop(EVAL_FREQ, self.eval_freq)
        if self.eval_freq == _DEFAULT_EVAL_FREQ:
            check_count(EVAL_FREQ, eval_freq)
            self.eval_freq = eval_freq
        return preprocess(self, hyperparams)

    @functools.wraps(create_envs)
    def create_envs_in_batches(self: Any, n_envs: int, eval_env: bool = False, no_log: bool = False) -> VecEnv:
        chosen = self.vec_env_class
        # Whoever asks for subprocesses gets them
        if getattr(self, "batched_envs", False) and not eval_env and chosen is DummyVecEnv:
            self.vec_env_class = batched_vec_env
        try:
            return create_envs(self, n_envs, eval_env, no_log)
        finally:
            self.vec_env_class = chosen

    manager._preprocess_hyperparams = preprocess_without_our_keys  # type: ignore[attr-defined]
    manager.create_envs = create_envs_in_batches  # type: ignore[attr-defined]
