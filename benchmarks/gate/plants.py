"""Faults that the gate has to notice, each of them in force within a `with` statement."""

from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any, NamedTuple
from unittest import mock

from benchmarks.gate.learning import RUNS
from benchmarks.gate.work import ROLLOUT_COUNTS, UPDATE_COUNTS
from sb3_gae import TRPOGAE, GAERolloutBuffer
from sb3_gae.rollout.collection import ActionSampler
from sb3_gae.update import trust_region


def twice(function: Callable[..., Any]) -> Callable[..., Any]:
    """
    :param function: any
    :return: does all the work two times
    """

    def doubled(*args: Any, **kwargs: Any) -> Any:
        function(*args, **kwargs)
        return function(*args, **kwargs)

    return doubled


def doubled_conjugate_gradient() -> AbstractContextManager[Any]:
    """Every linear system is solved twice."""
    return mock.patch.object(trust_region, "conjugate_gradient", twice(trust_region.conjugate_gradient))


def doubled_update() -> AbstractContextManager[Any]:
    """Policy step and value fit are done twice."""
    return mock.patch.multiple(TRPOGAE, _step_policy=twice(TRPOGAE._step_policy), _fit_value=twice(TRPOGAE._fit_value))


def doubled_actions() -> AbstractContextManager[Any]:
    """The policy is asked twice at each step of a rollout."""
    return mock.patch.object(ActionSampler, "__call__", twice(ActionSampler.__call__))


def wrong_sign() -> AbstractContextManager[Any]:
    """Advantages are negated."""
    compute = GAERolloutBuffer.compute_returns_and_advantage

    def negated(self: GAERolloutBuffer, *args: Any, **kwargs: Any) -> None:
        compute(self, *args, **kwargs)
        self.advantages = -self.advantages

    return mock.patch.object(GAERolloutBuffer, "compute_returns_and_advantage", negated)


def value_first() -> AbstractContextManager[Any]:
    """The value function is fitted before the policy step, which takes its advantages from it."""
    train = TRPOGAE.train

    def in_the_other_order(self: TRPOGAE) -> None:
        self.value_fit_first = True
        train(self)

    return mock.patch.object(TRPOGAE, "train", in_the_other_order)


class Plant(NamedTuple):
    """
    :param fault: in force within the ``with`` statement of what it returns
    :param part: of the gate
    :param numbers: of the part that have to turn red; others may
    """

    fault: Callable[[], AbstractContextManager[Any]]
    part: str
    numbers: tuple[str, ...]


#: by name
PLANTS = {
    "doubled-cg": Plant(doubled_conjugate_gradient, "work", UPDATE_COUNTS),
    "doubled-update": Plant(doubled_update, "speed", ("update / sb3-contrib's", "value fit / passes")),
    "doubled-actions": Plant(doubled_actions, "work", ROLLOUT_COUNTS),
    "doubled-actions-timed": Plant(doubled_actions, "speed", ("actions / policy's own",)),
    "wrong-sign": Plant(wrong_sign, "learning", tuple(RUNS)),
    "value-first": Plant(value_first, "learning", ("HalfCheetah-v5, close fit",)),
}
