"""Files that are there as a whole, or not at all."""

import os
from pathlib import Path


def write_atomically(path: Path, content: bytes, temporary: Path) -> None:
    """
    After a crash at any moment there is the new file, or what was there before.

    :param path: of the file
    :param content: of the file
    :param temporary: a name in the same folder, for the time of writing
    :raises OSError: if it cannot be written; what was there before is still there
    """
    try:
        with temporary.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    _sync_folder(path.parent)


def _sync_folder(folder: Path) -> None:
    """Make a new name last, where the system can be asked to."""
    if os.name != "posix":
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
