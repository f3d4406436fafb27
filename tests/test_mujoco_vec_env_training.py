"""Training, saving and evaluation on environments that are stepped in a batch."""

from pathlib import Path

import numpy as np
import pytest
from batched_and_single import EARLY_ENDS, both, functions
from envs_for_tests import differing, small_model, state_of, train_once
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecNormalize

from sb3_gae import TRPOGAE, MujocoVecEnv


@pytest.mark.parametrize("task_id", ["GaeCartPole-v0", "GaeQuadruped-v0"])
def test_training_is_the_same_as_on_single_environments(task_id: str) -> None:
    states = []
    for env in both(functions(task_id, 3, **EARLY_ENDS[task_id])):
        model = small_model(VecNormalize(env), n_steps=32)
        train_once(model)
        assert train_once(model)["train/is_line_search_success"] == 1.0
        states.append((state_of(model.policy), [(episode["r"], episode["l"]) for episode in model.ep_info_buffer]))
    assert differing(states[0][0], states[1][0]) == []
    assert len(states[0][1]) > 3
    assert states[0][1] == states[1][1]


def test_models_and_statistics_are_saved_and_loaded(tmp_path: Path) -> None:
    env_fns = functions("GaeBiped-v0", 2)
    env = VecNormalize(MujocoVecEnv(env_fns, 1))
    model = small_model(env)
    train_once(model)
    model.save(tmp_path / "model.zip")
    env.save(str(tmp_path / "statistics.pkl"))

    fresh = VecNormalize.load(str(tmp_path / "statistics.pkl"), MujocoVecEnv(env_fns, 1))
    np.testing.assert_array_equal(fresh.obs_rms.mean, env.obs_rms.mean)
    loaded = TRPOGAE.load(tmp_path / "model.zip", env=fresh)
    observations = fresh.reset()
    for found, expected in zip(loaded.predict(observations), model.predict(observations), strict=True):
        assert found is expected is None or np.shape(found) == np.shape(expected)
    deterministic = [some.predict(observations, deterministic=True)[0] for some in (loaded, model)]
    np.testing.assert_array_equal(*deterministic)
    train_once(loaded)
    assert loaded.num_timesteps > model.num_timesteps


def test_policies_are_evaluated_on_it() -> None:
    results = []
    for env in both(functions("GaeQuadruped-v0", 2)):
        env.seed(0)
        model = small_model(env)
        results.append(evaluate_policy(model, env, n_eval_episodes=3, return_episode_rewards=True))
    assert results[0] == results[1]
    assert results[0][1] == [12] * 3
