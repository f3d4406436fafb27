"""When and where checkpoints are written, which of them are kept, and what the callback refuses."""

import copy
import pickle
from pathlib import Path
from typing import Any

import pytest
from envs_for_tests import differing, state_of
from resuming import STEPS, cart_poles, copy_of, differences, everything, make_model, steps_in, train
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import CallbackList, ConvertCallback

from sb3_gae import TRPOGAE, ResumableCheckpointCallback


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


@pytest.mark.parametrize("prefix", ["rl_model", "another"])
def test_the_checkpoints_of_a_training_that_is_ahead_are_not_mixed_with(
    prefix: str, checkpoints: Path, tmp_path: Path
) -> None:
    """Whatever their names: `resume` of the folder takes the newest."""
    copy_of(checkpoints, tmp_path)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    with pytest.raises(ValueError, match=r"`save_path` = .* training that is ahead, such as rl_model_256_steps.*resume"):
        train(tmp_path, name_prefix=prefix)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_what_kept_training_from_starting_is_not_hidden_behind_its_end(checkpoints: Path, tmp_path: Path) -> None:
    """rl-zoo3 tells callbacks of the end of training in a `finally`."""
    ResumableCheckpointCallback(1, tmp_path).on_training_end()
    copy_of(checkpoints, tmp_path)
    model, callback = make_model(cart_poles()), ResumableCheckpointCallback(1, tmp_path)
    with pytest.raises(ValueError, match="--trained-agent"):
        model.learn(STEPS, callback=callback)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    callback.on_training_end()
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


@pytest.mark.parametrize("env", ["CartPole-v1", None])
def test_a_training_that_made_its_environment_of_an_id_goes_on_with_the_id(env: str | None, tmp_path: Path) -> None:
    model = TRPOGAE("MlpPolicy", "CartPole-v1", n_steps=STEPS, seed=0, device="cpu")
    model.learn(2 * STEPS, callback=ResumableCheckpointCallback(1, tmp_path))
    if env is None:
        with pytest.raises(ValueError, match="`env` must be an environment"):
            TRPOGAE.resume(tmp_path, env)  # type: ignore[arg-type]
    else:
        assert TRPOGAE.resume(tmp_path, env).num_timesteps == 2 * STEPS


def test_a_checkpoint_is_a_model_that_sb3_and_the_zoo_load(checkpoints: Path) -> None:
    model = TRPOGAE.load(checkpoints / "rl_model_256_steps.zip")
    assert model.num_timesteps == 4 * STEPS
    assert differing(state_of(model.policy), state_of(TRPOGAE.resume(checkpoints, cart_poles()).policy)) == []


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


def test_a_callback_may_copy_the_model(tmp_path: Path) -> None:
    """As for self-play, or to keep the best one in memory."""
    copies: list[TRPOGAE] = []

    def keep(locals_: dict[str, Any], globals_: dict[str, Any]) -> bool:
        model = locals_["self"]
        copies[:] = [copy.deepcopy(model), pickle.loads(pickle.dumps(model))]
        return True

    model = make_model(cart_poles())
    model.learn(2 * STEPS, callback=[ResumableCheckpointCallback(64, tmp_path), ConvertCallback(keep)])
    assert len(copies) == 2
    for duplicate in copies:
        before = state_of(duplicate.policy)
        # `VecNormalize` is not one to be copied with its environments
        duplicate.set_env(cart_poles())
        duplicate.learn(STEPS)
        assert differing(before, state_of(duplicate.policy)) != []


def test_other_algorithms_are_refused(tmp_path: Path) -> None:
    with pytest.raises(TypeError, match="needs a TRPOGAE, got PPO"):
        PPO("MlpPolicy", cart_poles(), n_steps=32).learn(64, callback=ResumableCheckpointCallback(1, tmp_path))


def test_missing_checkpoints_are_missing_files(tmp_path: Path) -> None:
    for path in (tmp_path, tmp_path / "nothing", tmp_path / "nothing.zip"):
        with pytest.raises(FileNotFoundError, match="no checkpoint"):
            TRPOGAE.resume(path, cart_poles())


def test_saving_does_not_change_the_training(tmp_path: Path) -> None:
    model = make_model(cart_poles())
    model.learn(3 * STEPS)
    assert differences(everything(model), everything(train(tmp_path))) == []
