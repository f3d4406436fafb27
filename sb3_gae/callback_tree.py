"""Callbacks that have others in them."""

from collections.abc import Iterator

from stable_baselines3.common.callbacks import BaseCallback, EventCallback

#: attributes of every callback, set anew by SB3
SET_BY_SB3 = frozenset({"model", "parent", "locals", "globals"})


def with_children(root: BaseCallback) -> Iterator[BaseCallback]:
    """
    :param root: a callback
    :return: itself and those in it, each once
    """
    yield from _with_children(root, set())


def check_hears_of_rollouts(callback: BaseCallback) -> None:
    """
    :param callback: that acts at the beginning or the end of rollouts, when its model or its training has just been set
    :raises ValueError: if it is in an ``EventCallback``, such as ``EvalCallback``, which does not tell it of them
    """
    root = callback.locals.get("callback")
    events = [one for one in with_children(root) if isinstance(one, EventCallback)] if root is not None else []
    if isinstance(callback.parent, EventCallback):
        # A callback for new best results is not told of the training either
        events.append(callback.parent)
    for event in events:
        if event is not callback and callback in with_children(event):
            kind, outer = type(callback).__name__, type(event).__name__
            raise ValueError(
                f"{kind} must stand beside {outer}, not in it, since what is in it is not told of rollouts: "
                f"callback=[{outer}(...), {kind}(...)]."
            )


def _with_children(callback: BaseCallback, seen: set[int]) -> Iterator[BaseCallback]:
    if id(callback) in seen:
        return
    seen.add(id(callback))
    yield callback
    for name, value in vars(callback).items():
        children = value if isinstance(value, list) else [value]
        for child in children if name not in SET_BY_SB3 else []:
            if isinstance(child, BaseCallback):
                yield from _with_children(child, seen)
