"""Batches of whole episodes: what belongs to them, and that nothing else changes the update."""

from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from envs_for_tests import SMALL
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import Rollout, direct_advantages
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_gae import TRPOGAE
from sb3_gae.rollout.episode_quota import EpisodeQuota


class Stopwatch(gym.Env):
    """Episodes of given lengths one after the other; the observation is the episode's number and the step in it."""

    observation_space = spaces.Box(-np.inf, np.inf, (2,), np.float32)
    action_space = spaces.Discrete(2)

    def __init__(self, lengths: list[int], truncates: bool = False):
        self.lengths, self.truncates = lengths, truncates
        self.episode, self.now, self.resets = -1, 0, 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.episode, self.now, self.resets = self.episode + 1, 0, self.resets + 1
        return self.observe(), {}

    def step(self, action):
        self.now += 1
        over = self.now == self.lengths[self.episode % len(self.lengths)]
        return self.observe(), float(action) + self.episode, over and not self.truncates, over and self.truncates, {}

    def observe(self) -> np.ndarray:
        return np.array([self.episode, self.now], dtype=np.float32)


class Keep(BaseCallback):
    """Keeps the batches as (episode number, step) of each sample, and the buffer's arrays."""

    def __init__(self):
        super().__init__()
        self.batches: list[np.ndarray] = []

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        self.batches.append(self.locals["rollout_buffer"].batch().observations.numpy().astype(int))


def whole_episodes(lengths: list[list[int]], truncates: bool = False, **kwargs) -> TRPOGAE:
    env = DummyVecEnv([lambda own=own: Stopwatch(own, truncates) for own in lengths])
    return TRPOGAE("MlpPolicy", env, policy_kwargs=SMALL, seed=0, **{"n_steps": 40, "n_episodes": 1, **kwargs})


