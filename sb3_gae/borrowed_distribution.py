"""SB3 policies own one distribution object and refill it at every call."""

from collections.abc import Iterator
from contextlib import contextmanager

from stable_baselines3.common.policies import ActorCriticPolicy


@contextmanager
def borrowed_distribution(policy: ActorCriticPolicy) -> Iterator[None]:
    """
    Leave the policy's distribution as it was before the block.

    What is left in it stays until somebody asks for the next: numbers for a whole batch go wherever the policy goes, and a
    policy that holds a graph cannot be copied.

    :param policy: any actor-critic policy
    """
    content = vars(policy.action_dist)
    before = dict(content)
    try:
        yield
    finally:
        content.clear()
        content.update(before)
