"""
Keys of our own in rl-zoo3's hyperparameter files.

``batched_envs``
    whether training environments are stepped in batches by native code where that is possible. Environments for
    evaluation are made as ever.
``eval_freq``
    steps between evaluations where the command line leaves the zoo's own number, which would have tasks of many
    million steps evaluated for longer than trained.
``rollout_workers``
    number of Ray workers that share the training environments and collect the batch, for ``trpo_gae``.
"""

import functools
from collections.abc import Callable
from typing import Any

from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from sb3_gae.checks import check_count
from sb3_gae.vec_env.choice import batched_vec_env
from sb3_gae.workers import RayVecEnv

BATCHED_ENVS, EVAL_FREQ, ROLLOUT_WORKERS = "batched_envs", "eval_freq", "rollout_workers"

#: of rl-zoo3's ``ExperimentManager``, that read the keys
METHODS_WITH_KEYS = ("_preprocess_hyperparams", "create_envs")

# Of rl-zoo3's command line
_DEFAULT_EVAL_FREQ = 25_000


def add_keys(manager: type, algo: str) -> None:
    """
    Let an experiment manager understand the keys. It raises a ``ValueError`` when it reads a value that is outside its domain,
    or ``rollout_workers`` for another algorithm or beside subprocesses.

    :param manager: rl-zoo3's ``ExperimentManager``
    :param algo: name in rl-zoo3 of the algorithm whose batches workers can collect
    """
    preprocess, create_envs = (getattr(manager, name) for name in METHODS_WITH_KEYS)

    @functools.wraps(preprocess)
    def preprocess_without_our_keys(self: Any, hyperparams: dict[str, Any]) -> Any:
        self.batched_envs = hyperparams.pop(BATCHED_ENVS, False)
        if not isinstance(self.batched_envs, bool):
            raise ValueError(f"`{BATCHED_ENVS}` must be True or False, got {self.batched_envs!r}.")
        self.rollout_workers = hyperparams.pop(ROLLOUT_WORKERS, None)
        _check_workers(self, algo)
        eval_freq = hyperparams.pop(EVAL_FREQ, self.eval_freq)
        if self.eval_freq == _DEFAULT_EVAL_FREQ:
            check_count(EVAL_FREQ, eval_freq)
            self.eval_freq = eval_freq
        return preprocess(self, hyperparams)

    @functools.wraps(create_envs)
    def create_envs_in_batches(self: Any, n_envs: int, eval_env: bool = False, no_log: bool = False) -> VecEnv:
        chosen = self.vec_env_class
        if not eval_env:
            self.vec_env_class = _vec_env_to_train_on(self)
        try:
            return create_envs(self, n_envs, eval_env, no_log)
        finally:
            self.vec_env_class = chosen

    manager._preprocess_hyperparams = preprocess_without_our_keys  # type: ignore[attr-defined]
    manager.create_envs = create_envs_in_batches  # type: ignore[attr-defined]


def _check_workers(manager: Any, algo: str) -> None:
    if manager.rollout_workers is None:
        return
    check_count(ROLLOUT_WORKERS, manager.rollout_workers)
    if manager.algo != algo:
        raise ValueError(f"`{ROLLOUT_WORKERS}` is for {algo}; {manager.algo} takes each step itself, so leave it out.")
    if manager.vec_env_class is not DummyVecEnv:
        raise ValueError(f"`{ROLLOUT_WORKERS}` and `--vec-env subproc` are two ways to the same; leave out one of them.")


def _vec_env_to_train_on(manager: Any) -> Callable[..., VecEnv]:
    batched = getattr(manager, "batched_envs", False)
    if (n_workers := getattr(manager, "rollout_workers", None)) is not None:
        return functools.partial(RayVecEnv, n_workers=n_workers, vec_env_cls=None if batched else DummyVecEnv)
    # Whoever asks for subprocesses gets them
    return batched_vec_env if batched and manager.vec_env_class is DummyVecEnv else manager.vec_env_class
