"""Models for the tests of saving and loading, and what must be the same of two."""

import io
from typing import Any

import numpy as np
import torch as th
from envs_for_tests import SMALL, differing, state_of, train_once, vec_env
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_gae import TRPOGAE

OBSERVATIONS = np.random.default_rng(0).uniform(-1, 1, (64, 3)).astype(np.float32)


def trained_model(**kwargs: Any) -> TRPOGAE:
    model = TRPOGAE("MlpPolicy", vec_env(), **({"n_steps": 16, "policy_kwargs": SMALL, "seed": 0} | kwargs))
    train_once(model)
    train_once(model)
    return model


def fresh_model(**kwargs: Any) -> TRPOGAE:
    return TRPOGAE("MlpPolicy", vec_env(), **({"n_steps": 16, "policy_kwargs": SMALL, "seed": 1} | kwargs))


def saved(model: BaseAlgorithm) -> bytes:
    file = io.BytesIO()
    model.save(file)
    return file.getvalue()


def values_and_actions(model: Any) -> tuple[np.ndarray, np.ndarray]:
    values = model.policy.predict_values(th.as_tensor(OBSERVATIONS)).detach().numpy()
    return values, model.predict(OBSERVATIONS, deterministic=True)[0]


def check_same(loaded: TRPOGAE, model: TRPOGAE) -> None:
    assert differing(state_of(model.policy), state_of(loaded.policy)) == []
    for mine, theirs in zip(values_and_actions(model), values_and_actions(loaded), strict=True):
        np.testing.assert_array_equal(mine, theirs)
