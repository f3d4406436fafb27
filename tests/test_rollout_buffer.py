"""The rollout buffer against SB3's own, and what it keeps that SB3's does not."""

import copy

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import Rollout, advantage_magnitudes, assert_equal_to_rounding, direct_advantages, rollouts
from stable_baselines3.common.buffers import DictRolloutBuffer, RolloutBuffer

from sb3_gae import GAEDictRolloutBuffer, GAERolloutBuffer

BOX = spaces.Box(-np.inf, np.inf, (2,))
ACTIONS = spaces.Box(-1.0, 1.0, (1,))
DICT = spaces.Dict({"position": BOX, "cell": spaces.Discrete(7)})

factors = st.one_of(st.sampled_from([0.0, 1.0, 0.99]), st.floats(0.0, 1.0))
possible_rollouts = rollouts(both=False)


def observation_ids(t: int, n_envs: int) -> np.ndarray:
    """A number that tells each sample from all others, shape (N,)."""
    return 100.0 * t + np.arange(n_envs)


def fill_step(buffer: RolloutBuffer, rollout: Rollout, t: int, reward: np.ndarray, value: np.ndarray) -> tuple:
    """Arguments of SB3's ``add`` for a step: observation, action, reward, episode start, value, log-probability."""
    n_envs = buffer.n_envs
    ids = observation_ids(t, n_envs)
    observation: np.ndarray | dict[str, np.ndarray] = np.stack([ids, -ids], axis=1)
    if isinstance(buffer.observation_space, spaces.Dict):
        observation = {"position": observation, "cell": ids.astype(int) % 7}
    elif isinstance(buffer.observation_space, spaces.Discrete):
        observation = ids.astype(int) % buffer.observation_space.n
    action = np.stack([buffer.action_space.sample() for _ in range(n_envs)])
    start = rollout.dones[t - 1] if t else np.ones(n_envs, dtype=bool)
    return observation, action, reward, start, th.tensor(value), th.tensor(ids / 1000)


def filled(
    rollout: Rollout,
    gamma: float = 0.9,
    gae_lambda: float = 0.8,
    buffer_class: type[GAERolloutBuffer] = GAERolloutBuffer,
    observation_space: spaces.Space = BOX,
    action_space: spaces.Space = ACTIONS,
    **kwargs,
) -> GAERolloutBuffer:
    """As TRPOGAE fills it: endings at each step, values and log-probabilities at the end."""
    n_steps, n_envs = rollout.rewards.shape
    buffer = buffer_class(
        n_steps, observation_space, action_space, gamma=gamma, gae_lambda=gae_lambda, n_envs=n_envs, device="cpu", **kwargs
    )
    buffer.action_space.seed(0)
    log_probs = np.stack([observation_ids(t, n_envs) for t in range(n_steps)]).astype(np.float32) / 1000
    for t in range(n_steps):
        observation, action, reward, start, *_ = fill_step(buffer, rollout, t, rollout.rewards[t], rollout.values[t])
        buffer.add_step(observation, action, reward, start, rollout.dones[t], rollout.truncated[t])
    buffer.set_values(rollout.values, log_probs, rollout.bootstrap_values)
    buffer.compute_returns_and_advantage(th.tensor(rollout.last_values), rollout.dones[-1])
    return buffer


def filled_as_sb3_does(rollout: Rollout, buffer_class: type[RolloutBuffer], gamma: float, gae_lambda: float) -> RolloutBuffer:
    """As SB3's ``collect_rollouts``: the discounted value of a terminal observation is added to the reward."""
    n_steps, n_envs = rollout.rewards.shape
    buffer = buffer_class(n_steps, BOX, ACTIONS, gamma=gamma, gae_lambda=gae_lambda, n_envs=n_envs, device="cpu")
    for t in range(n_steps):
        reward = rollout.rewards[t].copy()
        reward[rollout.truncated[t]] += gamma * rollout.bootstrap_values[t][rollout.truncated[t]]
        buffer.add(*fill_step(buffer, rollout, t, reward, rollout.values[t]))
    buffer.compute_returns_and_advantage(th.tensor(rollout.last_values), rollout.dones[-1])
    return buffer


def some_rollout(n_steps: int = 6, n_envs: int = 3, seed: int = 0) -> Rollout:
    """With both kinds of ending, and not at the same steps in each environment."""
    generator = np.random.default_rng(seed)
    shape = (n_steps, n_envs)
    rewards, values, bootstrap_values = generator.normal(size=(3, *shape)).astype(np.float32)
    terminated = generator.random(shape) < 0.25
    truncated = ~terminated & (generator.random(shape) < 0.25)
    return Rollout(rewards, values, values[0] + 1, terminated, truncated, bootstrap_values)


