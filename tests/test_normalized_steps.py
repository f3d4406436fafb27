"""Steps through ``VecNormalize`` are those of SB3, bit for bit."""

import copy
from typing import Any

import numpy as np
import pytest
from envs_for_tests import VECTOR, AnySpacesEnv, vec_env
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_gae.rollout.normalized_steps import step_environments

PRECISE = spaces.Box(-np.inf, np.inf, (4,), np.float64)
WHOLE = spaces.Box(-5, 5, (2,), np.int64)
IMAGES = spaces.Box(0, 255, (2, 2), np.uint8)
MIXED = spaces.Dict({"a": VECTOR, "b": PRECISE})


def pair(observation_space: spaces.Space = VECTOR, n_envs: int = 3, **kwargs: Any) -> list[VecNormalize]:
    """Two environments with the same random numbers."""
    envs = [VecNormalize(vec_env(lambda: AnySpacesEnv(observation_space), n_envs), **kwargs) for _ in range(2)]
    for env in envs:
        env.seed(0)
    assert_same(*(env.reset() for env in envs))
    return envs


def assert_same(ours: Any, theirs: Any) -> None:
    """The same numbers in the same types."""
    if isinstance(theirs, dict):
        assert ours.keys() == theirs.keys()
        for key, value in theirs.items():
            assert_same(ours[key], value)
    elif isinstance(theirs, np.ndarray):
        assert ours.dtype == theirs.dtype
        np.testing.assert_array_equal(ours, theirs)
    else:
        assert ours == theirs


def assert_state(ours: VecNormalize, theirs: VecNormalize) -> None:
    """All that is pickled, and what is kept of the last step."""
    assert_same(ours.returns, theirs.returns)
    assert_same(ours.get_original_obs(), theirs.get_original_obs())
    assert_same(ours.get_original_reward(), theirs.get_original_reward())
    observed = [(ours.obs_rms, theirs.obs_rms)] if "obs_rms" in vars(theirs) else []
    for mine, his in [*observed, (ours.ret_rms, theirs.ret_rms)]:
        for a, b in zip(mine.values(), his.values(), strict=True) if isinstance(mine, dict) else [(mine, his)]:
            assert_same(vars(a), vars(b))


def assert_steps_agree(ours: VecNormalize, theirs: VecNormalize, n_steps: int = 17) -> None:
    rng = np.random.default_rng(0)
    for _ in range(n_steps):
        actions = rng.uniform(-1.0, 1.0, (ours.num_envs, 2)).astype(np.float32)
        found, expected = step_environments(ours, actions.copy()), theirs.step(actions)
        for mine, his in zip(found[:3], expected[:3], strict=True):
            assert_same(mine, his)
        for mine, his in zip(found[3], expected[3], strict=True):
            assert_same(mine, his)
        assert_state(ours, theirs)


@pytest.mark.parametrize("space", [VECTOR, PRECISE, WHOLE, IMAGES, MIXED])
@pytest.mark.parametrize("kwargs", [{}, {"norm_reward": False}, {"training": False}, {"norm_obs": False}, {"clip_obs": 0.1}])
@pytest.mark.parametrize("n_envs", [1, 3])
def test_steps_are_those_of_sb3(space: spaces.Space, kwargs: dict[str, Any], n_envs: int) -> None:
    assert_steps_agree(*pair(space, n_envs, **kwargs))


def test_what_is_changed_between_two_steps_counts() -> None:
    envs = pair()
    assert_steps_agree(*envs, n_steps=4)
    for env in envs:
        env.training, env.norm_reward = False, False
    assert_steps_agree(*envs, n_steps=4)
    for env in envs:
        env.training, env.norm_obs = True, False
    assert_steps_agree(*envs, n_steps=4)


def test_statistics_that_are_shared_stay_so() -> None:
    env, _ = pair()
    statistics = env.obs_rms
    before = copy.deepcopy(statistics)
    step_environments(env, np.zeros((3, 2), dtype=np.float32))
    assert env.obs_rms is statistics
    assert statistics.count == before.count + 3


class Doubling(VecNormalize):
    """Shows another observation than its parent."""

    def step_wait(self) -> Any:
        observations, *others = super().step_wait()
        return 2.0 * np.asarray(observations), *others


def test_methods_that_were_replaced_in_one_environment_are_called() -> None:
    envs = pair()
    for env in envs:
        env.normalize_obs = lambda observations: observations + 1.0  # type: ignore[method-assign,assignment]
    assert_steps_agree(*envs)


@pytest.mark.parametrize("wrapper", [Doubling, None])
def test_other_environments_step_themselves(wrapper: type[VecNormalize] | None) -> None:
    ours, theirs = (env if wrapper is None else wrapper(env) for env in (seeded(), seeded()))
    assert_same(ours.reset(), theirs.reset())
    actions = np.full((2, 2), 0.5, dtype=np.float32)
    for mine, his in zip(step_environments(ours, actions), theirs.step(actions), strict=True):
        assert_same(mine, his)


def seeded() -> VecEnv:
    env = vec_env()
    env.seed(0)
    return env
