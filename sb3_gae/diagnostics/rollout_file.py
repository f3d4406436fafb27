"""
One rollout in a file: rewards, values, endings and projected scores, enough to redo the estimator with any γ and λ.

The file is NumPy's ``.npz`` and holds plain numbers and one name. Reading it executes nothing: pickled objects are refused,
and so is, before memory is taken for it, an array that is larger than it should be.
"""

import io
import pathlib
import struct
import zipfile
import zlib
from dataclasses import dataclass
from typing import IO

import numpy as np
from stable_baselines3.common.policies import ActorCriticPolicy

from sb3_gae.checks import check_number
from sb3_gae.diagnostics.projected_scores import projected_scores
from sb3_gae.rollout.evaluation import precision_of, training_batch
from sb3_gae.rollout.rollout_buffer import GAERolloutBuffer

FORMAT = "sb3-gae rollout 1"
MAX_BYTES = 64 * 2**20
N_DIMENSIONS = 48

# Kind of numbers and axes of each array
_ARRAYS = {
    "format": ("U", 0),
    "name": ("U", 0),
    "gamma": ("f", 0),
    "gae_lambda": ("f", 0),
    "rewards": ("f", 2),
    "values": ("f", 2),
    "next_values": ("f", 2),
    "dones": ("b", 2),
    "mask": ("b", 2),
    "scores": ("f", 2),
}
# What reading a damaged archive, or one that holds something else, may raise
_DAMAGE = (zipfile.BadZipFile, zlib.error, struct.error, EOFError, OSError, LookupError, ValueError, RuntimeError)


@dataclass(frozen=True)
class Rollout:
    r"""
    :param name: of what was recorded
    :param gamma: discount factor in training
    :param gae_lambda: weight of longer estimates in training
    :param rewards: as the environment gave them, shape (T, N)
    :param values: :math:`V(s_t)`, shape (T, N)
    :param next_values: see :func:`~sb3_gae.estimators.advantages.next_state_values`, shape (T, N)
    :param dones: whether the step was the last one of its episode, shape (T, N)
    :param mask: which steps belong to the batch, shape (T, N)
    :param scores: see :mod:`sb3_gae.diagnostics.projected_scores`, of the steps of the batch in the order of
        ``mask``, shape (B, n)
    :raises ValueError: if a factor is out of range, shapes do not fit, there are fewer than 2 steps, or a number is not finite
    """

    name: str
    gamma: float
    gae_lambda: float
    rewards: np.ndarray
    values: np.ndarray
    next_values: np.ndarray
    dones: np.ndarray
    mask: np.ndarray
    scores: np.ndarray

    def __post_init__(self) -> None:
        for name in ("gamma", "gae_lambda"):
            check_number(name, getattr(self, name), 0.0, 1.0)
        shape = self.rewards.shape
        for name in ("values", "next_values", "dones", "mask"):
            if getattr(self, name).shape != shape:
                raise ValueError(f"`{name}` must have the shape of `rewards`, {shape}, got {getattr(self, name).shape}.")
        n_samples = int(np.count_nonzero(self.mask))
        if n_samples < 2 or len(self.scores) != n_samples or not self.scores.shape[1]:
            raise ValueError(f"`scores` must have a row for each of the {n_samples} steps (at least 2) of `mask`.")
        for name in ("rewards", "values", "next_values", "scores"):
            if not np.isfinite(getattr(self, name)).all():
                raise ValueError(f"`{name}` must be finite.")


def record(policy: ActorCriticPolicy, rollout_buffer: GAERolloutBuffer, name: str, gae_lambda: float) -> Rollout:
    """
    :param policy: that collected the rollout, not updated since, in evaluation mode
    :param rollout_buffer: full
    :param name: of what is recorded
    :param gae_lambda: in training
    :return: what :func:`save_rollout` takes
    :raises ValueError: if the buffer is not full, ``gae_lambda`` is out of range, there are fewer than 2 steps, or a number is
        not finite
    """
    # A batch of whole episodes may fill a small part of its buffer
    n_steps = int(np.flatnonzero(rollout_buffer.mask.any(axis=1))[-1]) + 1
    belongs = rollout_buffer.mask[:n_steps].copy()
    arrays = rollout_buffer.rewards, rollout_buffer.values, rollout_buffer.next_values, rollout_buffer.dones
    rewards, values, next_values, dones = (np.where(belongs, array[:n_steps], 0).astype(array.dtype) for array in arrays)
    scores = projected_scores(policy, training_batch(rollout_buffer, policy.action_space, precision_of(policy)), N_DIMENSIONS)
    return Rollout(name, float(rollout_buffer.gamma), float(gae_lambda), rewards, values, next_values, dones, belongs, scores)


