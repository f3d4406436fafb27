"""
Checkpoint files: sealed by a checksum, and found again.

A checkpoint is a model as SB3 saves it with one member more, the state of the training, and with a comment that is the
SHA-256 of everything before it. SB3 and rl-zoo3 load it as a model.
"""

import hashlib
import io
import os
import re
import warnings
import zipfile
from pathlib import Path

from stable_baselines3.common.base_class import BaseAlgorithm

_STATE = "training_state.pkl"
_SEAL = b"sha256:"
_DIGEST_LENGTH = 64


def checkpoint_content(model: BaseAlgorithm, state: bytes) -> bytes:
    """
    :param model: to be saved
    :param state: of the training
    :return: what to write into the file
    :raises OSError: if the clock stands before 1980, where zip files begin
    """
    memory = io.BytesIO()
    try:
        model.save(memory)
    except ValueError as error:
        if "timestamps" not in str(error):
            raise
        raise OSError(f"the clock of this machine stands at an impossible time ({error}).") from error
    with zipfile.ZipFile(memory, "a", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(zipfile.ZipInfo(_STATE), state, zipfile.ZIP_DEFLATED)
        # The length of the comment stands before it, so it must be there when the checksum is taken
        archive.comment = _SEAL + b"0" * _DIGEST_LENGTH
    sealed = memory.getvalue()[:-_DIGEST_LENGTH]
    return sealed + _digest(sealed)


def read_checkpoint(path: Path) -> bytes:
    """
    :param path: of a checkpoint
    :return: its content, after the checksum has been compared
    :raises ValueError: if it is damaged, or is no checkpoint
    """
    content = path.read_bytes()
    sealed, digest = content[:-_DIGEST_LENGTH], content[-_DIGEST_LENGTH:]
    if not sealed.endswith(_SEAL) or digest != _digest(sealed):
        raise ValueError(f"{path} is damaged, or is no checkpoint of ResumableCheckpointCallback: its checksum is wrong.")
    return content


def state_in(content: bytes) -> bytes:
    """
    :param content: of a checkpoint
    :return: the state of the training
    """
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        return archive.read(_STATE)


def checkpoint_path(folder: Path, name_prefix: str, num_timesteps: int) -> Path:
    """
    :param folder: of the checkpoints
    :param name_prefix: common to them
    :param num_timesteps: that the model has learnt from
    :return: the name that SB3's ``CheckpointCallback`` gives, which rl-zoo3 knows
    """
    return folder / f"{name_prefix}_{num_timesteps}_steps.zip"


def timesteps_of(path: Path) -> int:
    """
    :param path: of a checkpoint
    :return: the number in its name, -1 if there is none
    """
    found = re.search(r"_(\d+)_steps\.zip$", path.name)
    return int(found[1]) if found else -1


def checkpoints_in(folder: Path, name_prefix: str | None = None) -> list[Path]:
    """
    :param folder: to look into
    :param name_prefix: of the checkpoints; None for any
    :return: what has the name of a checkpoint, newest first
    """
    prefix = ".+" if name_prefix is None else re.escape(name_prefix)
    named = [path for path in folder.glob("*_steps.zip") if re.fullmatch(rf"{prefix}_\d+_steps\.zip", path.name)]
    return sorted(named, key=timesteps_of, reverse=True)


def is_whole(path: Path) -> bool:
    """
    :param path: of what may be a checkpoint
    :return: whether it is one, and undamaged
    """
    try:
        read_checkpoint(path)
    except (ValueError, OSError):
        return False
    return True


def newest_checkpoint(path: str | os.PathLike[str]) -> tuple[Path, bytes]:
    """
    :param path: of a checkpoint, or of a folder with several
    :return: path and content of the newest that is whole, with a warning for each newer one that is not
    :raises FileNotFoundError: if there is none
    :raises ValueError: if none is whole
    """
    place = Path(path)
    if not place.exists():
        raise FileNotFoundError(f"There is no checkpoint, nor a folder of checkpoints, at {place}.")
    if not place.is_dir():
        return place, read_checkpoint(place)
    candidates = checkpoints_in(place)
    for candidate in candidates:
        try:
            return candidate, read_checkpoint(candidate)
        except (ValueError, OSError) as error:
            warnings.warn(f"{error} The one before it is used.", stacklevel=3)
    if candidates:
        raise ValueError(f"None of the {len(candidates)} checkpoints in {place} is whole.")
    raise FileNotFoundError(f"There is no checkpoint in {place}: no name ends with a number and `_steps.zip`.")


def _digest(content: bytes) -> bytes:
    return hashlib.sha256(content).hexdigest().encode()
