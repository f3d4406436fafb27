"""Checkpoint files survive what happens to files, and end with the training that asks for them."""

import errno
import os
import signal
import threading
import time
import warnings
from pathlib import Path
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
import pytest
from envs_for_tests import SMALL, differing, state_of
from resuming import STEPS, cart_poles, differences, everything, make_model
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import (
    BaseCallback,
    CallbackList,
    ConvertCallback,
    EvalCallback,
    EveryNTimesteps,
    StopTrainingOnNoModelImprovement,
)
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecFrameStack, VecMonitor, VecNormalize

import sb3_gae.saving.checkpoint_callback
from sb3_gae import TRPOGAE, ResumableCheckpointCallback
from sb3_gae.saving.checkpoint_file import checkpoints_in, is_whole, read_checkpoint


def train(folder: Path, iterations: int = 3, **kwargs: Any) -> TRPOGAE:
    model = make_model(cart_poles())
    return model.learn(
        iterations * STEPS, callback=ResumableCheckpointCallback(**({"save_freq": 1, "save_path": folder} | kwargs))
    )


def steps_in(folder: Path) -> list[int]:
    return [int(path.name.split("_")[-2]) // STEPS for path in checkpoints_in(folder)]


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the last three checkpoints of a training of four iterations; tests copy what they change."""
    folder = tmp_path_factory.mktemp("trained")
    train(folder, 4)
    return folder


def copy_of(folder: Path, to: Path) -> list[Path]:
    for path in folder.iterdir():
        (to / path.name).write_bytes(path.read_bytes())
    return checkpoints_in(to)


# When and where


def test_the_last_ones_are_kept(tmp_path: Path) -> None:
    train(tmp_path, 5, keep=2)
    assert steps_in(tmp_path) == [5, 4]
    assert [path.name for path in sorted(tmp_path.iterdir())] == ["rl_model_256_steps.zip", "rl_model_320_steps.zip"]


@pytest.mark.parametrize(("save_freq", "expected"), [(1, [4, 3, 2, 1, 0]), (33, [4, 2, 0]), (64, [4, 2, 0]), (1000, [4, 0])])
def test_save_freq_counts_calls_of_step_and_the_ends_are_always_saved(
    save_freq: int, expected: list[int], tmp_path: Path
) -> None:
    train(tmp_path, 4, save_freq=save_freq, keep=9)
    assert steps_in(tmp_path) == expected


def test_save_freq_goes_on_after_a_stop(tmp_path: Path) -> None:
    train(tmp_path, 1, save_freq=64, keep=9)
    model = TRPOGAE.resume(tmp_path, cart_poles())
    model.learn(4 * STEPS, callback=ResumableCheckpointCallback(64, tmp_path, keep=9), reset_num_timesteps=False)
    assert steps_in(tmp_path) == [5, 3, 1, 0]


def test_what_is_not_ours_is_left_alone(tmp_path: Path) -> None:
    """SB3's own checkpoints may have the same names."""
    foreign = tmp_path / "rl_model_1_steps.zip"
    make_model(cart_poles()).save(foreign)
    (tmp_path / "other_7_steps.zip").write_bytes(b"something else")
    train(tmp_path, 5, keep=1)
    assert {path.name for path in tmp_path.iterdir()} == {foreign.name, "other_7_steps.zip", "rl_model_320_steps.zip"}


def test_the_checkpoints_of_a_training_that_is_ahead_are_not_mixed_with(trained: Path, tmp_path: Path) -> None:
    copy_of(trained, tmp_path)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    with pytest.raises(ValueError, match=r"`save_path` = .* training that is ahead, such as rl_model_256_steps.*resume"):
        train(tmp_path)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_a_checkpoint_is_a_model_that_sb3_and_the_zoo_load(trained: Path) -> None:
    model = TRPOGAE.load(trained / "rl_model_256_steps.zip")
    assert model.num_timesteps == 4 * STEPS
    assert differing(state_of(model.policy), state_of(TRPOGAE.resume(trained, cart_poles()).policy)) == []


def test_a_training_in_which_another_callback_stops_goes_on_from_the_last_whole_iteration(tmp_path: Path) -> None:
    model = make_model(cart_poles())
    stop = lambda locals_, globals_: model.num_timesteps < 2 * STEPS + 10  # noqa: E731
    both = CallbackList([ResumableCheckpointCallback(1, tmp_path), ConvertCallback(stop)])
    model.learn(4 * STEPS, callback=both)
    assert steps_in(tmp_path) == [2, 1, 0]
    whole = everything(train(tmp_path / "whole", 4))
    resumed = TRPOGAE.resume(tmp_path, cart_poles())
    assert resumed.remaining_timesteps == 2 * STEPS
    resumed.learn(resumed.remaining_timesteps, reset_num_timesteps=False)
    assert differences(whole, everything(resumed)) == []


@pytest.mark.parametrize(("name", "value"), [("save_freq", 0), ("save_freq", 2.5), ("keep", 0), ("handle_signals", "no")])
def test_bad_arguments_are_refused(name: str, value: Any, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=f"`{name}` must be"):
        ResumableCheckpointCallback(**({"save_freq": 1, "save_path": tmp_path} | {name: value}))


def test_other_algorithms_are_refused(tmp_path: Path) -> None:
    with pytest.raises(TypeError, match="needs a TRPOGAE, got PPO"):
        PPO("MlpPolicy", cart_poles(), n_steps=32).learn(64, callback=ResumableCheckpointCallback(1, tmp_path))


def test_missing_checkpoints_are_missing_files(tmp_path: Path) -> None:
    for path in (tmp_path, tmp_path / "nothing", tmp_path / "nothing.zip"):
        with pytest.raises(FileNotFoundError, match="no checkpoint"):
            TRPOGAE.resume(path, cart_poles())


# Damage


def damaged(content: bytes, kind: str, tenth: int) -> bytes:
    position = min(len(content) * tenth // 10, len(content) - 1)
    if kind == "truncated":
        return content[:position]
    return content[:position] + bytes([content[position] ^ 1]) + content[position + 1 :]


@pytest.mark.parametrize("tenth", range(11))
@pytest.mark.parametrize("kind", ["truncated", "flipped"])
def test_damage_is_found_and_the_checkpoint_before_is_used(kind: str, tenth: int, trained: Path, tmp_path: Path) -> None:
    newest, second, _ = copy_of(trained, tmp_path)
    newest.write_bytes(damaged(newest.read_bytes(), kind, tenth))
    with pytest.warns(UserWarning, match=rf"{newest.name} is damaged.*checksum is wrong\. The one before it is used"):
        model = TRPOGAE.resume(tmp_path, cart_poles())
    assert model.num_timesteps == 3 * STEPS
    with pytest.raises(ValueError, match="checksum is wrong"):
        TRPOGAE.resume(newest, cart_poles())
    assert second.exists()


def test_nothing_whole_is_an_error_and_no_whole_one_is_deleted_for_a_damaged_one(trained: Path, tmp_path: Path) -> None:
    paths = copy_of(trained, tmp_path)
    for path in paths[:2]:
        path.write_bytes(path.read_bytes()[:-1])
    with pytest.warns(UserWarning, match="The one before it is used"):
        model = TRPOGAE.resume(tmp_path, cart_poles())
    callback = ResumableCheckpointCallback(1, tmp_path, keep=2)
    model.learn(STEPS, callback=callback, reset_num_timesteps=False)
    # The third iteration again, in the place of its damaged checkpoint
    assert [path for path in checkpoints_in(tmp_path) if is_whole(path)] == paths[1:]
    for path in checkpoints_in(tmp_path):
        path.write_bytes(b"")
    with pytest.warns(UserWarning), pytest.raises(ValueError, match="None of the 3 checkpoints"):
        TRPOGAE.resume(tmp_path, cart_poles())


# A full disk


@pytest.mark.parametrize("moment", ["write", "fsync", "replace"])
def test_a_full_disk_stops_nothing_and_the_last_good_one_stays(
    moment: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    expected = everything(train(tmp_path / "whole", 4))
    folder = tmp_path / "full"
    train(folder, 2)
    good = folder / f"rl_model_{2 * STEPS}_steps.zip"

    def full(*args: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        if moment == "write":
            real_open = Path.open
            patch.setattr(
                Path, "open", lambda path, mode: _Full(real_open(path, mode)) if mode == "wb" else real_open(path, mode)
            )
        elif moment == "fsync":
            patch.setattr(os, "fsync", full)
        else:
            patch.setattr(Path, "replace", full)
        model = TRPOGAE.resume(folder, cart_poles())
        with pytest.warns(UserWarning, match=r"No checkpoint could be written: .*No space left.*Training goes on"):
            model.learn(2 * STEPS, callback=ResumableCheckpointCallback(1, folder), reset_num_timesteps=False)
    assert differences(expected, everything(model)) == []
    assert checkpoints_in(folder)[0] == good and is_whole(good)
    assert not list(folder.glob(".*")), "no rest of an attempt"


def test_a_clock_before_1980_stops_nothing_and_the_last_good_one_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    expected = everything(train(tmp_path / "whole", 4))
    folder = tmp_path / "past"
    train(folder, 2)
    model = TRPOGAE.resume(folder, cart_poles())
    with monkeypatch.context() as patch:
        patch.setattr(time, "time", lambda: -1e9)
        with pytest.warns(UserWarning, match=r"No checkpoint could be written: the clock .*before 1980.*Training goes on"):
            model.learn(2 * STEPS, callback=ResumableCheckpointCallback(1, folder), reset_num_timesteps=False)
    assert differences(expected, everything(model)) == []
    assert checkpoints_in(folder)[0] == folder / f"rl_model_{2 * STEPS}_steps.zip"


class _Full:
    """A file on a full disk."""

    def __init__(self, file: Any):
        self._file = file

    def write(self, content: bytes) -> None:
        self._file.write(content[:100])
        raise OSError(errno.ENOSPC, "No space left on device")

    def __enter__(self) -> Any:
        return self

    def __exit__(self, *error: Any) -> None:
        self._file.close()


def test_a_write_that_failed_is_tried_again_in_the_next_iteration(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real, attempts = sb3_gae.saving.checkpoint_callback.write_atomically, []

    def second_fails(path: Path, *args: Any) -> None:
        attempts.append(path)
        if len(attempts) == 2:
            raise OSError(errno.ENOSPC, "No space left on device")
        real(path, *args)

    monkeypatch.setattr(sb3_gae.saving.checkpoint_callback, "write_atomically", second_fails)
    with pytest.warns(UserWarning, match="No checkpoint could be written"):
        train(tmp_path, 5, save_freq=64, keep=9)
    assert steps_in(tmp_path) == [5, 3, 0]


def test_what_is_written_is_read_before_another_is_deleted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A disk that says yes and writes something else."""
    real = sb3_gae.saving.checkpoint_callback.write_atomically
    train(tmp_path, 1, keep=1)

    def write_otherwise(path: Path, content: bytes, temporary: Path) -> None:
        real(path, damaged(content, "flipped", 5), temporary)

    monkeypatch.setattr(sb3_gae.saving.checkpoint_callback, "write_atomically", write_otherwise)
    model = TRPOGAE.resume(tmp_path, cart_poles())
    with pytest.warns(UserWarning, match="checksum is wrong"):
        model.learn(2 * STEPS, callback=ResumableCheckpointCallback(1, tmp_path, keep=1), reset_num_timesteps=False)
    assert [path.name for path in checkpoints_in(tmp_path) if is_whole(path)] == [f"rl_model_{STEPS}_steps.zip"]


def test_a_file_that_is_being_written_has_another_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = []
    real = os.fsync
    monkeypatch.setattr(
        os, "fsync", lambda file: (seen.append(sorted(path.name for path in tmp_path.iterdir())), real(file))[1]
    )
    train(tmp_path, 1)
    first, second = "rl_model_0_steps.zip", f"rl_model_{STEPS}_steps.zip"
    # The file, then its folder
    assert seen == [[".rl_model.tmp"], [first], [".rl_model.tmp", first], [first, second]]


# Signals


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


# What goes on beside the model


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


# Environments


def test_an_environment_that_is_built_otherwise_is_refused(trained: Path) -> None:
    with pytest.raises(ValueError, match="`env` must be made as that of the checkpoint, of 1 VecNormalize, 1 DummyVecEnv, 2"):
        TRPOGAE.resume(trained, make_vec_env("CartPole-v1", 2))
    with pytest.raises(ValueError, match="`env` must be made as that"):
        TRPOGAE.resume(trained, VecNormalize(make_vec_env("CartPole-v1", 3)))


@pytest.mark.parametrize("make", [lambda: SubprocVecEnv([lambda: gym.make("CartPole-v1")] * 2), lambda: boxes()])
def test_environments_that_cannot_say_where_they_are_begin_anew(make: Any, tmp_path: Path) -> None:
    def trained_on(resumed: bool) -> TRPOGAE:
        env = VecNormalize(make())
        try:
            if not resumed:
                return make_model(env).learn(2 * STEPS, callback=ResumableCheckpointCallback(1, tmp_path))
            with pytest.warns(UserWarning, match="has no state of the environments.*begin new episodes"):
                model = TRPOGAE.resume(tmp_path, env)
            statistics = everything(model)["obs_rms count"]
            model.learn(STEPS, callback=ResumableCheckpointCallback(1, tmp_path), reset_num_timesteps=False)
            assert everything(model)["obs_rms count"] > statistics > 2 * STEPS
            return model
        finally:
            env.close()

    first = trained_on(False)
    before = everything(first)
    second = trained_on(True)
    assert second.num_timesteps == 3 * STEPS and second._n_updates == 3
    assert before.keys() == everything(second).keys()


def boxes() -> DummyVecEnv:
    """Box2D cannot be pickled."""
    return DummyVecEnv([lambda: gym.make("LunarLander-v3")] * 2)


def test_new_episodes_can_be_asked_for_and_are_not_those_of_the_beginning(trained: Path) -> None:
    model = TRPOGAE.resume(trained, cart_poles(), force_reset=True)
    model.learn(0, reset_num_timesteps=False)
    anew = make_model(cart_poles())
    anew.learn(0)
    assert model.env is not None and anew.env is not None
    one, other = (env.get_original_obs() for env in (model.env, anew.env))  # type: ignore[attr-defined]
    assert not np.array_equal(one, other)
    assert model._last_episode_starts is not None and model._last_episode_starts.all()


@pytest.mark.filterwarnings("ignore:The environment is already wrapped")
def test_wrappers_of_all_kinds_go_on(tmp_path: Path) -> None:
    def make(folder: str) -> VecNormalize:
        (tmp_path / folder).mkdir(exist_ok=True)
        files = iter(range(9))
        one = lambda: Monitor(gym.make("CartPole-v1"), str(tmp_path / folder / str(next(files))))  # noqa: E731
        return VecNormalize(VecFrameStack(VecMonitor(DummyVecEnv([one] * 2)), 3))

    third = make("three")
    whole = make_model(make("one")).learn(4 * STEPS, callback=ResumableCheckpointCallback(1, tmp_path / "a"))
    make_model(make("two")).learn(2 * STEPS, callback=ResumableCheckpointCallback(1, tmp_path / "b"))
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        resumed = TRPOGAE.resume(tmp_path / "b", third)
    resumed.learn(2 * STEPS, reset_num_timesteps=False)
    assert differences(everything(whole), everything(resumed)) == []


class Cart(gym.Wrapper):
    """Speaks for itself."""

    calls: ClassVar[list[str]] = []

    def state_dict(self) -> dict[str, Any]:
        self.calls.append("asked")
        return {"answer": 42}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.calls.append(f"told {state}")


def test_an_environment_can_speak_for_itself(tmp_path: Path) -> None:
    make = lambda: DummyVecEnv([lambda: Cart(gym.make("CartPole-v1"))] * 2)  # noqa: E731
    Cart.calls.clear()
    make_model(make()).learn(STEPS, callback=ResumableCheckpointCallback(1000, tmp_path))
    TRPOGAE.resume(tmp_path, make())
    assert Cart.calls == ["asked"] * 4 + ["told {'answer': 42}"] * 2


def test_the_checksum_is_of_every_byte(trained: Path) -> None:
    path = checkpoints_in(trained)[0]
    content = read_checkpoint(path)
    damage = path.with_name("damaged.zip")
    for position in np.linspace(0, len(content) - 1, 50, dtype=int):
        damage.write_bytes(content[:position] + bytes([content[position] ^ 128]) + content[position + 1 :])
        assert not is_whole(damage)
    damage.unlink()


def test_saving_does_not_change_the_training(tmp_path: Path) -> None:
    model = make_model(cart_poles())
    model.learn(3 * STEPS)
    assert differences(everything(model), everything(train(tmp_path))) == []


def test_an_ordinary_environment_is_wrapped_as_for_a_new_model(tmp_path: Path) -> None:
    kwargs: Any = {"n_steps": 32, "policy_kwargs": SMALL, "seed": 0}
    model = TRPOGAE("MlpPolicy", "CartPole-v1", **kwargs)
    model.learn(32, callback=ResumableCheckpointCallback(1, tmp_path))
    resumed = TRPOGAE.resume(tmp_path, gym.make("CartPole-v1"))
    assert np.array_equal(resumed._last_obs, model._last_obs)  # type: ignore[arg-type]
