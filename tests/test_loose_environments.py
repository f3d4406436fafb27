"""Environments of one's own whose steps are of other types than SB3's."""

from typing import Any

import numpy as np
from envs_for_tests import differing, short_model, state_of, train_once, vec_env
from stable_baselines3.common.vec_env import VecEnvWrapper


class Loose(VecEnvWrapper):
    """Rewards as a list and ends as floats, as environments of one's own may have them."""

    def reset(self) -> Any:
        return self.venv.reset()

    def step_wait(self) -> Any:
        observations, rewards, dones, infos = self.venv.step_wait()
        return observations, rewards.tolist(), dones.astype(np.float32), infos


def test_rewards_and_ends_of_any_type_are_taken() -> None:
    states = []
    for env in (vec_env(), Loose(vec_env())):
        model = short_model(env)
        train_once(model)
        states.append(state_of(model.policy))
    assert differing(*states) == []
