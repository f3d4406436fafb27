"""Looks at a saved model before anything in it is executed or copied."""

import io
import json
import lzma
import pathlib
import struct
import zipfile
import zlib

from stable_baselines3.common.save_util import open_path

#: an attribute that only models of this package have
_MARK = "vf_trust_region"

#: what reading a damaged archive may raise, and an archive that holds something else
_DAMAGE = (
    *(zipfile.BadZipFile, zlib.error, lzma.LZMAError, struct.error, EOFError, OSError),
    *(LookupError, ValueError, RuntimeError),
)


def check_saved_file(path: str | pathlib.Path | io.BufferedIOBase, own: bool = True) -> None:
    """
    :param path: as for SB3's ``load``
    :param own: whether it must come from :class:`~sb3_gae.TRPOGAE`, and not from any algorithm of SB3
    :raises ValueError: if the file is damaged, or was saved by another algorithm
    :raises FileNotFoundError: if there is none
    """
    file = open_path(path, "r", verbose=0, suffix="zip")
    position = file.tell()
    try:
        names = _data_names(file)
    except _DAMAGE as error:
        raise ValueError(f"{path} is damaged, or is not a model that SB3 saved: {error}") from error
    finally:
        if file is path:
            file.seek(position)
        else:
            file.close()
    if own and _MARK not in names:
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
        # Damage to the directory can hide a member
        for member in ("policy.pth", "policy.optimizer.pth"):
            archive.getinfo(member)
        data = json.loads(archive.read("data"))
    if not isinstance(data, dict):
        raise ValueError("its data is not a dictionary")
    return set(data)
