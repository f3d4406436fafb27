"""A signal ends training with a checkpoint, and handlers are given back."""

import signal
import threading
from pathlib import Path
from typing import Any

import pytest
from resuming import STEPS, cart_poles, differences, everything, make_model, steps_in, train
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, ConvertCallback

from sb3_gae import TRPOGAE, ResumableCheckpointCallback


class SignalAt(BaseCallback):
    """Sends signals to its own process in the middle of the second rollout."""

    def __init__(self, *signals: signal.Signals):
        super().__init__()
        self.signals = list(signals)

    def _on_step(self) -> bool:
        if self.model.num_timesteps == STEPS + 20:
            for number in self.signals:
                signal.raise_signal(number)
        return True


def stop(folder: Path, *signals: signal.Signals) -> TRPOGAE:
    model = make_model(cart_poles())
    callback = CallbackList([ResumableCheckpointCallback(1000, folder), SignalAt(*signals)])
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    kind = KeyboardInterrupt if signals[-1] == signal.SIGINT else SystemExit
    with pytest.raises(kind) as caught:
        model.learn(4 * STEPS, callback=callback)
    if kind is SystemExit:
        assert caught.value.code == 128 + signal.SIGTERM
    assert {number: signal.getsignal(number) for number in before} == before
    return model


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_training_after_the_iteration_with_a_checkpoint_and_a_message(
    number: signal.Signals, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    model = stop(tmp_path / "stopped", number)
    assert model.num_timesteps == 2 * STEPS and steps_in(tmp_path / "stopped") == [2, 0]
    printed, notice = capfd.readouterr()
    assert "ends after this iteration" in notice
    assert f"Stopped by {number.name} after {2 * STEPS} timesteps; {2 * STEPS} are left." in printed
    assert f"--trained-agent and the newest checkpoint in {tmp_path / 'stopped'}." in printed
    # What the message says, typed
    line, learn = [line.strip() for line in printed.splitlines() if line.startswith("    ")]
    names: dict[str, Any] = {"TRPOGAE": TRPOGAE, "env": cart_poles(), "callback": None, "everything": everything}
    # The state of the random generators counts too
    exec(f"{line}\n{learn}\nfound = everything(model)", names)
    assert differences(everything(train(tmp_path / "whole", 4)), names["found"]) == []


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_second_signal_counts_at_once(number: signal.Signals, tmp_path: Path) -> None:
    model = stop(tmp_path, signal.SIGTERM, number)
    assert model.num_timesteps == STEPS + 20 and steps_in(tmp_path) == [0]


def test_a_handler_of_the_user_gets_the_signal_after_the_checkpoint(tmp_path: Path) -> None:
    heard = []
    before = signal.signal(signal.SIGTERM, lambda *args: heard.append(steps_in(tmp_path)))
    try:
        make_model(cart_poles()).learn(
            3 * STEPS, callback=[ResumableCheckpointCallback(1, tmp_path), SignalAt(signal.SIGTERM)]
        )
    finally:
        signal.signal(signal.SIGTERM, before)
    assert heard == [[2, 1, 0]]


def test_a_signal_that_the_process_ignores_stays_ignored(tmp_path: Path) -> None:
    before = signal.signal(signal.SIGTERM, signal.SIG_IGN)
    try:
        model = make_model(cart_poles())
        model.learn(3 * STEPS, callback=[ResumableCheckpointCallback(1, tmp_path), SignalAt(signal.SIGTERM)])
    finally:
        signal.signal(signal.SIGTERM, before)
    assert model.num_timesteps == 3 * STEPS


def test_handlers_are_given_back_when_an_error_ends_training(tmp_path: Path) -> None:
    before = signal.getsignal(signal.SIGINT)
    model = make_model(cart_poles())

    def fail(locals_: Any, globals_: Any) -> bool:
        assert signal.getsignal(signal.SIGINT) is not before
        raise OSError("the environment is gone")

    with pytest.raises(OSError, match="gone"):
        model.learn(STEPS, callback=CallbackList([ResumableCheckpointCallback(1, tmp_path), ConvertCallback(fail)]))
    assert signal.getsignal(signal.SIGINT) is before


def test_signals_can_be_left_alone_and_are_in_other_threads(tmp_path: Path) -> None:
    before = signal.getsignal(signal.SIGINT)
    untouched = []
    watch = ConvertCallback(lambda locals_, globals_: untouched.append(signal.getsignal(signal.SIGINT) is before) or True)
    model = make_model(cart_poles())
    model.learn(STEPS, callback=[ResumableCheckpointCallback(1, tmp_path, handle_signals=False), watch])
    thread = threading.Thread(
        target=lambda: model.learn(
            STEPS, callback=[ResumableCheckpointCallback(1, tmp_path), watch], reset_num_timesteps=False
        )
    )
    thread.start()
    thread.join()
    assert model.num_timesteps == 2 * STEPS and all(untouched) and len(untouched) == 2 * STEPS // 2
