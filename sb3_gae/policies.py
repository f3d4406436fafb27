"""Policies of :class:`~sb3_gae.TRPOGAE`, and the networks of the paper."""

from typing import Any

from stable_baselines3.common.policies import ActorCriticCnnPolicy, ActorCriticPolicy, MultiInputActorCriticPolicy
from stable_baselines3.common.type_aliases import Schedule
from torch import nn

from sb3_gae.value_head import ValueHead

#: ``policy_kwargs`` of the paper's cart-pole: a linear policy, a value network of 20 tanh units (section 6.2.1)
CARTPOLE_NETWORKS: dict[str, Any] = dict(net_arch=dict(pi=[], vf=[20]), activation_fn=nn.Tanh)

#: ``policy_kwargs`` of the paper's robots: 100, 50 and 25 tanh units for policy and value function (section 6.2.2)
LOCOMOTION_NETWORKS: dict[str, Any] = dict(net_arch=dict(pi=[100, 50, 25], vf=[100, 50, 25]), activation_fn=nn.Tanh)


class _ScaledValues(ActorCriticPolicy):
    """Gives an actor-critic policy a :class:`ValueHead` in place of its last value layer."""

    def _build(self, lr_schedule: Schedule) -> None:
        super()._build(lr_schedule)
        self.value_net = ValueHead(self.value_net)


class MlpPolicy(_ScaledValues):
    """Separate tanh networks for vector observations; arguments as for SB3's ``ActorCriticPolicy``."""


class CnnPolicy(_ScaledValues, ActorCriticCnnPolicy):
    """A convolutional features extractor for images; arguments as for SB3's ``ActorCriticCnnPolicy``."""


class MultiInputPolicy(_ScaledValues, MultiInputActorCriticPolicy):
    """For Dict observations; arguments as for SB3's ``MultiInputActorCriticPolicy``."""
