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
    # Not by `state_dict`: a layer may load as another than the one that was saved, as a value head without a scale does
    before = {name: tensor.detach().clone() for name, tensor in _tensors(policy)}
    optimizer = copy.deepcopy(policy.optimizer.state_dict())
    try:
        yield
    except BaseException as error:
        with th.no_grad():
            for name, tensor in _tensors(policy):
                tensor.copy_(before[name])
        policy.optimizer.load_state_dict(optimizer)
        if isinstance(error, th.linalg.LinAlgError | ArithmeticError):
            raise NumericalError(f"The linear algebra of the update broke down: {error}") from error
        raise


def _tensors(policy: ActorCriticPolicy) -> Iterator[tuple[str, th.Tensor]]:
    yield from policy.named_parameters()
    yield from policy.named_buffers()
