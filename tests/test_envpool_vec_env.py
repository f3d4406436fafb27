"""EnvPool behind SB3's ``VecEnv``: transitions of gymnasium's MuJoCo tasks, and no step lost or made up."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from envpool_tasks import functions, pool
from envs_for_tests import small_model, train_once
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor, load_results
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecMonitor, VecNormalize

from sb3_gae import EnvPoolVecEnv

pytest.importorskip("envpool", reason="an optional extra: pip install 'sb3-gae[fast]'")

State = tuple[np.ndarray, np.ndarray]


def after(n_hidden: int, n_positions: int, n_velocities: int) -> Callable[[np.ndarray], State]:
    """Positions, less the first ones which nothing depends on, then velocities."""

    def state(observation: np.ndarray) -> State:
        positions, velocities = np.split(observation[: n_positions - n_hidden + n_velocities], [n_positions - n_hidden])
        return np.concatenate([np.zeros(n_hidden), positions]), velocities

    return state


def of_double_pendulum(observation: np.ndarray) -> State:
    return np.append(observation[0], np.arctan2(observation[1:3], observation[3:5])), observation[5:8]


def of_reacher(observation: np.ndarray) -> State:
    angles = np.arctan2(observation[2:4], observation[0:2])
    return np.concatenate([angles, observation[4:6]]), np.concatenate([observation[6:8], np.zeros(2)])


def of_pusher(observation: np.ndarray) -> State:
    # The object's slides run along y and x, from where the model has it
    object_ = observation[17:19] - (0.45, -0.05)
    return np.concatenate([observation[:7], object_[::-1], np.zeros(2)]), np.append(observation[7:14], np.zeros(4))


# How to read the physics' state from what is observed at the start of an episode
STATES: dict[str, Callable[[np.ndarray], State]] = {
    "Ant-v5": after(2, 15, 14),
    "HalfCheetah-v5": after(1, 9, 9),
    "Hopper-v5": after(1, 6, 6),
    "Humanoid-v5": after(2, 24, 23),
    "HumanoidStandup-v5": after(2, 24, 23),
    "InvertedDoublePendulum-v5": of_double_pendulum,
    "InvertedPendulum-v5": after(0, 2, 2),
    "Pusher-v5": of_pusher,
    "Reacher-v5": of_reacher,
    "Swimmer-v5": after(2, 5, 5),
    "Walker2d-v5": after(1, 9, 9),
}

# Nothing depends on them, and the twin begins elsewhere
PLACES = {"x_position", "y_position", "distance_from_origin"}

every_task = pytest.mark.parametrize("task", STATES)


def random_actions(env: VecEnv, rng: np.random.Generator) -> np.ndarray:
    space: Any = env.action_space
    return rng.uniform(space.low, space.high, (env.num_envs, *space.shape)).astype(np.float32)


class Twin:
    """Gymnasium's environment, put where the pool's begins its episodes."""

    def __init__(self, task: str, max_episode_steps: int):
        self.env = gym.make(task, max_episode_steps=max_episode_steps)
        self.state_of = STATES[task]

    def begin(self, observation: np.ndarray) -> None:
        self.env.reset()
        base: Any = self.env.unwrapped
        if hasattr(base, "goal"):
            base.goal = observation[4:6]
        base.set_state(*self.state_of(observation))
        np.testing.assert_allclose(base._get_obs(), observation, atol=1e-6)


# Numbers of these that are positions and velocities; contact forces follow, in newtons
IN_THREE_DIMENSIONS = {"Ant-v5": 13 + 14, "Humanoid-v5": 22 + 23, "HumanoidStandup-v5": 22 + 23}


def tolerances(task: str, size: int, step: int) -> tuple[np.ndarray, float]:
    """
    Of each observed number and of the reward, in the given step of an episode.

    EnvPool's MuJoCo is older, and solves many contacts at once to other digits, which soon make a difference.
    """
    if task not in IN_THREE_DIMENSIONS:
        return np.full(size, 1e-9), 1e-9
    of_states, of_forces, of_reward = (1e-4, 5e-3, 5e-5) if step == 0 else (1e-2, 3e-2, 1e-2)
    return np.where(np.arange(size) < IN_THREE_DIMENSIONS[task], of_states, of_forces), of_reward


@every_task
def test_transitions_are_gymnasium_s(task: str) -> None:
    """Over ends of both kinds: what follows one is the start of an episode, and not a step that EnvPool takes for it."""
    # Contacts in three dimensions soon make a large difference of a small one
    steps, limit = 60, 5 if task in IN_THREE_DIMENSIONS else 25
    env = pool(task, max_episode_steps=limit)
    twins = [Twin(task, limit) for _ in range(env.num_envs)]
    for twin, observation in zip(twins, env.reset(), strict=True):
        twin.begin(observation)
    rng, ends, lengths = np.random.default_rng(0), 0, [0] * env.num_envs
    for _ in range(steps):
        actions = random_actions(env, rng)
        observations, rewards, dones, infos = env.step(actions)
        for i, twin in enumerate(twins):
            expected, reward, terminated, truncated, info = twin.env.step(actions[i])
            found = infos[i]["terminal_observation"] if dones[i] else observations[i]
            tolerance, of_reward = tolerances(task, len(found), lengths[i])
            lengths[i] = 0 if dones[i] else lengths[i] + 1
            assert (np.abs(found - expected) <= tolerance * (1 + np.abs(expected))).all()
            # SB3's rewards have 32 bits
            np.testing.assert_allclose(rewards[i], reward, rtol=1e-6, atol=max(1e-6, of_reward))
            assert dones[i] == (terminated or truncated)
            assert infos[i]["TimeLimit.truncated"] == (truncated and not terminated)
            for name in info.keys() & infos[i].keys() - PLACES:
                np.testing.assert_allclose(infos[i][name], info[name], rtol=1e-6, atol=of_reward, err_msg=name)
            if dones[i]:
                twin.begin(observations[i])
                ends += 1
    assert ends >= 2 * env.num_envs


@every_task
def test_starts_are_of_gymnasium_s_distribution(task: str) -> None:
    n_starts = 150
    env = EnvPoolVecEnv([lambda: gym.make(task)] * 10, 1)
    env.seed(0)
    found = np.concatenate([env.reset() for _ in range(n_starts // 10)])
    twin = gym.make(task)
    expected = np.stack([twin.reset(seed=seed)[0] for seed in range(n_starts)])
    spread = expected.std(axis=0)
    np.testing.assert_allclose(found.mean(axis=0), expected.mean(axis=0), atol=1e-9 + 6.0 * spread.max() / np.sqrt(n_starts))
    moving = spread > 1e-6
    ratio = found.std(axis=0)[moving] / spread[moving]
    assert (np.abs(np.log(ratio)) < 0.4).all(), ratio
    assert (found.std(axis=0)[~moving] < 1e-5).all()


@every_task
def test_infos_have_gymnasium_s_names(task: str) -> None:
    found = pool(task)
    found.reset()
    expected = gym.make(task)
    expected.reset()
    gymnasium_s = set(expected.step(expected.action_space.sample())[4])
    own = set(found.step(random_actions(found, np.random.default_rng(0)))[3][0])
    # EnvPool has fewer, and for one task a term that is always 0
    assert own - {"TimeLimit.truncated", "reward_alive"} <= gymnasium_s


def test_an_end_in_the_step_of_the_time_limit_is_no_truncation() -> None:
    """As gymnasium and SB3 have it; EnvPool by itself calls it one."""
    env = pool("Hopper-v5", 1, max_episode_steps=1000)
    env.reset()
    n_steps = next(n for n in range(1, 200) if env.step(np.ones((1, 3)))[2][0])
    again = pool("Hopper-v5", 1, max_episode_steps=n_steps)
    again.reset()
    *_, dones, infos = [again.step(np.ones((1, 3))) for _ in range(n_steps)][-1]
    assert dones[0]
    assert infos[0]["TimeLimit.truncated"] is False


# Seeds


def trajectory(env: VecEnv, n_steps: int = 20, seed: int | None = 0) -> np.ndarray:
    if seed is not None:
        env.seed(seed)
    rng, first = np.random.default_rng(1), env.reset()
    return np.stack([first, *[env.step(random_actions(env, rng))[0] for _ in range(n_steps)]])


def test_a_seed_decides_the_trajectory_whatever_the_number_of_threads() -> None:
    expected = trajectory(pool("Walker2d-v5", 3))
    np.testing.assert_array_equal(trajectory(EnvPoolVecEnv(functions("Walker2d-v5", 3), 2)), expected)
    env = pool("Walker2d-v5", 3)
    trajectory(env, seed=5)
    np.testing.assert_array_equal(trajectory(env), expected)


def test_each_environment_has_a_seed_of_its_own() -> None:
    wide, narrow = pool("Swimmer-v5", 3, seed=7), pool("Swimmer-v5", 1, seed=9)
    starts = wide.reset()
    assert len(np.unique(starts[:, 0])) == 3
    np.testing.assert_array_equal(starts[2], narrow.reset()[0])


def test_seeds_count_for_one_reset() -> None:
    env = pool("Hopper-v5")
    first, second = env.reset(), env.reset()
    assert not np.array_equal(first, second)


def test_without_a_seed_starts_differ() -> None:
    first, second = (EnvPoolVecEnv(functions("Hopper-v5", 2), 1).reset() for _ in range(2))
    assert not np.array_equal(first, second)


@pytest.mark.parametrize("seed", [0, 2**31 - 2, 2**32 - 2])
def test_large_seeds_are_taken(seed: int) -> None:
    assert np.isfinite(pool("Hopper-v5", seed=seed).reset()).all()


# What SB3 expects


def test_what_was_returned_is_not_changed_by_later_steps() -> None:
    env, rng = pool("HalfCheetah-v5", max_episode_steps=3), np.random.default_rng(0)
    kept = [env.reset()]
    copies = [kept[0].copy()]
    for _ in range(10):
        observations, rewards, dones, _ = env.step(random_actions(env, rng))
        kept += [observations, rewards, dones]
        copies += [observations.copy(), rewards.copy(), dones.copy()]
    for array, copy in zip(kept, copies, strict=True):
        np.testing.assert_array_equal(array, copy)


def test_types_and_shapes_are_those_of_dummy_vec_env() -> None:
    env_fns = functions("Ant-v5", 2, max_episode_steps=2)
    results = []
    for env in (EnvPoolVecEnv(env_fns, 1), DummyVecEnv(env_fns)):
        observations = env.reset()
        env.step(np.zeros((2, 8)))
        results.append((observations, *env.step(np.zeros((2, 8)))))
        assert (env.reset_infos[0].keys() & {"x_position"}) == {"x_position"}
        assert env.get_attr("render_mode") == [None, None]
        assert env.env_is_wrapped(Monitor) == [True, True]
    for found, expected in zip(*[result[:4] for result in results], strict=True):
        assert (found.shape, found.dtype) == (expected.shape, expected.dtype)
    assert results[0][4][0].keys() == results[1][4][0].keys()


def test_monitor_files_are_sb3_s(tmp_path: Path) -> None:
    env = make_vec_env("Hopper-v5", 3, seed=0, monitor_dir=str(tmp_path), vec_env_cls=EnvPoolVecEnv)
    env.reset()
    expected, sums = [], np.zeros((2, 3))
    for _ in range(60):
        _, rewards, dones, infos = env.step(np.ones((3, 3)))
        sums += rewards, np.ones(3)
        for i in np.flatnonzero(dones):
            assert infos[i]["episode"]["l"] == sums[1, i]
            np.testing.assert_allclose(infos[i]["episode"]["r"], sums[0, i], rtol=1e-6)
            expected.append(infos[i]["episode"]["r"])
        sums[:, dones] = 0.0
    assert len(expected) > 3
    assert sorted(load_results(str(tmp_path))["r"]) == sorted(expected)
    returns = [episode for episodes in env.env_method("get_episode_rewards") for episode in episodes]
    np.testing.assert_allclose(sorted(returns), sorted(expected), atol=1e-6)


def test_early_resets_are_refused_where_monitor_refuses_them() -> None:
    env = EnvPoolVecEnv([lambda: Monitor(gym.make("Hopper-v5"), allow_early_resets=False)], 1)
    env.reset()
    env.step(np.zeros((1, 3)))
    with pytest.raises(RuntimeError, match="early resets"):
        env.reset()


def test_an_agent_trains_and_is_evaluated_on_it() -> None:
    env = VecNormalize(VecMonitor(EnvPoolVecEnv([lambda: gym.make("Hopper-v5")] * 4, 1)))
    model = small_model(env, n_steps=64)
    assert train_once(model)["train/is_line_search_success"] == 1.0
    mean, _ = evaluate_policy(model, env, n_eval_episodes=3)
    assert np.isfinite(mean)


@pytest.mark.parametrize("n_steps", [0, 1])
def test_numbers_that_blow_up_cut_the_episode(n_steps: int, monkeypatch: pytest.MonkeyPatch) -> None:
    env = pool("HalfCheetah-v5", 3, max_episode_steps=1000)
    before = env.reset()
    for _ in range(n_steps):
        before, *_ = env.step(np.zeros((3, 6)))
    results = env._pool.recv

    def with_nan(*args: Any, **kwargs: Any) -> Any:
        observations, *others = results(*args, **kwargs)
        observations = observations.copy()
        if len(observations) == 3:
            observations[1, 4] = np.nan
        return observations, *others

    monkeypatch.setattr(env._pool, "recv", with_nan)
    with pytest.warns(UserWarning, match="not finite"):
        env.step_async(np.zeros((3, 6)))
        observations, rewards, dones, infos = env.step_wait()
    assert dones.tolist() == [False, True, False]
    assert infos[1]["numerical_failure"] is True
    assert infos[1]["TimeLimit.truncated"] is True
    assert (infos[1]["reward_forward"], infos[1]["episode"]["l"], rewards[1]) == (0.0, n_steps + 1, 0.0)
    np.testing.assert_array_equal(infos[1]["terminal_observation"], before[1])
    assert np.isfinite(observations).all()
    assert env.numerical_failures == 1
