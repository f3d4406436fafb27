"""Easy tasks are learnt."""

from typing import Any

import pytest
from envs_for_tests import SMALL
from stable_baselines3.common.envs import IdentityEnv, IdentityEnvBox, IdentityEnvMultiBinary, IdentityEnvMultiDiscrete
from stable_baselines3.common.evaluation import evaluate_policy

from sb3_gae import TRPOGAE


@pytest.mark.parametrize(
    ("env", "iterations"),
    [
        *[(IdentityEnv(dim=4), 6), (IdentityEnvMultiDiscrete(dim=3), 6), (IdentityEnvMultiBinary(dim=3), 6)],
        (IdentityEnvBox(eps=0.2), 15),
    ],
    ids=["Discrete", "MultiDiscrete", "MultiBinary", "Box"],
)
def test_an_easy_task_is_learnt(env: Any, iterations: int) -> None:
    """The tasks of SB3's own tests: the right action is the observation itself, and each is worth 1 in 100 steps."""
    model = TRPOGAE("MlpPolicy", env, n_steps=128, gamma=0.0, target_kl=0.1, policy_kwargs=SMALL, seed=0)
    before, _ = evaluate_policy(model, model.get_env(), n_eval_episodes=1, warn=False)
    model.learn(iterations * 128)
    after, _ = evaluate_policy(model, model.get_env(), n_eval_episodes=1, warn=False)
    assert before < 50.0 and after > 95.0