def arrays_of(buffer: GAERolloutBuffer) -> dict[str, np.ndarray]:
    observations = buffer.observations if isinstance(buffer.observations, dict) else {"observations": buffer.observations}
    return copy.deepcopy({**{k: v for k, v in vars(buffer).items() if isinstance(v, np.ndarray)}, **observations})


# --- Advantages and value targets ---


@given(possible_rollouts, factors, factors)
def test_advantages_and_returns_are_sb3s(rollout: Rollout, gamma: float, gae_lambda: float) -> None:
    ours = filled(rollout, gamma, gae_lambda)
    theirs = filled_as_sb3_does(rollout, RolloutBuffer, gamma, gae_lambda)
    magnitudes = advantage_magnitudes(rollout, gamma, gae_lambda)
    assert_equal_to_rounding(ours.advantages, theirs.advantages.astype(np.float64), magnitudes)
    assert_equal_to_rounding(ours.returns, theirs.returns.astype(np.float64), magnitudes + np.abs(rollout.values))


@given(possible_rollouts, factors, factors)
def test_filled_by_sb3s_own_loop_it_gives_sb3s_advantages_bit_for_bit(
    rollout: Rollout, gamma: float, gae_lambda: float
) -> None:
    ours = filled_as_sb3_does(rollout, GAERolloutBuffer, gamma, gae_lambda)
    theirs = filled_as_sb3_does(rollout, RolloutBuffer, gamma, gae_lambda)
    assert np.array_equal(ours.advantages, theirs.advantages)
    assert np.array_equal(ours.returns, theirs.returns)
    # What SB3 has mixed cannot be taken apart again
    assert np.array_equal(ours.terminated, rollout.dones)
    assert not ours.truncated.any()


@given(possible_rollouts)
def test_rewards_endings_and_terminal_values_stay_as_they_came(rollout: Rollout) -> None:
    buffer = filled(rollout)
    for name in ("rewards", "terminated", "truncated", "dones", "last_values", "next_values"):
        assert np.array_equal(getattr(buffer, name), getattr(rollout, name))


@pytest.mark.parametrize("value_lambda", [None, 0.0, 0.4, 0.8, 1.0])
def test_value_targets_have_a_lambda_of_their_own(value_lambda: float | None) -> None:
    rollout = some_rollout()
    buffer = filled(rollout, 0.9, 0.8, value_lambda=value_lambda)
    expected = direct_advantages(rollout, 0.9, 0.8 if value_lambda is None else value_lambda) + rollout.values
    np.testing.assert_allclose(buffer.returns, expected, atol=1e-5)
    np.testing.assert_allclose(buffer.advantages, direct_advantages(rollout, 0.9, 0.8), atol=1e-5)
    buffer.advantages[...] = np.nan
    np.testing.assert_allclose(buffer.returns, expected, atol=1e-5)  # no memory in common


@given(possible_rollouts, st.lists(factors, min_size=1, max_size=3), st.lists(factors, min_size=1, max_size=3))
@settings(max_examples=30)
def test_grid_equals_fresh_buffers_with_those_settings(rollout: Rollout, gammas: list[float], lambdas: list[float]) -> None:
    grid = filled(rollout).advantage_grid(gammas, lambdas)
    assert grid.shape == (len(gammas), len(lambdas), *rollout.rewards.shape)
    for g, gamma in enumerate(gammas):
        for k, gae_lambda in enumerate(lambdas):
            fresh = filled(rollout, gamma, gae_lambda).advantages
            assert_equal_to_rounding(grid[g, k], fresh.astype(np.float64), advantage_magnitudes(rollout, gamma, gae_lambda))


def test_a_second_rollout_owes_nothing_to_the_first() -> None:
    first, second = some_rollout(seed=1), some_rollout(seed=2)
    buffer, fresh = filled(first), filled(second)
    buffer.reset()
    for t in range(len(second.rewards)):
        observation, action, reward, start, *_ = fill_step(buffer, second, t, second.rewards[t], second.values[t])
        buffer.add_step(observation, action, reward, start, second.dones[t], second.truncated[t])
    buffer.set_values(second.values, fresh.log_probs, second.bootstrap_values)
    buffer.compute_returns_and_advantage(th.tensor(second.last_values), second.dones[-1])
    assert np.array_equal(buffer.advantages, fresh.advantages)
    assert np.array_equal(buffer.dones, second.dones)


# --- Sweeps ---


