"""Our own keys of rl-zoo3's hyperparameter files, asked of the real ``ExperimentManager``."""

import argparse
import inspect
import re
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest
import rl_zoo3.train
import yaml
from local_crew import LocalCrew
from rl_zoo3.exp_manager import ExperimentManager
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.monitor import Monitor, load_results
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize, is_vecenv_wrapped

from sb3_gae import EnvPoolVecEnv, MujocoVecEnv, RayVecEnv, SharedMlpPolicy, zoo

TASK, ORDINARY = "GaeCartPole-v0", "CartPole-v1"
SETTINGS = {"n_timesteps": 64, "policy": "MlpPolicy", "n_envs": 2, "n_steps": 16, "policy_kwargs": "dict(net_arch=[8])"}


@pytest.fixture(autouse=True)
def registered() -> None:
    """Also where the start-up hook is switched off."""
    zoo.register()


def manager(
    folder: Path, env_id: str = TASK, hyperparams: Any = None, *, command_line_eval_freq: int = 32, **settings: Any
) -> ExperimentManager:
    """
    As ``rl_zoo3.train`` makes it.

    :param hyperparams: of the command line
    :param command_line_eval_freq: ``--eval-freq``
    :param settings: of the file, besides the usual ones
    """
    config = folder / "settings.yml"
    config.write_text(yaml.dump({env_id: SETTINGS | settings}))
    return ExperimentManager(
        argparse.Namespace(),
        zoo.ALGO,
        env_id,
        str(folder / "logs"),
        hyperparams=hyperparams,
        config=str(config),
        eval_freq=command_line_eval_freq,
        n_eval_episodes=1,
        log_interval=1,
        verbose=0,
    )


def set_up(experiment: ExperimentManager) -> tuple[Any, Any]:
    """
    Let it make the model.

    :return: the model, and the innermost environment that it is evaluated on
    """
    made = experiment.setup_experiment()
    assert made is not None
    (evaluation,) = [callback for callback in experiment.callbacks if isinstance(callback, EvalCallback)]
    return made[0], evaluation.eval_env.unwrapped


def kinds(experiment: ExperimentManager) -> tuple[type, type]:
    """The classes of the environments to train and to evaluate on."""
    model, eval_env = set_up(experiment)
    found = type(model.get_env().unwrapped), type(eval_env)
    model.get_env().close()
    eval_env.close()
    return found


def test_environments_to_train_on_are_batched_and_those_to_evaluate_on_are_not(tmp_path: Path) -> None:
    assert kinds(manager(tmp_path, batched_envs=True)) == (MujocoVecEnv, DummyVecEnv)


def test_gymnasium_s_mujoco_tasks_go_through_envpool_if_it_is_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("envpool")
    assert kinds(manager(tmp_path, "HalfCheetah-v5", batched_envs=True)) == (EnvPoolVecEnv, DummyVecEnv)
    monkeypatch.setitem(sys.modules, "envpool", None)
    assert kinds(manager(tmp_path, "HalfCheetah-v5", batched_envs=True)) == (DummyVecEnv, DummyVecEnv)


def test_nothing_is_batched_unasked(tmp_path: Path) -> None:
    assert kinds(manager(tmp_path)) == (DummyVecEnv, DummyVecEnv)


@pytest.mark.parametrize(("in_file", "expected"), [(True, DummyVecEnv), (False, MujocoVecEnv)])
def test_the_command_line_has_the_last_word(tmp_path: Path, in_file: bool, expected: type) -> None:
    experiment = manager(tmp_path, batched_envs=in_file, hyperparams={"batched_envs": not in_file})
    assert kinds(experiment) == (expected, DummyVecEnv)


def test_whoever_asks_for_subprocesses_gets_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    experiment = manager(tmp_path, batched_envs=True)
    experiment.vec_env_class = SubprocVecEnv
    made = []
    monkeypatch.setattr("rl_zoo3.exp_manager.make_vec_env", lambda *args, **kwargs: made.append(kwargs["vec_env_cls"]))
    with pytest.raises(AttributeError):
        experiment.setup_experiment()  # it goes no further than the stand-in
    experiment.vec_env_wrapper = None
    with pytest.raises(AttributeError):
        experiment.create_envs(2)
    assert made == [SubprocVecEnv] * 2


def test_ordinary_environments_are_made_as_ever(tmp_path: Path) -> None:
    assert kinds(manager(tmp_path, ORDINARY, batched_envs=True)) == (DummyVecEnv, DummyVecEnv)


@pytest.mark.parametrize("in_file", [True, False])
@pytest.mark.parametrize(("batched", "of_worker"), [(True, MujocoVecEnv), (False, DummyVecEnv)])
def test_workers_have_the_environments_to_train_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, in_file: bool, batched: bool, of_worker: type
) -> None:
    monkeypatch.setattr("sb3_gae.workers.ray_vec_env.Crew", LocalCrew)
    key = {"rollout_workers": 2}
    experiment = manager(tmp_path, batched_envs=batched, normalize=True, **(key if in_file else {"hyperparams": key}))
    model, eval_env = set_up(experiment)
    base = model.get_env().unwrapped
    assert type(base) is RayVecEnv and type(eval_env) is DummyVecEnv
    assert [type(worker._env) for worker in base._crew._workers] == [of_worker] * 2
    experiment.learn(model)
    assert model.num_timesteps == 64
    assert len(list(Path(experiment.save_path).glob("*.monitor.csv"))) == 2


@pytest.mark.parametrize("value", [0, "two", True])
def test_a_number_of_workers_that_is_none_is_refused(tmp_path: Path, value: Any) -> None:
    with pytest.raises(ValueError, match="`rollout_workers` must be a whole number of at least 1"):
        manager(tmp_path, rollout_workers=value).setup_experiment()


