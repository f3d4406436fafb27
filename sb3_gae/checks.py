"""Refusals of bad input, in words that say what would be right."""

import math
from collections.abc import Iterable
from numbers import Real
from typing import Any

import numpy as np
import torch as th
from torch import nn

from sb3_gae.errors import NumericalError


def check_number(
    name: str, value: Any, low: float = -math.inf, high: float = math.inf, *, above: bool = False, below: bool = False
) -> None:
    """
    :param name: of the argument, for the message
    :param value: what was passed
    :param low: smallest value allowed
    :param high: largest value allowed
    :param above: ``low`` itself is not allowed
    :param below: ``high`` itself is not allowed
    :raises ValueError: if the value is not a number in that range
    """
    right = isinstance(value, Real) and not isinstance(value, bool)
    if right and (low < value if above else low <= value) and (value < high if below else value <= high):
        return
    interval = f"{'(' if above else '['}{low:g}, {high:g}{')' if below or math.isinf(high) else ']'}"
    raise ValueError(f"`{name}` must be a number in {interval}, got {value!r}.")


def check_count(name: str, value: Any, low: int = 1) -> None:
    """
    :param name: of the argument, for the message
    :param value: what was passed
    :param low: smallest value allowed
    :raises ValueError: if the value is not a whole number, or too small
    """
    if not isinstance(value, int | np.integer) or isinstance(value, bool) or value < low:
        raise ValueError(f"`{name}` must be a whole number of at least {low}, got {value!r}.")


def check_choice(name: str, value: Any, choices: tuple[Any, ...]) -> None:
    """
    :param name: of the argument, for the message
    :param value: what was passed
    :param choices: what is allowed
    :raises ValueError: if the value is none of them
    """
    if value not in choices:
        raise ValueError(f"`{name}` must be one of {', '.join(map(repr, choices))}, got {value!r}.")


def check_unit_interval(name: str, factors: Any) -> None:
    """
    :param name: of the argument, for the message
    :param factors: what was passed
    :raises ValueError: if it is not a list of numbers from 0 to 1, or is empty
    """
    try:
        array = np.asarray(factors, dtype=np.float64)
    except (TypeError, ValueError):
        array = np.empty(0)
    if array.ndim != 1 or array.size == 0 or not np.all((array >= 0.0) & (array <= 1.0)):
        raise ValueError(f"`{name}` must be a non-empty list of numbers in [0, 1], got {factors!r}.")


def check_finite_parameters(module: nn.Module) -> None:
    """
    :param module: any
    :raises NumericalError: if any number in a trainable parameter is NaN or infinite. A frozen one may be so on purpose, as a
        mask of attention is; whether it does harm, outputs and gradients show
    """
    for name, parameter in module.named_parameters():
        if parameter.requires_grad and not parameter.isfinite().all():
            raise NumericalError(
                f"The policy's parameter {name!r} contains NaN or infinity; nothing can be learnt from there."
            )


def is_about_numbers(error: ValueError, parameters: Iterable[th.Tensor]) -> bool:
    """
    Tell an action distribution that there is none of from whatever else a policy of the user's own may raise.

    :param error: that asking the policy has led to
    :param parameters: of the policy
    :return: whether torch refused to make the distribution, or a trainable parameter is not finite
    """
    innermost = error.__traceback__
    while innermost is not None and innermost.tb_next is not None:
        innermost = innermost.tb_next
    raised_in = "" if innermost is None else innermost.tb_frame.f_globals.get("__name__", "")
    return raised_in.startswith("torch.distributions") or not all(
        parameter.isfinite().all() for parameter in parameters if parameter.requires_grad
    )


def check_finite_step(what: str, array: np.ndarray | dict[str, np.ndarray], step: int, first_env: int = 0) -> None:
    """
    :param what: the quantity, for the message
    :param array: one entry for each environment, shape (N, ...), or a dictionary of such
    :param step: steps since the start of the rollout, for the message
    :param first_env: index of the environment of the first entry
    :raises NumericalError: if any number is NaN or infinite
    """
    if isinstance(array, dict):
        for key, part in array.items():
            check_finite_step(f"{what} {key!r}", part, step, first_env)
    elif array.dtype.kind == "f" and not np.isfinite(array).all():
        first = int(np.argwhere(~np.isfinite(array))[0][0])
        value = "NaN" if np.isnan(array[first]).any() else "infinity"
        raise NumericalError(f"The {what} contains {value} at step {step} of the rollout in environment {first_env + first}.")


def check_finite_rollout(what: str, array: np.ndarray) -> None:
    """
    :param what: the quantity, for the message
    :param array: shape (T, N, ...)
    :raises NumericalError: if any number is NaN or infinite
    """
    if not np.isfinite(array).all():
        step = int(np.argwhere(~np.isfinite(array))[0][0])
        check_finite_step(what, array[step], step)
