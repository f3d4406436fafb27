"""From where a run can go on."""

from pathlib import Path
from typing import NamedTuple


class Checkpoint(NamedTuple):
    """
    :param path: of its file
    :param steps: of training until then
    """

    path: Path
    steps: int