@given(
    st.lists(st.integers(0, 2), min_size=1, max_size=4).flatmap(
        lambda counts: st.tuples(st.just(len(counts)), st.integers(1, 3), st.lists(st.booleans(), min_size=60, max_size=60))
    )
)
def test_a_quota_counts_steps_up_to_the_nth_ending(drawn: tuple[int, int, list[bool]]) -> None:
    n_envs, n_episodes, flips = drawn
    dones = np.array(flips[: 60 // n_envs * n_envs]).reshape(-1, n_envs)
    quota = EpisodeQuota(n_envs, n_episodes)
    for t, row in enumerate(dones):
        ended_before = dones[:t].sum(axis=0)
        np.testing.assert_array_equal(quota.counts, ended_before < n_episodes)
        assert quota.is_met == bool((ended_before >= n_episodes).all())
        quota.add(row)


def test_no_quota_counts_everything_and_is_never_met() -> None:
    quota = EpisodeQuota(2, None)
    quota.add(np.array([True, True]))
    assert quota.counts is None and not quota.is_met


@pytest.mark.parametrize("n_episodes", [1, 2])
def test_each_environment_gives_the_same_number_of_whole_episodes(n_episodes: int) -> None:
    lengths = [[2, 3, 2, 5], [7, 4, 6, 1], [1, 1, 9, 2]]
    model, keep = whole_episodes(lengths, n_episodes=n_episodes), Keep()
    model.learn(1, keep)
    expected = sorted((episode, step) for own in lengths for episode in range(n_episodes) for step in range(own[episode]))
    assert sorted(map(tuple, keep.batches[0].tolist())) == expected
    buffer = model.rollout_buffer
    assert buffer.n_samples == len(expected)
    np.testing.assert_array_equal((buffer.dones & buffer.mask).sum(axis=0), n_episodes)


def test_every_rollout_begins_with_new_episodes() -> None:
    model, keep = whole_episodes([[2, 2, 3, 2], [5, 4, 6, 1]]), Keep()
    model.learn(15, keep)
    assert len(keep.batches) > 1
    for batch in keep.batches:
        # A first step in each of the two environments
        assert np.count_nonzero(batch[:, 1] == 0) == 2


def test_no_reset_where_all_episodes_ended_together() -> None:
    model = whole_episodes([[3], [3]])
    model.learn(3 * 2 * 4)
    # One at the beginning, one at the end of each of four episodes
    assert model.env.get_attr("resets") == [5, 5]


@pytest.mark.parametrize("truncates", [False, True])
def test_advantages_are_those_of_each_episode_alone(truncates: bool) -> None:
    model = whole_episodes([[2, 9], [7, 4], [1, 3]], truncates, gamma=0.9, gae_lambda=0.8)
    model.learn(1)
    buffer = model.rollout_buffer
    for env in range(3):
        used = slice(0, int(buffer.mask[:, env].sum())), slice(env, env + 1)
        endings = {"terminated": buffer.terminated[used], "truncated": buffer.truncated[used]}
        bootstraps = {"bootstrap_values": buffer.bootstrap_values[used], "last_values": np.full(1, np.nan)}
        alone = direct_advantages(Rollout(buffer.rewards[used], buffer.values[used], **bootstraps, **endings), 0.9, 0.8)
        np.testing.assert_allclose(buffer.advantages[used], alone, rtol=1e-5, atol=1e-5)
        assert bool(buffer.truncated[used][-1, 0]) == truncates


def test_what_lies_outside_the_mask_has_no_influence() -> None:
    model = whole_episodes([[2], [7], [1]])
    model.learn(1)
    buffer, outside = model.rollout_buffer, ~model.rollout_buffer.mask
    sweep = buffer.lambda_sweep([0.5, 1.0])
    batch = [tensor.clone() for tensor in buffer.batch()]
    for name in ("observations", "rewards", "values", "advantages", "returns", "log_probs", "bootstrap_values"):
        getattr(buffer, name)[outside] = 1e6
    for before, after in zip(batch, buffer.batch(), strict=True):
        assert th.equal(before, after)
    for before, after in zip(sweep, buffer.lambda_sweep([0.5, 1.0]), strict=True):
        np.testing.assert_array_equal(before, after)
    samples = th.cat([part.observations for part in buffer.get(3)])
    assert len(samples) == buffer.n_samples == 10
    assert samples.max() < 1e6


def test_episodes_outside_the_batch_are_not_in_the_mean_of_the_log() -> None:
    env = DummyVecEnv([lambda own=own: Monitor(Stopwatch(own)) for own in ([1], [9])])
    model = TRPOGAE("MlpPolicy", env, n_steps=20, n_episodes=1, policy_kwargs=SMALL, seed=0)
    model.learn(1)
    assert sorted(info["l"] for info in model.ep_info_buffer) == [1, 9]


def test_n_steps_too_small_is_said_and_cuts_the_episode() -> None:
    model = whole_episodes([[2], [7]], n_steps=5)
    with pytest.warns(UserWarning, match="`n_steps` = 5 ended before.*Raise `n_steps`"):
        model.learn(1)
    assert model.rollout_buffer.mask.sum(axis=0).tolist() == [2, 5]


@settings(max_examples=10, deadline=None)
@given(st.lists(st.integers(1, 6), min_size=2, max_size=3))
def test_equal_lengths_give_the_update_of_batches_by_steps(lengths: list[int]) -> None:
    """With all episodes as long as the rollout, the two kinds of batches are one."""
    n_envs, length = len(lengths), lengths[0]
    # Each made just before it learns: making one seeds the global generators
    by_episodes = whole_episodes([[length]] * n_envs, n_steps=length).learn(2 * n_envs * length)
    by_steps = whole_episodes([[length]] * n_envs, n_steps=length, n_episodes=None).learn(2 * n_envs * length)
    for one, other in zip(by_episodes.policy.parameters(), by_steps.policy.parameters(), strict=True):
        assert th.equal(one, other)


@pytest.mark.parametrize("wrong", [0, -1, 1.5, True, "2"])
def test_a_wrong_number_of_episodes_is_refused(wrong: object) -> None:
    with pytest.raises(ValueError, match="`n_episodes` must be a whole number of at least 1"):
        whole_episodes([[2], [3]], n_episodes=wrong)


def test_a_batch_of_one_episode_is_refused() -> None:
    with pytest.raises(ValueError, match="at least 2 episodes"):
        whole_episodes([[2]])


def test_what_learned_from_many_episodes_can_be_watched_in_one_environment(tmp_path: Path) -> None:
    whole_episodes([[2], [7]]).save(tmp_path / "model")
    alone = TRPOGAE.load(tmp_path / "model", env=DummyVecEnv([lambda: Stopwatch([2])]))
    assert alone.predict(np.zeros((1, 2)))[0].shape == (1,)
    with pytest.raises(ValueError, match="at least 2 episodes"):
        alone.learn(1)


def test_adam_fits_the_same_samples() -> None:
    model = whole_episodes([[2], [7]], vf_optimizer="adam", batch_size=4)
    before = [parameter.clone() for parameter in model.policy.value_net.parameters()]
    model.learn(1)
    assert any(not th.equal(one, other) for one, other in zip(before, model.policy.value_net.parameters(), strict=True))


def test_saved_and_loaded(tmp_path) -> None:
    model = whole_episodes([[2], [7]], n_episodes=3)
    model.learn(1)
    model.save(tmp_path / "model")
    loaded = TRPOGAE.load(tmp_path / "model", env=model.env)
    assert loaded.n_episodes == 3
    loaded.learn(1)
    assert (loaded.rollout_buffer.dones & loaded.rollout_buffer.mask).sum(axis=0).tolist() == [3, 3]
