"""An update is done whole or not at all."""

import copy
from collections.abc import Iterator
from contextlib import contextmanager

import torch as th
from stable_baselines3.common.policies import ActorCriticPolicy

from sb3_gae.errors import NumericalError


@contextmanager
def all_or_nothing(policy: ActorCriticPolicy) -> Iterator[None]:
    """
    Undo what was done to policy and optimiser if the block does not reach its end, interrupts included.

    :param policy: whose parameters, buffers and optimiser are guarded
    :raises NumericalError: in place of the errors of linear algebra and arithmetic
    """
    before = copy.deepcopy((policy.state_dict(), policy.optimizer.state_dict()))
    try:
        yield
    except BaseException as error:
        policy.load_state_dict(before[0])
        policy.optimizer.load_state_dict(before[1])
        if isinstance(error, th.linalg.LinAlgError | ArithmeticError):
            raise NumericalError(f"The linear algebra of the update broke down: {error}") from error
        raise
