"""The work of an update and of a rollout as counts, which are the same however fast or busy the machine is."""

import sys
from collections.abc import Callable
from types import FrameType
from typing import Any, Self

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils.flop_counter import FlopCounterMode

from benchmarks.gate.speed import BATCH, ROLLOUT_TASKS, forward_and_backward, rollout
from benchmarks.update_speed import ours
from sb3_gae.rollout.evaluation import training_batch

#: of the rollout that the gate judges; what it is judged by is recorded with others
SEED = 0
#: of each of these: additions and multiplications of its matrix products, over those of a forward and a backward pass of
#: both networks, and the operators that it calls
UPDATE_COUNTS = (
    "arithmetic of policy step / passes",
    "operators of policy step",
    "arithmetic of value fit / passes",
    "operators of value fit",
)
#: functions that most steps of all environments call, Python's and C's; what ends an episode calls more
ROLLOUT_COUNTS = tuple(f"calls of a rollout's step, {task}" for task in ROLLOUT_TASKS)
COUNTS = (*UPDATE_COUNTS, *ROLLOUT_COUNTS)


class OperatorCounter(TorchDispatchMode):
    """
    Counts the operators of PyTorch that are called within the ``with`` statement.

    On small batches an update takes as long as its operators need to be called.
    """

    def __init__(self) -> None:
        super().__init__()
        self.calls = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.calls += 1
        return func(*args, **(kwargs or {}))


def work_counts(seed: int = SEED) -> dict[str, float]:
    """
    :param seed: of rollout and networks
    :return: by name, one of :data:`COUNTS`
    """
    th.set_num_threads(1)
    return update_counts(seed) | {
        name: calls_of_a_step(task, seed) for name, task in zip(ROLLOUT_COUNTS, ROLLOUT_TASKS, strict=True)
    }


def update_counts(seed: int) -> dict[str, float]:
    """
    :param seed: of rollout and networks
    :return: by name, one of :data:`UPDATE_COUNTS`
    """
    model = ours(BATCH, seed=seed)
    batch = training_batch(model.rollout_buffer, model.action_space)
    parameters = model._parameter_groups(batch)
    passes, _ = counted(lambda: forward_and_backward(model))
    policy_step = counted(lambda: model._step_policy(batch, parameters))
    value_fit = counted(lambda: model._fit_value(batch, parameters))
    counts = (policy_step[0] / passes, policy_step[1], value_fit[0] / passes, value_fit[1])
    return dict(zip(UPDATE_COUNTS, counts, strict=True))


def counted(action: Callable[[], object]) -> tuple[int, int]:
    """
    :param action: to be done once
    :return: additions and multiplications of its matrix products, and the number of operators that it calls
    """
    with OperatorCounter() as operators, FlopCounterMode(display=False) as arithmetic:
        action()
    return arithmetic.get_total_flops(), operators.calls


class CallsByStep(BaseCallback):
    """Counts the functions, of Python and of C, that are called by each step within the ``with`` statement."""

    def __init__(self) -> None:
        super().__init__()
        self.calls = 0
        self.calls_at_steps: list[int] = []

    def _see(self, _frame: FrameType, event: str, _arg: Any) -> None:
        self.calls += event in ("call", "c_call")

    def _on_step(self) -> bool:
        self.calls_at_steps.append(self.calls)
        return True

    def __enter__(self) -> Self:
        self._before = sys.getprofile()
        sys.setprofile(self._see)
        return self

    def __exit__(self, *_: object) -> None:
        # What cProfile says it was is no function on Python 3.11
        sys.setprofile(self._before if callable(self._before) else None)


def calls_of_a_step(task: str, seed: int) -> float:
    """
    :param task: id
    :param seed: of environments and policy
    :return: median over the steps of a rollout, so that neither the episodes that happen to end nor what is done once counts
    """
    steps = CallsByStep()
    collect, _ = rollout(task, seed, steps)
    with steps:
        collect()
    return float(np.median(np.diff(steps.calls_at_steps)))
