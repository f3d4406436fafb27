"""Models whose weights travel, and the files that they travel in."""

from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from envs_for_tests import SMALL, train_once, vec_env

from sb3_gae import TRPOGAE


def trained(**kwargs: Any) -> TRPOGAE:
    model = TRPOGAE("MlpPolicy", vec_env(), **({"n_steps": 16, "policy_kwargs": SMALL, "seed": 0} | kwargs))
    train_once(model)
    return model


def written(save: Callable[[Path], None]) -> bytes:
    """What is in a file that was saved so."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "model.zip"
        save(path)
        return path.read_bytes()


def load(content: bytes, folder: Path, **kwargs: Any) -> TRPOGAE:
    (folder / "file").write_bytes(content)
    return TRPOGAE.load_weights(folder / "file", vec_env(), **kwargs)
