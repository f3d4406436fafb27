"""The sweep in the log."""

import signal
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, EvalCallback, EveryNTimesteps
from stable_baselines3.common.env_util import make_vec_env

from sb3_gae import (
    TRPOGAE,
    GAERolloutBuffer,
    GradientDiagnosticsCallback,
    LambdaSweepCallback,
    ResumableCheckpointCallback,
    SaveRolloutCallback,
)

LAMBDAS = (0.0, 0.9, 1.0)


class Record(BaseCallback):
    """Keeps what is in the log when a rollout has ended and been swept."""

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        self.logged = dict(self.logger.name_to_value)


def test_the_log_holds_every_quantity_for_every_lambda_as_the_buffer_gives_it() -> None:
    model = TRPOGAE("MlpPolicy", make_vec_env("CartPole-v1", 2, seed=0), n_steps=32, seed=0, device="cpu")
    sweep, record = LambdaSweepCallback(LAMBDAS), Record()
    model.learn(64, callback=[sweep, record])
    expected = model.rollout_buffer.lambda_sweep(LAMBDAS)
    assert sweep.sweep is not None
    for quantity in ("mean_bias", "rms_difference", "variance", "effective_horizon", "explained_variance"):
        np.testing.assert_allclose(getattr(sweep.sweep, quantity), getattr(expected, quantity))
        logged = [record.logged[f"sweep/{quantity}/lambda_{gae_lambda:g}"] for gae_lambda in LAMBDAS]
        np.testing.assert_allclose(logged, getattr(expected, quantity))


def test_works_with_another_algorithm_on_our_buffer() -> None:
    callback = LambdaSweepCallback(LAMBDAS)
    PPO("MlpPolicy", gym.make("CartPole-v1"), n_steps=64, rollout_buffer_class=GAERolloutBuffer, device="cpu").learn(
        64, callback
    )
    assert callback.sweep is not None


@pytest.mark.parametrize("callback", [LambdaSweepCallback, GradientDiagnosticsCallback])
@pytest.mark.parametrize("bad", [{"lambdas": [0.5, 1.5]}, {"lambdas": ["a"]}, {"lambdas": []}, {"gamma": 1.5}])
def test_bad_factors_are_refused_before_a_rollout(callback: Any, bad: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=f"`{next(iter(bad))}` must be"):
        callback(**bad)


CALLBACKS = {
    "sweep": lambda folder: LambdaSweepCallback(LAMBDAS),
    "diagnostics": lambda folder: GradientDiagnosticsCallback(LAMBDAS),
    "rollouts": lambda folder: SaveRolloutCallback(folder / "rollout.npz"),
    "checkpoints": lambda folder: ResumableCheckpointCallback(1, folder),
}
OUTER = {
    "EveryNTimesteps": lambda inner, env: EveryNTimesteps(8, inner),
    "EvalCallback": lambda inner, env: EvalCallback(env, callback_after_eval=inner, eval_freq=8, verbose=0),
    "list in EvalCallback": lambda inner, env: EvalCallback(env, callback_after_eval=CallbackList([inner]), verbose=0),
    "new best": lambda inner, env: EvalCallback(env, callback_on_new_best=inner, eval_freq=8, verbose=0),
    "list of lists": lambda inner, env: CallbackList([CallbackList([Record(), EveryNTimesteps(8, inner)])]),
}


@pytest.mark.filterwarnings("ignore:.*not wrapped with a")
@pytest.mark.parametrize("what", CALLBACKS)
@pytest.mark.parametrize("outer", OUTER)
def test_callbacks_of_rollouts_are_refused_where_they_would_not_hear_of_them(outer: str, what: str, tmp_path: Path) -> None:
    model = TRPOGAE("MlpPolicy", make_vec_env("CartPole-v1", 2, seed=0), n_steps=16, device="cpu")
    callback = OUTER[outer](CALLBACKS[what](tmp_path), make_vec_env("CartPole-v1", 1))
    with pytest.raises(ValueError, match=r"Callback must stand beside (EveryNTimesteps|EvalCallback), not in it"):
        model.learn(32, callback)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_callbacks_of_rollouts_stand_beside_others(tmp_path: Path) -> None:
    model = TRPOGAE("MlpPolicy", make_vec_env("CartPole-v1", 2, seed=0), n_steps=16, device="cpu")
    inner = [make(tmp_path) for make in CALLBACKS.values()]
    model.learn(32, [EveryNTimesteps(8, Record()), CallbackList(inner)])
    assert {path.suffix for path in tmp_path.iterdir()} == {".npz", ".zip"}


def test_says_which_buffer_it_needs() -> None:
    with pytest.raises(TypeError, match=r"GAERolloutBuffer, got RolloutBuffer"):
        PPO("MlpPolicy", gym.make("CartPole-v1"), n_steps=64, device="cpu").learn(64, LambdaSweepCallback(LAMBDAS))


@pytest.mark.parametrize("kind", [LambdaSweepCallback, GradientDiagnosticsCallback])
@pytest.mark.parametrize("lambdas", [[1 - 2.0**-k for k in range(1, 9)], [0.9999991, 0.9999992]])
def test_many_digits_do_not_end_training(kind: Any, lambdas: list[float], capsys: pytest.CaptureFixture[str]) -> None:
    """SB3's table would cut the keys to the same and refuse them."""
    callback, record = kind(lambdas), Record()
    env = make_vec_env("CartPole-v1", 2, seed=0)
    model = TRPOGAE("MlpPolicy", env, n_steps=64, seed=0, device="cpu", verbose=1)
    model.learn(128, callback=[callback, record])
    assert "iterations" in capsys.readouterr().out
    quantities = {key.rpartition("/")[0] for key in record.logged if "/lambda_" in key}
    assert len([key for key in record.logged if "/lambda_" in key]) == len(quantities) * len(lambdas)
