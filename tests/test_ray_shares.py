"""Batches that workers share, with workers in this process: what is collected, learnt, lost and continued."""

import functools
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from envs_for_tests import SMALL, AnySpacesEnv, BadNumberEnv, Endless
from gymnasium import spaces
from local_crew import LocalCrew
from resuming import differences, everything
from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.monitor import Monitor, load_results
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    VecEnv,
    VecFrameStack,
    VecNormalize,
    VecTransposeImage,
)

from sb3_gae import TRPOGAE, MujocoVecEnv, NumericalError, RayVecEnv, ResumableCheckpointCallback, WorkersLostError
from sb3_gae.workers.ray_vec_env import parts_of, share_seed

STEPS = 3 * 16
DICT = spaces.Dict({"a": spaces.Box(-1.0, 1.0, (3,), np.float32), "b": spaces.Box(-1.0, 1.0, (2,), np.float32)})
IMAGE = spaces.Box(0, 255, (36, 36, 1), np.uint8)


@pytest.fixture(autouse=True)
def local_workers(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr("sb3_gae.workers.ray_vec_env.Crew", LocalCrew)
    monkeypatch.setattr(LocalCrew, "to_lose", set())
    monkeypatch.setattr(LocalCrew, "gone", set())
    yield


def on_workers(
    make: Callable[[], gym.Env] | str = "CartPole-v1", n_workers: int = 2, n_envs: int = 3, **kwargs: Any
) -> VecEnv:
    return make_vec_env(make, n_envs, vec_env_cls=RayVecEnv, vec_env_kwargs={"n_workers": n_workers, **kwargs})  # type: ignore[arg-type]


def make_model(env: VecEnv, **kwargs: Any) -> TRPOGAE:
    policy = "MultiInputPolicy" if isinstance(env.observation_space, spaces.Dict) else "MlpPolicy"
    return TRPOGAE(policy, env, **({"n_steps": STEPS // 3, "policy_kwargs": SMALL, "seed": 3} | kwargs))


def trained(env: VecEnv, callback: BaseCallback | None = None, iterations: int = 2, **kwargs: Any) -> dict[str, Any]:
    found = everything(make_model(env, **kwargs).learn(iterations * STEPS, callback=callback))
    if isinstance(observations := found["_last_obs"], dict):
        found |= {"_last_obs": 0.0} | {f"_last_obs {key}": part for key, part in observations.items()}
    return found


class DrawAsWorkers(BaseCallback):
    """Gives a rollout in this process the random numbers of the first worker."""

    def _on_rollout_start(self) -> None:
        seed = share_seed(int(th.randint(2**62, ())), 0)
        self.of_the_learner = th.get_rng_state()
        th.manual_seed(seed)

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        th.set_rng_state(self.of_the_learner)


@pytest.mark.parametrize(
    ("make", "settings"),
    [
        ("CartPole-v1", {}),
        ("GaeCartPole-v0", {}),
        ("Pendulum-v1", {"use_sde": True, "sde_sample_freq": 3}),
        (functools.partial(AnySpacesEnv, DICT), {}),
        ("CartPole-v1", {"n_episodes": 1, "n_steps": 60}),
        ("CartPole-v1", {"gae_lambda": "auto", "normalize_advantage": False}),
    ],
    ids=["discrete", "batched", "gSDE", "Dict", "whole episodes", "lambda from measurement"],
)
def test_one_worker_is_this_process_with_other_random_numbers(make: Any, settings: dict[str, Any]) -> None:
    here = trained(make_vec_env(make, 3), DrawAsWorkers(), **settings)
    there = trained(on_workers(make, n_workers=1), **settings)
    assert differences(here, there) == []


def test_episodes_whose_end_a_wrapper_hides_are_in_the_mean() -> None:
    env = make_vec_env(AnySpacesEnv, 3, wrapper_class=Endless, vec_env_cls=RayVecEnv, vec_env_kwargs={"n_workers": 2})  # type: ignore[arg-type]
    model = make_model(env).learn(STEPS)
    assert [info["l"] for info in model.ep_info_buffer or ()] == [5] * 9


@pytest.mark.parametrize("make", ["CartPole-v1", "GaeCartPole-v0"])
def test_the_same_seeds_and_workers_give_the_same_training(make: str) -> None:
    one, other = (trained(VecNormalize(on_workers(make))) for _ in range(2))
    assert differences(one, other) == []
    assert differences(one, trained(VecNormalize(on_workers(make)), seed=4)) != []


def test_workers_draw_different_numbers_and_environments_have_the_seeds_of_one_process() -> None:
    env = on_workers("Pendulum-v1", n_envs=2)
    model = make_model(env)
    np.testing.assert_array_equal(env.reset(), make_model(make_vec_env("Pendulum-v1", 2)).env.reset())  # type: ignore[union-attr]
    model.learn(STEPS)
    actions = model.rollout_buffer.actions
    assert not np.isclose(actions[:, 0], actions[:, 1]).any()


@pytest.mark.parametrize("lost", [("collect", 1), ("collect", 0), ("reset", 1), ("ask", 1)])
@pytest.mark.parametrize("settings", [{}, {"n_episodes": 1, "n_steps": 60}])
def test_a_lost_share_is_collected_again_and_nothing_else_changes(lost: tuple[str, int], settings: dict[str, Any]) -> None:
    class Lose(BaseCallback):
        def _on_step(self) -> bool:
            return True

        def _on_rollout_end(self) -> None:
            if self.num_timesteps <= STEPS:
                LocalCrew.to_lose.add(lost)
            self.training_env.get_attr("spec")

    expected = trained(VecNormalize(on_workers()), **settings)
    assert differences(expected, trained(VecNormalize(on_workers()), Lose(), **settings)) == []
    assert not LocalCrew.to_lose or lost[0] == "reset"


class SilentEnv(AnySpacesEnv):
    """Cannot say where it is."""

    def __init__(self) -> None:
        super().__init__()
        self.secret = (number for number in range(3))


def test_environments_that_cannot_say_where_they_are_begin_new_episodes() -> None:
    LocalCrew.to_lose.add(("collect", 1))
    with pytest.warns(UserWarning, match="worker 1 could not say where they were"):
        one = trained(on_workers(SilentEnv))
    LocalCrew.to_lose.add(("collect", 1))
    with pytest.warns(UserWarning):
        assert differences(one, trained(on_workers(SilentEnv))) == []


def test_a_checkpoint_continues_bit_for_bit(tmp_path: Path) -> None:
    make_env = lambda: VecNormalize(on_workers("GaeCartPole-v0"))  # noqa: E731
    expected = trained(make_env(), iterations=4)
    make_model(make_env()).learn(2 * STEPS, callback=ResumableCheckpointCallback(1, tmp_path))
    model = TRPOGAE.resume(tmp_path, make_env())
    model.learn(2 * STEPS, reset_num_timesteps=False)
    assert differences(expected, everything(model)) == []
    with pytest.raises(ValueError, match="`n_workers` must be that of the checkpoint, 2, but is 1"):
        TRPOGAE.resume(tmp_path, VecNormalize(on_workers("GaeCartPole-v0", n_workers=1)))


@pytest.mark.parametrize("settings", [{}, {"n_episodes": 1, "n_steps": 60}])
def test_without_ray_the_training_ends_with_a_checkpoint_and_goes_on_from_it(tmp_path: Path, settings: dict[str, Any]) -> None:
    class Stop(BaseCallback):
        def _on_step(self) -> bool:
            return True

        def _on_rollout_end(self) -> None:
            if self.model._n_updates == 1:
                LocalCrew.gone.add("collect")

    expected = trained(VecNormalize(on_workers()), iterations=4, **settings)
    callbacks = CallbackList([ResumableCheckpointCallback(10**6, tmp_path), Stop()])
    with pytest.raises(WorkersLostError, match=r"^Ray is gone\. Make environments anew, and continue with TRPOGAE\.resume\('"):
        make_model(VecNormalize(on_workers()), **settings).learn(4 * STEPS, callback=callbacks)
    LocalCrew.gone.clear()
    model = TRPOGAE.resume(tmp_path, VecNormalize(on_workers()))
    model.learn(model.remaining_timesteps, reset_num_timesteps=False)
    assert differences(expected, everything(model)) == []


@pytest.mark.parametrize("save_freq", [1, 10**6])
def test_a_state_that_only_lost_workers_knew_is_no_checkpoint_and_the_one_before_is_named(
    save_freq: int, tmp_path: Path
) -> None:
    class MarkAndLose(BaseCallback):
        def _on_step(self) -> bool:
            return True

        def _on_rollout_end(self) -> None:
            if self.num_timesteps == 2 * STEPS:
                self.training_env.set_attr("mark", 1)
                LocalCrew.gone.update(("collect", "state"))

    callbacks = CallbackList([ResumableCheckpointCallback(save_freq, tmp_path), MarkAndLose()])
    last = STEPS if save_freq == 1 else 0
    with pytest.raises(WorkersLostError, match=rf"continue with TRPOGAE\.resume\('.*_{last}_steps\.zip', env\)\.$") as error:
        make_model(on_workers()).learn(4 * STEPS, callback=callbacks)
    said = "Ray is gone. No checkpoint could be written: only the workers knew where the environments stood. Make "
    assert str(error.value).startswith(said)
    LocalCrew.gone.clear()
    assert TRPOGAE.resume(tmp_path, on_workers()).num_timesteps == last


def test_without_a_callback_the_error_says_that_there_is_no_checkpoint() -> None:
    LocalCrew.gone.add("collect")
    with pytest.raises(WorkersLostError, match="No checkpoint was written"):
        trained(on_workers())


class Raw(BaseCallback):
    """Keeps what environments gave."""

    def __init__(self) -> None:
        super().__init__()
        self.rewards: list[np.ndarray] = []
        self.infos: list[dict[str, Any]] = []
        self.shown: list[np.ndarray] = []

    def _on_step(self) -> bool:
        self.rewards.append(self.locals["rewards"])
        self.shown.append(self.locals["new_obs"])
        self.infos.extend(info for info, done in zip(self.locals["infos"], self.locals["dones"], strict=True) if done)
        return True


def test_the_batch_is_seen_with_the_statistics_of_its_beginning_and_adds_all_of_it() -> None:
    env = VecNormalize(on_workers("Pendulum-v1"))
    model = make_model(env)
    model.learn(STEPS)
    before = env.obs_rms.copy()  # type: ignore[union-attr]
    keep = Raw()
    model.learn(STEPS, keep, reset_num_timesteps=False)
    shown = np.concatenate(keep.shown).astype(np.float64)
    raw = shown * np.sqrt(before.var + env.epsilon) + before.mean
    assert (np.abs(shown) < env.clip_obs).all()
    after = env.obs_rms
    before.update(raw)
    np.testing.assert_allclose(after.mean, before.mean, rtol=1e-5, atol=1e-6)  # type: ignore[union-attr]
    np.testing.assert_allclose(after.var, before.var, rtol=1e-5)  # type: ignore[union-attr]
    assert after.count == before.count  # type: ignore[union-attr]


def test_the_first_batch_is_seen_as_it_is() -> None:
    """The first moments of episodes say nothing of what follows."""
    env = VecNormalize(on_workers("CartPole-v1"), norm_reward=False)
    keep = Raw()
    model = make_model(env)
    model.learn(STEPS, keep)
    np.testing.assert_array_equal(np.concatenate(keep.rewards), 1.0)
    plain = make_model(on_workers("CartPole-v1"))
    also = Raw()
    plain.learn(STEPS, also)
    np.testing.assert_allclose(np.concatenate(keep.shown), np.concatenate(also.shown), rtol=1e-6)


def test_images_are_transposed_by_workers() -> None:
    env = on_workers(functools.partial(AnySpacesEnv, IMAGE), n_envs=2)
    model = TRPOGAE("CnnPolicy", env, n_steps=8, seed=0, policy_kwargs={"features_extractor_kwargs": {"features_dim": 8}})
    assert isinstance(model.get_env(), VecTransposeImage)
    model.learn(16)
    assert model.rollout_buffer.observations.shape[2:] == (1, 36, 36)


def test_images_that_are_to_stay_as_they_are_do_so_on_workers() -> None:
    env = VecTransposeImage(on_workers(functools.partial(AnySpacesEnv, IMAGE), n_envs=2), skip=True)
    model = TRPOGAE("MlpPolicy", env, n_steps=8, seed=0, policy_kwargs=SMALL)
    assert model.get_env() is env
    model.learn(16)
    assert model.rollout_buffer.observations.shape[2:] == (36, 36, 1)


def test_callbacks_see_each_step_and_can_end_the_training() -> None:
    keep = Raw()
    model = make_model(on_workers(AnySpacesEnv))
    model.learn(STEPS, keep)
    assert len(keep.rewards) == STEPS // 3 and keep.rewards[0].shape == (3,)
    assert all(info["episode"]["l"] == 5 and "terminal_observation" in info for info in keep.infos) and keep.infos
    assert len(model.ep_info_buffer) == len(keep.infos)  # type: ignore[arg-type]
    before = {name: tensor.clone() for name, tensor in model.policy.state_dict().items()}
    model.learn(10 * STEPS, callback=lambda locals_, globals_: model.num_timesteps < 6)
    assert model.num_timesteps == 6
    assert all(th.equal(tensor, before[name]) for name, tensor in model.policy.state_dict().items())
    model.learn(STEPS, reset_num_timesteps=False)


def test_bad_numbers_are_found_by_workers_and_named_as_in_one_process() -> None:
    makers = [AnySpacesEnv, AnySpacesEnv, functools.partial(BadNumberEnv, "reward", float("nan"), 4)]
    with pytest.raises(NumericalError, match="The reward contains NaN at step 3 of the rollout in environment 2"):
        trained(RayVecEnv(makers, n_workers=2))


def test_monitor_files_of_a_lost_worker_go_on(tmp_path: Path) -> None:
    env = make_vec_env(AnySpacesEnv, 2, monitor_dir=str(tmp_path), vec_env_cls=RayVecEnv, vec_env_kwargs={"n_workers": 2})  # type: ignore[arg-type]
    model = make_model(env, n_steps=10)
    model.learn(20)
    assert len(load_results(str(tmp_path))) == 4
    LocalCrew.to_lose.add(("collect", 0))
    model.learn(20, reset_num_timesteps=False)
    # Two more of each, and those of the share that was lost
    assert len(load_results(str(tmp_path))) == 4 + 4 + 2


def test_it_is_a_vec_env() -> None:
    env = on_workers("CartPole-v1", n_workers=2, n_envs=3)
    reference = make_vec_env("CartPole-v1", 3)
    for vec_env in (env, reference):
        vec_env.seed(7)
    np.testing.assert_array_equal(env.reset(), reference.reset())
    for _ in range(40):
        actions = np.array([0, 1, 1])
        for mine, theirs in zip(env.step(actions), reference.step(actions), strict=True):
            if isinstance(mine, np.ndarray):
                np.testing.assert_array_equal(mine, theirs)
            else:
                assert [info.keys() for info in mine] == [info.keys() for info in theirs]
    env.set_attr("mark", 5, indices=[2])
    env.env_method("reset", indices=0)
    assert env.get_attr("mark", indices=2) == [5]
    env.set_attr("mark", 3, indices=[0])
    assert env.get_attr("mark", [2, 0]) == [5, 3]
    assert env.env_is_wrapped(Monitor) == [True] * 3
    assert env.get_attr("render_mode") == ["rgb_array"] * 3
    assert len(env.get_images()) == 3
    env.close()


@pytest.mark.parametrize(
    ("n_envs", "n_workers", "sizes"), [(4, 2, [2, 2]), (5, 2, [3, 2]), (7, 3, [3, 2, 2]), (3, 3, [1, 1, 1])]
)
def test_the_first_workers_have_one_more(n_envs: int, n_workers: int, sizes: list[int]) -> None:
    parts = parts_of(range(n_envs), n_workers)
    assert [len(part) for part in parts] == sizes
    assert [env for part in parts for env in part] == list(range(n_envs))


@pytest.mark.parametrize(
    ("env", "n_envs"),
    [("CartPole-v1", 2), (lambda: gym.make("CartPole-v1"), 2), (lambda: make_vec_env("CartPole-v1", 3), 6)],
    ids=["id", "environment", "VecEnv"],
)
def test_rollout_workers_make_environments(env: Any, n_envs: int) -> None:
    model = TRPOGAE("MlpPolicy", env, rollout_workers=2, n_steps=12, policy_kwargs=SMALL, seed=0).learn(12 * n_envs)
    assert model.n_envs == n_envs and isinstance(model.get_env(), RayVecEnv)
    assert model.get_env().env_is_wrapped(Monitor) == [True] * n_envs  # type: ignore[union-attr]
    assert TRPOGAE("MlpPolicy", model.get_env(), rollout_workers=2).n_envs == n_envs  # type: ignore[arg-type]


def test_batched_environments_are_batched_on_workers() -> None:
    env = on_workers("GaeCartPole-v0")
    assert {type(worker._env) for worker in env._crew._workers} == {MujocoVecEnv}  # type: ignore[attr-defined]
    env = on_workers("GaeCartPole-v0", vec_env_cls=DummyVecEnv)
    assert {type(worker._env) for worker in env._crew._workers} == {DummyVecEnv}  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("make", "error"),
    [
        (lambda: make_model(make_vec_env("CartPole-v1", 2), rollout_workers=2), "`rollout_workers` = 2 needs an `env` that"),
        (lambda: make_model(on_workers(), rollout_workers=3), "`rollout_workers` = 3, but `env` is on 2 workers"),
        (lambda: TRPOGAE("MlpPolicy", "CartPole-v1", rollout_workers=0), "`rollout_workers` must be a whole number"),
        (lambda: on_workers(n_workers=4), "`n_workers` = 4 must not be more than the environments, which are 3"),
        (lambda: on_workers(cpus_per_worker=0), "`cpus_per_worker` must be a whole number"),
        (lambda: trained(VecFrameStack(on_workers(), 2)), "VecFrameStack around a RayVecEnv would not see"),
        (lambda: trained(VecNormalize(VecNormalize(on_workers()))), "VecNormalize must stand directly around"),
        (
            lambda: TRPOGAE("MlpPolicy", lambda: VecNormalize(make_vec_env("CartPole-v1")), rollout_workers=1),
            "Workers must not normalize by themselves",
        ),
    ],
)
def test_what_cannot_be_is_refused(make: Callable[[], Any], error: str) -> None:
    with pytest.raises(ValueError, match=error):
        make()
