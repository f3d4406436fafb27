"""Looks at a saved model before anything in it is executed or copied."""

import io
import json
import pathlib
import struct
import zipfile
import zlib

from stable_baselines3.common.save_util import open_path

#: an attribute that only models of this package have
_MARK = "vf_trust_region"


def check_saved_file(path: str | pathlib.Path | io.BufferedIOBase) -> None:
    """
    :param path: as for SB3's ``load``
    :raises ValueError: if the file is damaged, or was not saved by :class:`~sb3_gae.TRPOGAE`
    :raises FileNotFoundError: if there is none
    """
    file = open_path(path, "r", verbose=0, suffix="zip")
    try:
        names = _data_names(file)
    except (zipfile.BadZipFile, zlib.error, struct.error, KeyError, ValueError, EOFError, OSError, RuntimeError) as error:
        raise ValueError(f"{path} is damaged, or is not a model that SB3 saved: {error}") from error
    finally:
        if file is path:
            file.seek(0)
        else:
            file.close()
    if _MARK not in names:
        raise ValueError(
            f"{path} was saved by another algorithm than TRPOGAE. Load it with that one; "
            "`TRPOGAE(...).set_parameters(path)` takes over weights if the networks are the same."
        )


def _data_names(file: io.BufferedIOBase) -> set[str]:
    """Names of the attributes in the archive, after every member's checksum has been compared."""
    with zipfile.ZipFile(file) as archive:
        damaged = archive.testzip()
        if damaged is not None:
            raise zipfile.BadZipFile(f"the checksum of {damaged} is wrong")
        return set(json.loads(archive.read("data")))
