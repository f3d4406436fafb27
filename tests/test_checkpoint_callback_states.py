"""What a checkpoint holds beside the model: the state of other callbacks, and the log."""

from pathlib import Path
from typing import Any

import numpy as np
from resuming import STEPS, cart_poles, make_model, train
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback, EveryNTimesteps, StopTrainingOnNoModelImprovement

from sb3_gae import TRPOGAE, ResumableCheckpointCallback


class Counter(BaseCallback):
    """State of every plain kind, beside an argument."""

    def __init__(self, argument: int = 1):
        super().__init__()
        self.argument = argument
        self.seen: list[float] = []
        self.best = -np.inf
        self.table: dict[str, Any] = {}
        self.unknown: Any = None

    def _on_step(self) -> bool:
        self.seen.append(float(self.locals["rewards"].sum()))
        self.best, self.table = max(self.best, self.seen[-1]), {"last": (self.n_calls, np.float32(0.5), np.arange(2))}
        self.unknown = object()
        return True


def test_callbacks_go_on_with_their_state_and_with_the_arguments_that_they_are_given(tmp_path: Path) -> None:
    def callbacks(folder: Path, argument: int) -> list[BaseCallback]:
        return [Counter(argument), EveryNTimesteps(50, Counter(argument)), ResumableCheckpointCallback(1, folder)]

    whole = callbacks(tmp_path / "whole", 1)
    make_model(cart_poles()).learn(4 * STEPS, callback=whole)
    part = callbacks(tmp_path / "part", 1)
    make_model(cart_poles()).learn(2 * STEPS, callback=part)
    for stop_after in (1, 1):
        part = callbacks(tmp_path / "part", 2)
        resumed = TRPOGAE.resume(tmp_path / "part", cart_poles())
        resumed.learn(stop_after * STEPS, callback=part, reset_num_timesteps=False)
    for one, other in ((whole[0], part[0]), (whole[1].callback, part[1].callback)):  # type: ignore[attr-defined]
        assert one.n_calls == other.n_calls and one.seen == other.seen and one.best == other.best  # type: ignore[attr-defined]
        assert repr(one.table) == repr(other.table)  # type: ignore[attr-defined]
        assert (one.argument, other.argument) == (1, 2)  # type: ignore[attr-defined]
    assert whole[1].last_time_trigger == part[1].last_time_trigger > 0  # type: ignore[attr-defined]


def test_the_best_evaluation_is_remembered(tmp_path: Path) -> None:
    def evaluation() -> EvalCallback:
        patience = StopTrainingOnNoModelImprovement(100, min_evals=1)
        return EvalCallback(cart_poles(), callback_after_eval=patience, eval_freq=16, n_eval_episodes=1, verbose=0)

    first, second = evaluation(), evaluation()
    make_model(cart_poles()).learn(2 * STEPS, callback=[first, ResumableCheckpointCallback(1, tmp_path)])
    assert first.best_mean_reward > -np.inf
    resumed = TRPOGAE.resume(tmp_path, cart_poles())
    resumed.learn(0, callback=[second, ResumableCheckpointCallback(1, tmp_path)], reset_num_timesteps=False)
    assert second.best_mean_reward == first.best_mean_reward
    assert second.n_calls == first.n_calls
    assert second.callback.last_best_mean_reward == first.callback.last_best_mean_reward  # type: ignore[union-attr]


def test_what_was_recorded_and_not_yet_written_to_the_log_comes_back(tmp_path: Path) -> None:
    model = train(tmp_path, 2)
    resumed = TRPOGAE.resume(tmp_path, cart_poles())
    resumed.learn(0, callback=ResumableCheckpointCallback(1, tmp_path), reset_num_timesteps=False)
    assert resumed.logger.name_to_value == model.logger.name_to_value
    assert "train/kl_divergence_loss" in resumed.logger.name_to_value
