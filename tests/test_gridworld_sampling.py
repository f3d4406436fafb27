"""Episodes as arrays, and what is computed from them."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tabular_oracles import Trajectory, cyclic_mdp, random_policy

from sb3_gae.gridworld import (
    Episodes,
    TabularPolicy,
    episode_advantages,
    episode_deltas,
    episode_gradients,
    fitted_values,
    gridworld,
    sample_episodes,
)

seeds = st.integers(0, 10**6)
factors = st.one_of(st.sampled_from([0.0, 1.0, 0.99]), st.floats(0.0, 1.0))


def trajectory(episodes: Episodes, n: int) -> Trajectory:
    steps = episodes.mask[:, n]
    states = [*episodes.states[steps, n].tolist(), int(episodes.next_states[steps, n][-1])]
    return Trajectory(1.0, tuple(states), tuple(episodes.actions[steps, n].tolist()))


@given(seeds, st.integers(1, 5), factors, factors)
def test_advantages_and_gradients_are_the_direct_sums_over_each_episode(
    seed: int, n_episodes: int, gamma: float, gae_lambda: float
) -> None:
    policy = random_policy(cyclic_mdp(seed), seed)
    values = np.random.default_rng(seed).normal(size=5)
    episodes = sample_episodes(policy, n_episodes, np.random.default_rng(seed))
    advantages = episode_advantages(policy, episodes, values, gamma, gae_lambda)
    gradients = episode_gradients(policy, episodes, advantages)
    for n in range(n_episodes):
        each, steps = trajectory(episodes, n), episodes.mask[:, n]
        np.testing.assert_allclose(episodes.rewards[steps, n], each.rewards(policy.mdp))
        expected = each.advantages(policy.mdp, values, gamma, gae_lambda)
        np.testing.assert_allclose(advantages[steps, n], expected, atol=1e-9)
        np.testing.assert_allclose(gradients[n], each.gradient(policy, expected), atol=1e-9)
    np.testing.assert_array_equal(advantages[~episodes.mask], 0.0)


@given(seeds, st.integers(1, 5))
def test_episodes_run_from_start_to_end_and_are_padded_after(seed: int, n_episodes: int) -> None:
    policy = random_policy(cyclic_mdp(seed), seed)
    episodes = sample_episodes(policy, n_episodes, np.random.default_rng(seed))
    assert episodes.states.shape == (len(episodes.states), n_episodes)
    np.testing.assert_array_equal(episodes.terminated.sum(axis=0), 1)
    assert not episodes.truncated.any()
    np.testing.assert_array_equal(episodes.mask.sum(axis=0), episodes.terminated.argmax(axis=0) + 1)
    np.testing.assert_array_equal(episodes.states[1:], episodes.next_states[:-1])
    assert (policy.mdp.start[episodes.states[0]] > 0).all()
    assert policy.mdp.terminal[episodes.next_states[-1]].all()
    assert episodes.mask[-1].any()
    np.testing.assert_array_equal(episodes.rewards[~episodes.mask], 0.0)


def test_the_same_seed_gives_the_same_episodes() -> None:
    policy = TabularPolicy(gridworld(), np.zeros((25, 4)))
    first, second, other = (sample_episodes(policy, 10, np.random.default_rng(seed)) for seed in (0, 0, 1))
    for one, same in zip(first, second, strict=True):
        np.testing.assert_array_equal(one, same)
    assert first.states.shape != other.states.shape or (first.states != other.states).any()


def test_steps_are_drawn_with_their_probabilities() -> None:
    policy = random_policy(gridworld(), 0)
    episodes = sample_episodes(policy, 5_000, np.random.default_rng(0))
    states, actions, following = (array[episodes.mask] for array in (episodes.states, episodes.actions, episodes.next_states))
    counts = np.zeros_like(policy.mdp.transitions)
    np.add.at(counts, (states, actions, following), 1)
    # Every step is a draw from its state: actions, then next states, as multinomials
    for drawn, chances in ((counts.sum(axis=2), policy.probabilities), (counts, policy.mdp.transitions)):
        expected = drawn.sum(axis=-1, keepdims=True) * chances
        deviation = np.sqrt(expected * (1.0 - chances))
        assert (np.abs(drawn - expected) <= 5.0 * deviation + 1e-9).all()
    np.testing.assert_allclose(episodes.mask.sum(axis=0).mean(), policy.mean_length, rtol=0.05)
    assert abs(episodes.returns.mean() - policy.expected_return()) < 4.0 * episodes.returns.std() / np.sqrt(5_000)


def test_long_episodes_can_be_cut_and_bootstrap_where_they_were() -> None:
    policy = TabularPolicy(gridworld(), np.zeros((25, 4)))
    values = np.arange(25.0)
    episodes = sample_episodes(policy, 50, np.random.default_rng(0), max_steps=4)
    assert len(episodes.states) <= 4
    assert episodes.truncated[-1].any()
    np.testing.assert_array_equal(episodes.dones.sum(axis=0), 1)
    last = np.where(policy.mdp.terminal, 0.0, values)[episodes.next_states]
    expected = episodes.rewards + 0.9 * last - values[episodes.states]
    deltas = episode_deltas(policy, episodes, values, 0.9)
    np.testing.assert_allclose(deltas[episodes.mask], expected[episodes.mask])


def test_fitted_values_are_mean_returns_of_visits() -> None:
    policy = TabularPolicy(gridworld(), np.zeros((25, 4)))
    episodes = sample_episodes(policy, 3, np.random.default_rng(0))
    sums, counts = np.zeros(25), np.zeros(25)
    for n in range(3):
        each = trajectory(episodes, n)
        for state, value in zip(each.states, each.advantages(policy.mdp, np.zeros(25), 0.9, 1.0), strict=False):
            sums[state] += value
            counts[state] += 1
    np.testing.assert_allclose(fitted_values(policy, episodes, 0.9), sums / np.maximum(counts, 1), atol=1e-12)
    many = sample_episodes(policy, 5_000, np.random.default_rng(1))
    np.testing.assert_allclose(fitted_values(policy, many, 0.9), policy.values(0.9), atol=0.05)


def test_refuses_bad_arguments() -> None:
    policy, generator = TabularPolicy(gridworld(), np.zeros((25, 4))), np.random.default_rng(0)
    with pytest.raises(ValueError, match="`n_episodes` must be a whole number of at least 1, got 0"):
        sample_episodes(policy, 0, generator)
    with pytest.raises(ValueError, match="`max_steps` must be a whole number of at least 1, got 0"):
        sample_episodes(policy, 1, generator, max_steps=0)
    episodes = sample_episodes(policy, 1, generator)
    with pytest.raises(ValueError, match=r"`gae_lambda` must be a number in \[0, 1\], got 2"):
        episode_advantages(policy, episodes, np.zeros(25), 0.9, 2)
    with pytest.raises(ValueError, match=r"`gamma` must be a number in \[0, 1\], got 2"):
        fitted_values(policy, episodes, 2)
