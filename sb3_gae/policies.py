"""Policies of :class:`~sb3_gae.TRPOGAE`."""

from stable_baselines3.common.policies import ActorCriticCnnPolicy, ActorCriticPolicy, MultiInputActorCriticPolicy
from stable_baselines3.common.type_aliases import Schedule

from sb3_gae.value_head import ValueHead


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
