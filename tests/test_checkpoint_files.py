"""Checkpoint files survive what happens to files: damage, full disks, writes that fail."""

import errno
import os
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from resuming import STEPS, cart_poles, copy_of, differences, everything, steps_in, train

import sb3_gae.saving.checkpoint_callback
from sb3_gae import TRPOGAE, ResumableCheckpointCallback
from sb3_gae.saving.checkpoint_file import checkpoints_in, is_whole, read_checkpoint

# Damage


def damaged(content: bytes, kind: str, tenth: int) -> bytes:
    position = min(len(content) * tenth // 10, len(content) - 1)
    if kind == "truncated":
        return content[:position]
    return content[:position] + bytes([content[position] ^ 1]) + content[position + 1 :]


@pytest.mark.parametrize("tenth", range(11))
@pytest.mark.parametrize("kind", ["truncated", "flipped"])
def test_damage_is_found_and_the_checkpoint_before_is_used(kind: str, tenth: int, checkpoints: Path, tmp_path: Path) -> None:
    newest, second, _ = copy_of(checkpoints, tmp_path)
    newest.write_bytes(damaged(newest.read_bytes(), kind, tenth))
    with pytest.warns(UserWarning, match=rf"{newest.name} is damaged.*checksum is wrong\. The one before it is used"):
        model = TRPOGAE.resume(tmp_path, cart_poles())
    assert model.num_timesteps == 3 * STEPS
    with pytest.raises(ValueError, match="checksum is wrong"):
        TRPOGAE.resume(newest, cart_poles())
    assert second.exists()


def test_nothing_whole_is_an_error_and_no_whole_one_is_deleted_for_a_damaged_one(checkpoints: Path, tmp_path: Path) -> None:
    paths = copy_of(checkpoints, tmp_path)
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


def test_the_checksum_is_of_every_byte(checkpoints: Path) -> None:
    path = checkpoints_in(checkpoints)[0]
    content = read_checkpoint(path)
    damage = path.with_name("damaged.zip")
    for position in np.linspace(0, len(content) - 1, 50, dtype=int):
        damage.write_bytes(content[:position] + bytes([content[position] ^ 128]) + content[position + 1 :])
        assert not is_whole(damage)
    damage.unlink()


# Writing


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


def test_an_old_checkpoint_that_cannot_be_deleted_is_no_failure_of_the_new_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    written, real = [], sb3_gae.saving.checkpoint_callback.write_atomically

    def write(path: Path, *args: Any) -> None:
        written.append(path)
        real(path, *args)

    def refuse(path: Path, missing_ok: bool = False) -> None:
        raise PermissionError(errno.EPERM, "Operation not permitted")

    monkeypatch.setattr(sb3_gae.saving.checkpoint_callback, "write_atomically", write)
    with monkeypatch.context() as patch:
        patch.setattr(Path, "unlink", refuse)
        with pytest.warns(
            UserWarning, match=r"The old checkpoint .*_steps\.zip could not be deleted, and stays: .*not permitted"
        ) as found:
            train(tmp_path, 4, save_freq=64, keep=1)
    assert not [warning for warning in found if "could be written" in str(warning.message)]
    assert len(written) == len(set(written)) == 3, "each is written once, and when its time has come"
    assert steps_in(tmp_path) == [4, 2, 0]


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