def test_sweep_columns_are_what_their_names_say() -> None:
    rollout, gamma, lambdas = some_rollout(n_steps=20), 0.9, [0.0, 0.5, 0.95, 1.0]
    sweep = filled(rollout, gamma).lambda_sweep(lambdas)
    unbiased = direct_advantages(rollout, gamma, 1.0)
    for k, gae_lambda in enumerate(lambdas):
        advantages = direct_advantages(rollout, gamma, gae_lambda)
        targets = advantages + rollout.values
        assert sweep.gae_lambda[k] == gae_lambda
        assert sweep.mean_bias[k] == pytest.approx(np.mean(advantages - unbiased), abs=1e-6)
        assert sweep.rms_difference[k] == pytest.approx(np.sqrt(np.mean((advantages - unbiased) ** 2)), abs=1e-6)
        assert sweep.variance[k] == pytest.approx(np.mean((advantages - advantages.mean()) ** 2), rel=1e-5)
        assert sweep.effective_horizon[k] == pytest.approx(1 / (1 - gamma * gae_lambda))
        # What is left of the targets' variance around the values is that of the advantages
        assert sweep.explained_variance[k] == pytest.approx(1 - np.var(advantages) / np.var(targets), rel=1e-4)


def test_sweep_at_lambda_one_is_unbiased_exactly() -> None:
    sweep = filled(some_rollout()).lambda_sweep([1.0, 0.5])
    assert sweep.mean_bias[0] == sweep.rms_difference[0] == 0.0
    assert sweep.rms_difference[1] > 0.0


def test_sweep_takes_another_gamma_and_leaves_the_buffers_own() -> None:
    rollout = some_rollout()
    buffer = filled(rollout, gamma=0.9)
    other = filled(rollout, gamma=0.5).lambda_sweep([0.3, 1.0])
    for column, expected in zip(buffer.lambda_sweep(np.array([0.3, 1.0]), gamma=0.5), other, strict=True):
        assert np.array_equal(column, expected)
    assert buffer.gamma == 0.9


def test_sweep_of_constant_targets_has_no_explained_variance() -> None:
    rollout = some_rollout()
    rollout.rewards[...] = rollout.values[...] = rollout.bootstrap_values[...] = rollout.last_values[...] = 0.0
    sweep = filled(rollout).lambda_sweep([0.5])
    assert np.isnan(sweep.explained_variance).all()
    assert sweep.variance.tolist() == sweep.mean_bias.tolist() == [0.0]


@pytest.mark.parametrize("bad", [[], [1.1], [-0.1], [0.5, float("nan")], [[0.5]], 0.5])
def test_bad_grids_are_refused_by_name(bad: list[float]) -> None:
    buffer = filled(some_rollout())
    with pytest.raises(ValueError, match="gammas"):
        buffer.advantage_grid(bad, [0.5])
    with pytest.raises(ValueError, match="lambdas"):
        buffer.advantage_grid([0.5], bad)


@pytest.mark.parametrize("bad", [[1.1], [-0.1], [0.5, float("nan")]])
def test_bad_sweeps_are_refused(bad: list[float]) -> None:
    buffer = filled(some_rollout())
    with pytest.raises(ValueError, match=r"lambdas.*\[0, 1\]"):
        buffer.lambda_sweep(bad)
    with pytest.raises(ValueError, match=r"gammas.*\[0, 1\]"):
        buffer.lambda_sweep([0.5], gamma=bad[-1])


@pytest.mark.parametrize(
    "use",
    [
        lambda buffer: next(buffer.get()),
        lambda buffer: buffer.batch(),
        lambda buffer: buffer.advantage_grid([0.9], [0.9]),
        lambda buffer: buffer.lambda_sweep([0.9]),
    ],
)
def test_a_part_filled_buffer_is_refused_with_how_far_it_is(use) -> None:
    rollout = some_rollout(n_steps=4)
    buffer = GAERolloutBuffer(4, BOX, ACTIONS, n_envs=3, device="cpu")
    for t in range(3):
        observation, action, reward, start, *_ = fill_step(buffer, rollout, t, rollout.rewards[t], rollout.values[t])
        buffer.add_step(observation, action, reward, start, rollout.dones[t], rollout.truncated[t])
    with pytest.raises(ValueError, match="3 of 4 steps"):
        use(buffer)


# --- Samples ---


