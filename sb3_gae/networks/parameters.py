"""Parameters as one flat vector, and which of them a result depends on."""

from collections.abc import Callable, Iterable, Iterator, Sequence

import torch as th

from sb3_gae.batch import TrainingBatch


def influencing_parameters(outputs: th.Tensor, candidates: Iterable[th.Tensor]) -> list[th.Tensor]:
    """
    The trainable candidates that ``outputs`` were computed from, by the computation graph and not by name.

    :param outputs: any tensor with a graph behind it
    :param candidates: parameters to choose from; frozen ones are never chosen
    :return: in the order of ``candidates``
    """
    trainable = [parameter for parameter in candidates if parameter.requires_grad]
    if not trainable or not outputs.requires_grad:
        return []
    gradients = th.autograd.grad(outputs.sum(), trainable, allow_unused=True)
    return [parameter for parameter, gradient in zip(trainable, gradients, strict=True) if gradient is not None]


def influencing_in_batch(
    outputs: Callable[[TrainingBatch], th.Tensor], candidates: Iterable[th.Tensor], batch: TrainingBatch
) -> list[th.Tensor]:
    """
    The same of a whole batch: a network may choose by what it sees which of its layers a sample goes through.

    :param outputs: of a piece of the batch, any tensor with a graph behind it
    :param candidates: parameters to choose from
    :param batch: at least one sample
    :return: in the order of ``candidates``
    """
    candidates = list(candidates)
    found = {id(parameter) for part in batch.parts() for parameter in influencing_parameters(outputs(part), candidates)}
    return [parameter for parameter in candidates if id(parameter) in found]


def flat_gradient(
    output: th.Tensor, parameters: Sequence[th.Tensor], create_graph: bool = False, retain_graph: bool | None = None
) -> th.Tensor:
    """
    Gradient of a scalar as one vector; zero for a parameter that it does not depend on.

    :param output: a scalar
    :param parameters: what to differentiate by
    :param create_graph: make the result differentiable in turn
    :param retain_graph: keep the graph for further passes (default: as ``create_graph``)
    :return: shape (n,), n the number of scalars in ``parameters``
    """
    gradients = th.autograd.grad(
        output, parameters, create_graph=create_graph, retain_graph=retain_graph, allow_unused=True, materialize_grads=True
    )
    return th.cat([gradient.reshape(-1) for gradient in gradients])


def flatten(tensors: Iterable[th.Tensor]) -> th.Tensor:
    """
    :param tensors: any shapes
    :return: a new vector of all their values, shape (n,)
    """
    return th.cat([tensor.detach().reshape(-1) for tensor in tensors])


def assign(parameters: Iterable[th.Tensor], vector: th.Tensor) -> None:
    """
    Write a flat vector into the parameters, in place.

    :param parameters: what to overwrite
    :param vector: the new values, shape (n,)
    """
    with th.no_grad():
        for parameter, values in unflatten(parameters, vector):
            parameter.copy_(values)


def unflatten(parameters: Iterable[th.Tensor], vector: th.Tensor) -> Iterator[tuple[th.Tensor, th.Tensor]]:
    """
    :param parameters: the shapes to cut the vector into
    :param vector: shape (n,)
    :return: each parameter with its piece of ``vector``, a view in the parameter's shape
    """
    start = 0
    for parameter in parameters:
        end = start + parameter.numel()
        yield parameter, vector[start:end].view_as(parameter)
        start = end


def positions(parameters: Iterable[th.Tensor], some: Iterable[th.Tensor]) -> th.Tensor:
    """
    Where some of the parameters are in the flat vector of all.

    :param parameters: in the order of the vector
    :param some: of these
    :return: indices in the order of ``some``, shape (m,), m the number of scalars in them
    """
    starts, start = {}, 0
    for parameter in parameters:
        starts[id(parameter)] = start
        start += parameter.numel()
    return th.cat([th.arange(parameter.numel(), device=parameter.device) + starts[id(parameter)] for parameter in some])
