"""Callbacks are called as by SB3's PPO, and those of SB3 work."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from envs_for_tests import SMALL, AnySpacesEnv, differing, short_model, state_of, train_once, vec_env
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import (
    BaseCallback,
    CallbackList,
    CheckpointCallback,
    EvalCallback,
    EveryNTimesteps,
    StopTrainingOnMaxEpisodes,
    StopTrainingOnRewardThreshold,
)
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from sb3_gae import TRPOGAE


def small_ppo(env: Any = None) -> PPO:
    return PPO("MlpPolicy", env or vec_env(), n_steps=8, batch_size=16, n_epochs=1, policy_kwargs=SMALL, seed=0)


class Recorder(BaseCallback):
    """Every call, with the counters that a callback can see then."""

    def __init__(self, stop_at: float = math.inf):
        super().__init__()
        self.stop_at = stop_at
        self.events: list[tuple[str, int, int]] = []

    def note(self, event: str) -> None:
        self.events.append((event, self.n_calls, self.model.num_timesteps))

    def _on_training_start(self) -> None:
        self.note("training start")

    def _on_rollout_start(self) -> None:
        self.note("rollout start")

    def _on_step(self) -> bool:
        self.note("step")
        return self.model.num_timesteps < self.stop_at

    def _on_rollout_end(self) -> None:
        self.note("rollout end")

    def _on_training_end(self) -> None:
        self.note("training end")


@pytest.mark.parametrize("stop_at", [math.inf, 16, 22])
@pytest.mark.parametrize("total", [1, 16, 40])
def test_callbacks_are_called_as_by_ppo(total: int, stop_at: float) -> None:
    def events(model: OnPolicyAlgorithm) -> list[tuple[str, int, int]]:
        recorder = Recorder(stop_at)
        model.learn(total, callback=recorder)
        return recorder.events

    ours = events(short_model())
    assert ours == events(small_ppo())
    assert ours[0][0] == "training start" and ours[-1][0] == "training end"
    assert sum(event == "rollout end" for event, *_ in ours) == (min(total + 15, stop_at - 1)) // 16


def test_a_callback_that_stops_leaves_the_policy_as_it_is() -> None:
    model = short_model()
    before = state_of(model.policy)
    model.learn(1000, callback=lambda locals_, globals_: model.num_timesteps < 6)
    assert model.num_timesteps == 6
    assert differing(before, state_of(model.policy)) == []


def test_learning_goes_on_after_a_stop() -> None:
    model = short_model()
    model.learn(1000, callback=Recorder(stop_at=22))
    assert train_once(model)["train/n_updates"] == 2
    assert model.num_timesteps == 22 + 16


class LocalsAtStep(BaseCallback):
    """What a callback finds in ``self.locals``."""

    def _on_step(self) -> bool:
        self.at_step = dict(self.locals)
        return True

    def _on_rollout_end(self) -> None:
        self.at_end = dict(self.locals)


def test_callbacks_find_what_ppo_shows_them_but_for_values_that_are_computed_later() -> None:
    ours, theirs = LocalsAtStep(), LocalsAtStep()
    model = short_model()
    model.learn(16, callback=ours)
    small_ppo().learn(16, callback=theirs)
    # Values and log-probabilities of the whole rollout are computed at once at its end
    assert theirs.at_step.keys() - ours.at_step.keys() <= {"obs_tensor", "values", "log_probs", "idx", "done", "terminal_obs"}
    for name in ("new_obs", "rewards", "dones", "actions", "clipped_actions"):
        mine, expected = ours.at_step[name], theirs.at_step[name]
        assert (mine.shape, mine.dtype) == (expected.shape, expected.dtype), name
    assert ours.at_step["n_rollout_steps"] == theirs.at_step["n_rollout_steps"] == 8
    assert len(ours.at_step["infos"]) == 2
    assert ours.at_step["self"] is model
    assert ours.at_step["rollout_buffer"] is model.rollout_buffer
    assert ours.at_step["env"] is model.get_env()
    assert ours.at_step["callback"] is ours
    assert ours.at_step["n_steps"] == 7 and ours.at_end["n_steps"] == 8, "steps that are over, as PPO counts them"
    assert (theirs.at_step["n_steps"], theirs.at_end["n_steps"]) == (7, 8)


@pytest.mark.parametrize("shape", [(2,), (2, 2)])
def test_actions_that_callbacks_see_have_the_shape_that_ppo_shows(shape: tuple[int, ...]) -> None:
    def seen(make_model: Any) -> tuple[int, ...]:
        callback = LocalsAtStep()
        env = vec_env(lambda: AnySpacesEnv(action_space=spaces.Box(-1.0, 1.0, shape, np.float32)))
        make_model(env).learn(16, callback=callback)
        return callback.at_step["actions"].shape

    assert seen(short_model) == seen(small_ppo)


def test_a_full_buffer_awaits_the_end_of_a_rollout() -> None:
    full = []

    class Look(BaseCallback):
        def _on_step(self) -> bool:
            return True

        def _on_rollout_end(self) -> None:
            buffer = self.locals["rollout_buffer"]
            full.append(buffer.full and np.isfinite(buffer.advantages).all() and (buffer.advantages != 0).all())

    short_model().learn(32, callback=Look())
    assert full == [True, True]


def test_eval_callback_saves_the_best_model(tmp_path: Path) -> None:
    callback = EvalCallback(
        Monitor(AnySpacesEnv()),
        n_eval_episodes=2,
        eval_freq=8,
        best_model_save_path=str(tmp_path),
        log_path=str(tmp_path),
        verbose=0,
        warn=False,
    )
    model = short_model()
    model.learn(32, callback=callback)
    evaluations = np.load(tmp_path / "evaluations.npz")
    assert evaluations["timesteps"].tolist() == [16, 32]
    assert callback.best_mean_reward == pytest.approx(evaluations["results"].mean(axis=1).max())
    assert type(TRPOGAE.load(tmp_path / "best_model.zip")) is TRPOGAE


def test_evaluation_in_the_middle_of_a_rollout_changes_nothing() -> None:
    def trained(callback: BaseCallback | None) -> dict[str, th.Tensor]:
        model = short_model()
        model.learn(32, callback=callback)
        return state_of(model.policy)

    evaluation = EvalCallback(Monitor(AnySpacesEnv()), n_eval_episodes=1, eval_freq=3, verbose=0, warn=False)
    assert differing(trained(None), trained(evaluation)) == []


def test_checkpoints_can_be_loaded(tmp_path: Path) -> None:
    model = short_model()
    model.learn(48, callback=CheckpointCallback(save_freq=8, save_path=str(tmp_path), name_prefix="agent"))
    assert sorted(file.name for file in tmp_path.iterdir()) == [f"agent_{steps}_steps.zip" for steps in (16, 32, 48)]
    loaded = TRPOGAE.load(tmp_path / "agent_32_steps.zip", env=vec_env())
    # Taken at the last step of a rollout, before its update
    assert (loaded.num_timesteps, loaded._n_updates) == (32, 1)
    train_once(loaded)


def test_lists_of_callbacks_and_callbacks_in_callbacks_work() -> None:
    inner, outer = Recorder(), Recorder()
    short_model().learn(64, callback=CallbackList([outer, EveryNTimesteps(32, inner)]))
    assert sum(event == "step" for event, *_ in outer.events) == 32
    assert [steps for event, _, steps in inner.events if event == "step"] == [32, 64]


def test_training_stops_at_a_number_of_episodes() -> None:
    model = short_model()
    model.learn(1000, callback=StopTrainingOnMaxEpisodes(max_episodes=2))
    assert model.num_timesteps == 2 * 2 * 5, "two episodes of 5 steps in each of two environments"


def test_training_stops_at_a_reward() -> None:
    stop = StopTrainingOnRewardThreshold(reward_threshold=-1e9)
    evaluation = EvalCallback(Monitor(AnySpacesEnv()), stop, n_eval_episodes=1, eval_freq=5, verbose=0, warn=False)
    model = short_model()
    model.learn(1000, callback=evaluation)
    assert model.num_timesteps == 10


def test_a_trained_model_can_be_evaluated() -> None:
    model = short_model()
    model.learn(32)
    rewards, lengths = evaluate_policy(model, Monitor(AnySpacesEnv()), n_eval_episodes=3, return_episode_rewards=True)
    assert lengths == [5, 5, 5] and np.isfinite(rewards).all()