@pytest.mark.parametrize(
    ("buffer_class", "observation_space"), [(GAERolloutBuffer, BOX), (GAEDictRolloutBuffer, DICT)], ids=["vector", "dict"]
)
@pytest.mark.parametrize("batch_size", [None, 1, 4, 7, 18, 100])
def test_get_yields_each_sample_once_and_leaves_every_array_alone(
    buffer_class: type[GAERolloutBuffer], observation_space: spaces.Space, batch_size: int | None
) -> None:
    rollout = some_rollout()
    buffer = filled(rollout, buffer_class=buffer_class, observation_space=observation_space)
    before = arrays_of(buffer)
    minibatches = list(buffer.get(batch_size))
    n_samples, size = rollout.rewards.size, batch_size or rollout.rewards.size
    assert [len(minibatch.returns) for minibatch in minibatches[:-1]] == [size] * (len(minibatches) - 1)

    whole = buffer.batch()
    row_of = {round(log_prob.item(), 3): row for row, log_prob in enumerate(whole.old_log_prob)}
    seen = []
    for minibatch in minibatches:
        rows = [row_of[round(log_prob.item(), 3)] for log_prob in minibatch.old_log_prob]
        seen.extend(rows)
        for name in ("actions", "old_values", "advantages", "returns"):
            assert th.equal(getattr(minibatch, name), getattr(whole, name)[rows])
        for part, all_of_it in zip(observations_in(minibatch), observations_in(whole), strict=True):
            assert th.equal(part, all_of_it[rows])
    assert sorted(seen) == list(range(n_samples))

    after = arrays_of(buffer)
    assert before.keys() == after.keys()
    for name, array in before.items():
        assert array.shape == after[name].shape
        assert np.array_equal(array, after[name])


def observations_in(samples) -> list[th.Tensor]:
    return list(samples.observations.values()) if isinstance(samples.observations, dict) else [samples.observations]


def test_get_draws_a_new_order_each_time_and_the_same_under_a_seed() -> None:
    buffer = filled(some_rollout(n_steps=20))
    np.random.seed(0)
    first, second = (next(buffer.get()).returns for _ in range(2))
    np.random.seed(0)
    assert th.equal(next(buffer.get()).returns, first)
    assert not th.equal(first, second)


@pytest.mark.parametrize(
    ("buffer_class", "observation_space"), [(GAERolloutBuffer, BOX), (GAEDictRolloutBuffer, DICT)], ids=["vector", "dict"]
)
def test_batch_is_in_the_order_of_storage_time_first(
    buffer_class: type[GAERolloutBuffer], observation_space: spaces.Space
) -> None:
    rollout = some_rollout(n_steps=2, n_envs=3)
    buffer = filled(rollout, buffer_class=buffer_class, observation_space=observation_space)
    samples = buffer.batch()
    ids = th.tensor([0.0, 1, 2, 100, 101, 102])
    if isinstance(samples.observations, dict):
        assert th.equal(samples.observations["cell"].flatten(), ids.long() % 7)
    position = samples.observations["position"] if isinstance(samples.observations, dict) else samples.observations
    assert th.equal(position, th.stack([ids, -ids], dim=1))
    assert samples.actions.shape == (6, 1)
    for tensor, array in [
        (samples.old_values, rollout.values),
        (samples.advantages, buffer.advantages),
        (samples.returns, buffer.returns),
        (samples.old_log_prob, ids.numpy() / 1000),
    ]:
        assert tensor.dtype == th.float32
        assert np.array_equal(tensor.numpy(), array.flatten())


def test_discrete_observations_are_kept_as_whole_numbers() -> None:
    buffer = filled(some_rollout(n_steps=2), observation_space=spaces.Discrete(50))
    samples = buffer.batch()
    assert not samples.observations.is_floating_point()
    assert samples.observations.flatten().tolist() == [0, 1, 2, 0, 1, 2]


@pytest.mark.parametrize(
    ("action_space", "width"),
    [(spaces.MultiBinary(4), 4), (spaces.Discrete(5), 1), (spaces.MultiDiscrete([3, 4]), 2)],
)
def test_actions_of_any_space_arrive_as_floats(action_space: spaces.Space, width: int) -> None:
    buffer = filled(some_rollout(), action_space=action_space)
    for samples in (buffer.batch(), next(buffer.get())):
        assert samples.actions.shape == (18, width)
        assert samples.actions.dtype == th.float32
    assert np.array_equal(buffer.batch().actions.numpy(), buffer.actions.reshape(18, width))
    assert len(buffer.batch().actions.unique()) > 1


def test_dict_buffer_has_the_same_advantages_as_its_twin() -> None:
    rollout = some_rollout()
    plain = filled(rollout, value_lambda=1.0)
    twin = filled(rollout, buffer_class=GAEDictRolloutBuffer, observation_space=DICT, value_lambda=1.0)
    assert isinstance(twin, DictRolloutBuffer)
    assert np.array_equal(twin.advantages, plain.advantages)
    assert np.array_equal(twin.returns, plain.returns)
    assert np.array_equal(twin.advantage_grid([0.5, 1.0], [0.3]), plain.advantage_grid([0.5, 1.0], [0.3]))
    for column, expected in zip(twin.lambda_sweep([0.5]), plain.lambda_sweep([0.5]), strict=True):
        assert np.array_equal(column, expected)
