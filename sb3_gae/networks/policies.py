"""Policies of :class:`~sb3_gae.TRPOGAE`."""

import itertools

import numpy as np
from stable_baselines3.common.policies import ActorCriticCnnPolicy, ActorCriticPolicy, MultiInputActorCriticPolicy
from stable_baselines3.common.type_aliases import Schedule
from torch import nn
from torch.nn.utils import parameters_to_vector

from sb3_gae.networks.value_head import ValueHead


class _ScaledValues(ActorCriticPolicy):
    """Gives an actor-critic policy a :class:`~sb3_gae.networks.value_head.ValueHead` in place of its last value layer."""

    def _build(self, lr_schedule: Schedule) -> None:
        super()._build(lr_schedule)
        self.value_net = ValueHead(self.value_net)

    def parameters_to_vector(self) -> np.ndarray:
        """
        :return: all parameters, those of the last value layer times its scale, so that they mean the same in a policy of SB3,
            shape (n,)
        """
        # Users replace layers
        if not isinstance(head := self.value_net, ValueHead):
            return super().parameters_to_vector()
        scaled = {id(parameter) for parameter in head.parameters()}
        pieces = [each.detach() * head.scale if id(each) in scaled else each.detach() for each in self.parameters()]
        return parameters_to_vector(pieces).cpu().numpy()

    def load_from_vector(self, vector: np.ndarray) -> None:
        """
        :param vector: as :meth:`parameters_to_vector` gives it, here or in a policy of SB3, shape (n,)
        """
        super().load_from_vector(vector)
        if isinstance(head := self.value_net, ValueHead):
            head.forget_scale()


class MlpPolicy(_ScaledValues):
    """Separate tanh networks for vector observations; arguments as for SB3's ``ActorCriticPolicy``."""


class CnnPolicy(_ScaledValues, ActorCriticCnnPolicy):
    """A convolutional features extractor for images; arguments as for SB3's ``ActorCriticCnnPolicy``."""


class MultiInputPolicy(_ScaledValues, MultiInputActorCriticPolicy):
    """For Dict observations; arguments as for SB3's ``MultiInputActorCriticPolicy``."""


class SharedMlpPolicy(MlpPolicy):
    """
    For vector observations, policy and value function share hidden layers; arguments as for SB3's ``ActorCriticPolicy``.

    Shared are the layers that ``net_arch`` gives both of them in the same sizes from the first on: all of
    ``dict(pi=[64, 64], vf=[64, 64])``, the default, and one of ``dict(pi=[64, 32], vf=[64, 16])``.
    """

    def _build_mlp_extractor(self) -> None:
        super()._build_mlp_extractor()
        policy_net, value_net = self.mlp_extractor.policy_net, self.mlp_extractor.value_net
        pairs = zip(policy_net.children(), value_net.children(), strict=False)
        shared = [layer for layer, _ in itertools.takewhile(lambda pair: _have_same_size(*pair), pairs)]
        own = list(value_net.children())[len(shared) :]
        self.mlp_extractor.value_net = nn.Sequential(*shared, *own)


def _have_same_size(layer: nn.Module, other: nn.Module) -> bool:
    """Also true of activations, which have none."""
    return getattr(layer, "out_features", None) == getattr(other, "out_features", None)