def save_rollout(rollout: Rollout, path: str | pathlib.Path) -> None:
    """
    :param rollout: to write; scores are rounded to half precision, in units of their root mean square
    :param path: of the file, which is replaced once the new one is written: a reader never sees half of it
    :raises OSError: if it cannot be written; what was there before is still there
    """
    scale = float(np.sqrt(np.square(rollout.scores).mean())) or 1.0
    # Half precision ends at 65 504
    scores = np.clip(rollout.scores / scale, -6e4, 6e4).astype(np.float16)
    arrays = {name: getattr(rollout, name) for name in _ARRAYS if name not in ("format", "scores")}
    place = pathlib.Path(path)
    temporary = place.with_name(f".{place.name}.tmp")
    try:
        with temporary.open("wb") as file:
            np.savez_compressed(file, format=np.array(FORMAT), scores=scores, **arrays)
        temporary.replace(place)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def load_rollout(source: str | pathlib.Path | bytes) -> Rollout:
    """
    :param source: path of a file, or what is in it
    :return: in double precision; scores are in units of their root mean square
    :raises ValueError: if it is damaged, too large, or no rollout, with the reason
    :raises FileNotFoundError: if there is no such file
    """
    if not isinstance(source, bytes):
        size = pathlib.Path(source).stat().st_size
        content = pathlib.Path(source).read_bytes() if size <= MAX_BYTES else b""
    else:
        size, content = len(source), source
    if size > MAX_BYTES:
        raise ValueError(f"The file must not exceed {MAX_BYTES // 2**20} MiB, got {size / 2**20:.0f}.")
    try:
        arrays = _read(content)
    except _DAMAGE as error:
        raise ValueError(f"This is not a rollout that sb3-gae saved, or it is damaged: {error}") from error
    if str(arrays["format"]) != FORMAT:
        raise ValueError(f"The file must have the format {FORMAT!r}, got {str(arrays['format'])[:40]!r}.")
    numbers = {name: array.astype(np.float64) for name, array in arrays.items() if _ARRAYS[name] == ("f", 2)}
    return Rollout(
        name=str(arrays["name"]),
        gamma=float(arrays["gamma"]),
        gae_lambda=float(arrays["gae_lambda"]),
        dones=arrays["dones"],
        mask=arrays["mask"],
        **numbers,
    )


def _read(content: bytes) -> dict[str, np.ndarray]:
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        sizes = {info.filename: info.file_size for info in archive.infolist()}
        missing = [name for name in _ARRAYS if f"{name}.npy" not in sizes]
        if missing:
            raise ValueError(f"it has no {', '.join(missing)}")
        if sum(sizes.values()) > MAX_BYTES:
            raise ValueError(f"it unpacks to more than {MAX_BYTES // 2**20} MiB")
        for name, (kind, n_axes) in _ARRAYS.items():
            with archive.open(f"{name}.npy") as member:
                _check_header(name, member, sizes[f"{name}.npy"], kind, n_axes)
    with np.load(io.BytesIO(content), allow_pickle=False) as file:
        return {name: file[name] for name in _ARRAYS}


def _check_header(name: str, member: IO[bytes], size: int, kind: str, n_axes: int) -> None:
    """Refuse what is not the array that it should be, by its description alone."""
    if np.lib.format.read_magic(member) != (1, 0):
        raise ValueError(f"{name} is not in NumPy's format 1.0")
    shape, _, dtype = np.lib.format.read_array_header_1_0(member)
    if dtype.kind != kind or len(shape) != n_axes:
        raise ValueError(f"{name} is of kind {dtype.kind!r} with {len(shape)} axes, and not of {kind!r} with {n_axes}")
    if int(np.prod(shape, dtype=object)) * dtype.itemsize > size:
        raise ValueError(f"{name} is shorter than it says")