def test_workers_and_subprocesses_are_not_for_the_same_environments(tmp_path: Path) -> None:
    experiment = manager(tmp_path, rollout_workers=2)
    experiment.vec_env_class = SubprocVecEnv
    with pytest.raises(ValueError, match="leave out one of them"):
        experiment.setup_experiment()


def test_algorithms_that_take_each_step_themselves_have_no_workers(tmp_path: Path) -> None:
    experiment = manager(tmp_path, rollout_workers=2)
    experiment.algo = "ppo"
    with pytest.raises(ValueError, match="`rollout_workers` is for trpo_gae; ppo takes each step itself"):
        experiment.setup_experiment()


def test_a_wrapper_that_must_see_each_step_turns_batches_off(tmp_path: Path) -> None:
    experiment = manager(tmp_path, batched_envs=True, env_wrapper="stable_baselines3.common.atari_wrappers.ClipRewardEnv")
    assert kinds(experiment) == (DummyVecEnv, DummyVecEnv)


@pytest.mark.parametrize("value", ["yes", 1, None, 0])
def test_a_value_that_is_no_truth_value_is_refused(tmp_path: Path, value: Any) -> None:
    with pytest.raises(ValueError, match=f"`batched_envs` must be True or False, got {value!r}"):
        manager(tmp_path, batched_envs=value).setup_experiment()


def test_the_manager_is_left_as_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    experiment = manager(tmp_path, batched_envs=True)
    set_up(experiment)
    assert experiment.vec_env_class is DummyVecEnv

    def fail(*args: Any, **kwargs: Any) -> None:
        raise OSError("no environments today")

    monkeypatch.setattr("rl_zoo3.exp_manager.make_vec_env", fail)
    with pytest.raises(OSError, match="no environments today"):
        experiment.create_envs(1)
    assert experiment.vec_env_class is DummyVecEnv


def test_the_key_is_kept_with_the_other_settings(tmp_path: Path) -> None:
    """Whoever continues the training finds it in the folder of the trained agent."""
    experiment = manager(tmp_path, batched_envs=True)
    set_up(experiment)
    saved = yaml.unsafe_load((Path(experiment.params_path) / "config.yml").read_text())
    assert dict(saved)["batched_envs"] is True
    assert "batched_envs" not in experiment._hyperparams, "the algorithm does not know it"


def test_batched_training_goes_through_with_all_that_the_zoo_adds(tmp_path: Path) -> None:
    experiment = manager(tmp_path, batched_envs=True, normalize=True, env_kwargs={"largest_angle": 0.1})
    model, _ = set_up(experiment)
    env = model.get_env()
    assert type(env.unwrapped) is MujocoVecEnv
    assert is_vecenv_wrapped(env, VecNormalize)
    assert env.env_is_wrapped(Monitor) == [True, True]
    assert env.unwrapped.task.largest_angle == 0.1
    experiment.learn(model)
    experiment.save_trained_model(model)
    assert model.num_timesteps == 64
    folder = Path(experiment.save_path)
    assert {file.name for file in folder.glob("*.monitor.csv")} == {"0.monitor.csv", "1.monitor.csv"}
    assert len(load_results(str(folder))) > 0
    assert (Path(experiment.params_path) / "vecnormalize.pkl").is_file()
    assert (folder / f"{TASK}.zip").is_file()
    assert (folder / "evaluations.npz").is_file()


def test_registering_again_wraps_nothing_twice() -> None:
    before = ExperimentManager.create_envs, ExperimentManager._preprocess_hyperparams
    zoo.register()
    assert before == (ExperimentManager.create_envs, ExperimentManager._preprocess_hyperparams)
    assert TASK in gym.registry


def test_the_shared_policy_is_a_name_of_the_zoo(tmp_path: Path) -> None:
    experiment = manager(tmp_path, ORDINARY, policy="SharedMlpPolicy", vf_kl_fraction=0.1)
    model, _ = set_up(experiment)
    assert type(model.policy) is SharedMlpPolicy and model.vf_kl_fraction == 0.1
    experiment.learn(model)
    assert 0.0 < model.logger.name_to_value["train/vf_policy_kl"] <= 0.1 * model.target_kl


def steps_between_evaluations(experiment: ExperimentManager) -> list[int]:
    """Of all environments together; none if there is no evaluation."""
    made = experiment.setup_experiment()
    assert made is not None
    made[0].get_env().close()
    return [callback.eval_freq * 2 for callback in experiment.callbacks if isinstance(callback, EvalCallback)]


@pytest.mark.parametrize(
    ("in_file", "on_command_line", "expected"),
    [(500, 25_000, [500]), (500, 32, [32]), (500, -1, []), (None, 25_000, [25_000])],
)
def test_the_file_says_how_often_to_evaluate_unless_the_command_line_does(
    tmp_path: Path, in_file: int | None, on_command_line: int, expected: list[int]
) -> None:
    settings = {} if in_file is None else {"eval_freq": in_file}
    experiment = manager(tmp_path, command_line_eval_freq=on_command_line, **settings)
    assert steps_between_evaluations(experiment) == expected


@pytest.mark.parametrize("value", [0, -1, 1e6, "often", True])
def test_a_frequency_that_is_no_count_is_refused(tmp_path: Path, value: Any) -> None:
    experiment = manager(tmp_path, command_line_eval_freq=25_000, eval_freq=value)
    with pytest.raises(ValueError, match="`eval_freq` must be a whole number of at least 1"):
        experiment.setup_experiment()


def test_the_zoo_still_has_the_number_that_stands_for_none_given() -> None:
    source = Path(inspect.getsourcefile(rl_zoo3.train) or "").read_text()
    assert re.search(r'"--eval-freq",.*?default=25000', source, re.DOTALL)
