"""What callbacks have counted and found, so that they go on from there."""

import numbers
import pickle
from collections import Counter
from collections.abc import Iterator
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback

from sb3_gae.callback_tree import SET_BY_SB3, with_children

#: attributes by name, each pickled, for each callback by its class and how many of this class come before it
CallbackStates = dict[str, dict[str, bytes]]


def callback_states(root: BaseCallback, fresh: CallbackStates | None = None) -> CallbackStates:
    """
    :param root: a callback, with others in it
    :param fresh: what this function gave at the beginning of the training; what is still the same is an argument of the
        callback rather than its state, and is left out
    :return: the plain data among the attributes
    """
    states = {name: _plain_attributes(callback) for name, callback in _named(root)}
    for name, attributes in (fresh or {}).items():
        states[name] = {key: blob for key, blob in states.get(name, {}).items() if attributes.get(key) != blob}
    return states


def restore_callbacks(root: BaseCallback, states: CallbackStates) -> None:
    """
    :param root: a callback, with others in it; those that the states do not know stay as they are
    :param states: what :func:`callback_states` returned
    """
    for name, callback in _named(root):
        for key, blob in states.get(name, {}).items():
            setattr(callback, key, pickle.loads(blob))


def _named(root: BaseCallback) -> Iterator[tuple[str, BaseCallback]]:
    counts: Counter[str] = Counter()
    for callback in with_children(root):
        kind = f"{type(callback).__module__}.{type(callback).__qualname__}"
        yield f"{kind} {counts[kind]}", callback
        counts[kind] += 1


def _plain_attributes(callback: BaseCallback) -> dict[str, bytes]:
    return {name: pickle.dumps(value) for name, value in vars(callback).items() if name not in SET_BY_SB3 and _is_plain(value)}


def _is_plain(value: Any) -> bool:
    if isinstance(value, dict):
        return all(_is_plain(part) for pair in value.items() for part in pair)
    if isinstance(value, list | tuple):
        return all(map(_is_plain, value))
    return value is None or isinstance(value, str | numbers.Number | np.generic | np.ndarray)
