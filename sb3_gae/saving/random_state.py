"""The state of the random generators that training draws from."""

import random
from typing import Any

import numpy as np
import torch as th


def random_state() -> dict[str, Any]:
    """
    :return: state of the global generators of Python, NumPy and torch, on all devices
    """
    cuda = th.cuda.get_rng_state_all() if th.cuda.is_available() else []
    return {"python": random.getstate(), "numpy": np.random.get_state(), "torch": th.get_rng_state(), "cuda": cuda}


def restore_random_state(state: dict[str, Any]) -> None:
    """
    :param state: what :func:`random_state` returned, in this process or an earlier one
    """
    random.setstate(state["python"])
    np.random.set_state(state["numpy"])
    th.set_rng_state(state["torch"])
    if th.cuda.is_available() and len(state["cuda"]) == th.cuda.device_count():
        th.cuda.set_rng_state_all(state["cuda"])
