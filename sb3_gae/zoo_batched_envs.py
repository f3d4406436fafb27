"""The key ``batched_envs`` of rl-zoo3's hyperparameter files: training environments stepped in batches by native code."""

import functools
from typing import Any

from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from sb3_gae.vec_env.choice import batched_vec_env

KEY = "batched_envs"


def add_batched_envs(manager: type) -> None:
    """
    Let an experiment manager understand the key. Environments for evaluation are made as ever.

    :param manager: rl-zoo3's ``ExperimentManager``
    """
    preprocess, create_envs = manager._preprocess_hyperparams, manager.create_envs  # type: ignore[attr-defined]

    @functools.wraps(preprocess)
    def preprocess_without_our_key(self: Any, hyperparams: dict[str, Any]) -> Any:
        self.batched_envs = hyperparams.pop(KEY, False)
        if not isinstance(self.batched_envs, bool):
            raise ValueError(f"`{KEY}` must be True or False, got {self.batched_envs!r}.")
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

    manager._preprocess_hyperparams = preprocess_without_our_key  # type: ignore[attr-defined]
    manager.create_envs = create_envs_in_batches  # type: ignore[attr-defined]
