"""Whether environments that were made apart are the same."""

from typing import Any

import mujoco
import numpy as np


def serialized(model: mujoco.MjModel) -> bytes:
    """
    :param model: of the physics
    :return: all that it consists of
    """
    buffer = np.empty(mujoco.mj_sizeModel(model), dtype=np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    return buffer.tobytes()


def are_equal(one: Any, other: Any) -> bool:
    """
    :param one: a setting, or a dictionary, list or tuple of such
    :param other: likewise
    :return: whether they are of one type and say the same
    """
    if type(one) is not type(other):
        return False
    if isinstance(one, np.ndarray):
        return bool(np.array_equal(one, other))
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(are_equal(one[key], other[key]) for key in one)
    if isinstance(one, list | tuple):
        return len(one) == len(other) and all(map(are_equal, one, other))
    return bool(one == other)
