"""
Finds the MLPs inside an SB3 actor-critic policy, where there are such that
:class:`~sb3_gae.networks.dense_network.DenseNetwork` can stand in for.
"""

import itertools
from collections.abc import Sequence

import torch as th
from gymnasium import spaces
from stable_baselines3.common.distributions import DiagGaussianDistribution
from stable_baselines3.common.policies import ActorCriticPolicy, BaseModel
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, FlattenExtractor, MlpExtractor
from stable_baselines3.common.type_aliases import PyTorchObs
from torch import nn

from sb3_gae.batch import in_chunks
from sb3_gae.networks.dense_network import DenseNetwork
from sb3_gae.networks.distributions import has_known_metric
from sb3_gae.networks.layers import has_hook
from sb3_gae.networks.value_head import ValueHead


def has_dense_policy(policy: ActorCriticPolicy, parameters: Sequence[th.Tensor]) -> bool:
    """
    :param policy: any actor-critic policy
    :param parameters: what the action distribution was found to depend on
    :return: whether that is exactly an MLP as SB3 builds it, on features that have no parameters
    """
    return (
        _inherits(policy, "get_distribution", "extract_features", "_get_action_dist_from_latent")
        and has_known_metric(policy.action_dist)
        and _has_own_deviations(policy)
        and _hold_exactly(_policy_layers(policy), policy_log_std(policy), parameters)
    )


def has_dense_value(policy: ActorCriticPolicy, parameters: Sequence[th.Tensor]) -> bool:
    """
    :param policy: any actor-critic policy
    :param parameters: what the value step may move
    :return: whether that is exactly an MLP as SB3 builds it, on features that the step does not move
    """
    # In this order: a policy with methods of its own need not have SB3's layers
    return _inherits(policy, "predict_values", "extract_features") and _hold_exactly(
        _value_layers(policy, parameters)[1], [], parameters
    )


def gaussian_layers(policy: ActorCriticPolicy) -> list[nn.Module]:
    """
    :param policy: any actor-critic policy
    :return: the layers from vector observations to the mean of the actions, if the policy is a Gaussian one as SB3 builds it;
        nothing for others
    """
    as_sb3 = (
        _inherits(policy, "_predict", "get_distribution", "extract_features", "_get_action_dist_from_latent")
        and type(policy.action_dist) is DiagGaussianDistribution
        and type(policy.pi_features_extractor) is FlattenExtractor
        and isinstance(policy.observation_space, spaces.Box)
        and len(policy.observation_space.shape) == 1
    )
    return _policy_layers(policy) if as_sb3 else []


def dense_policy_network(policy: ActorCriticPolicy, observations: PyTorchObs) -> DenseNetwork:
    """
    :param policy: one that :func:`has_dense_policy`
    :param observations: B samples
    :return: the network from features to means or logits
    """
    return DenseNetwork(_policy_layers(policy), _features(policy, observations, policy.pi_features_extractor))


def dense_value_network(
    policy: ActorCriticPolicy, observations: PyTorchObs, parameters: Sequence[th.Tensor] | None = None
) -> DenseNetwork:
    """
    :param policy: one that :func:`has_dense_value`
    :param observations: B samples
    :param parameters: what the value step may move, None for all
    :return: the network from features to the value, without the factor of a ``ValueHead``; layers that are the
        policy's as well and do not move belong to the features
    """
    fixed, layers = _value_layers(policy, parameters)
    features = _features(policy, observations, policy.vf_features_extractor)
    return DenseNetwork(layers, in_chunks(nn.Sequential(*fixed), features) if fixed else features)


def policy_log_std(policy: ActorCriticPolicy) -> list[th.Tensor]:
    """
    :param policy: any actor-critic policy
    :return: what a Gaussian policy has beside its layers: a parameter or a constant, of any shape that can be broadcast to
        that of the actions. Of shape (n_actions,) if the policy :func:`has_dense_policy`. Nothing for others
    """
    return [policy.log_std] if type(policy.action_dist) is DiagGaussianDistribution else []


def _policy_layers(policy: ActorCriticPolicy) -> list[nn.Module]:
    return _layers(policy, "policy_net", getattr(policy, "action_net", None))


def _value_layers(
    policy: ActorCriticPolicy, parameters: Sequence[th.Tensor] | None
) -> tuple[list[nn.Module], list[nn.Module]]:
    """The first layers, if they are the policy's as well and hold none of the parameters, and the rest."""
    head = policy.value_net
    # A subclass may do more than scale: it stays as it is, and so is refused
    layers = _layers(policy, "value_net", head.unscaled() if type(head) is ValueHead else head)
    of_policy, moved = set(_policy_layers(policy)), {id(parameter) for parameter in parameters or ()}
    fixed = list(itertools.takewhile(of_policy.__contains__, layers)) if parameters is not None else []
    if any(id(parameter) in moved for layer in fixed for parameter in layer.parameters()):
        fixed = []
    return fixed, layers[len(fixed) :]


def _layers(policy: ActorCriticPolicy, body: str, head: nn.Module | None) -> list[nn.Module]:
    """
    The layers in order; empty for an extractor that is not SB3's own, a body that need not apply its layers one after the
    other, or a policy that lacks the head.
    """
    if head is None or type(policy.mlp_extractor) is not MlpExtractor:
        return []
    hidden = getattr(policy.mlp_extractor, body)
    return [*hidden, head] if type(hidden) is nn.Sequential else []


def _has_own_deviations(policy: ActorCriticPolicy) -> bool:
    """Whether each action of a Gaussian policy has a deviation of its own; true of other distributions, which have none."""
    distribution = policy.action_dist
    return type(distribution) is not DiagGaussianDistribution or policy.log_std.shape == (distribution.action_dim,)


def _hold_exactly(layers: Sequence[nn.Module], others: Sequence[th.Tensor], parameters: Sequence[th.Tensor]) -> bool:
    held = [parameter for layer in layers for parameter in layer.parameters()] + list(others)
    return (
        DenseNetwork.supports(layers)
        and not any(map(has_hook, others))
        and {id(tensor) for tensor in held} == {id(tensor) for tensor in parameters}
    )


def _inherits(policy: ActorCriticPolicy, *methods: str) -> bool:
    """Whether the policy leaves these methods as SB3 wrote them, and nothing changes what a module, or its gradient, is."""
    if any(map(_is_changed, policy.modules())) or any(method in vars(policy) for method in methods):
        return False
    # A policy that `torch.compile` has wrapped is of a class without any
    return all(getattr(type(policy), method, None) is getattr(ActorCriticPolicy, method) for method in methods)


def _is_changed(module: nn.Module) -> bool:
    """
    Whether a method put in the place of the class's own, or a forward hook, may change what the module returns, or a
    backward hook the gradient that goes through it.
    """
    return has_hook(module) or bool(vars(module).keys() & {"forward", "forward_actor", "forward_critic"})


def _features(policy: ActorCriticPolicy, observations: PyTorchObs, extractor: BaseFeaturesExtractor) -> th.Tensor:
    # ActorCriticPolicy overrides extract_features to return a pair; for one extractor it calls the base class itself
    return in_chunks(lambda part: BaseModel.extract_features(policy, part, extractor), observations)
