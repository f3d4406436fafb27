"""Which parameters policy and value function share, and how they begin."""

import math
from typing import Any

import pytest
import torch as th
from envs_for_tests import VECTOR
from oracles import ACTION_SPACES, training_batch
from shared_fits import groups_of
from torch import nn

from sb3_gae import SharedMlpPolicy


def names_of(policy: nn.Module, parameters: list[th.Tensor]) -> set[str]:
    names = {id(parameter): name for name, parameter in policy.named_parameters()}
    return {names[id(parameter)] for parameter in parameters}


@pytest.mark.parametrize(
    ("net_arch", "n_shared"),
    [
        (None, 2),
        ([8], 1),
        ([], 0),
        (dict(pi=[8, 7], vf=[8, 7]), 2),
        (dict(pi=[8, 7], vf=[8, 6]), 1),
        (dict(pi=[8, 7, 6], vf=[8]), 1),
        (dict(pi=[8, 7], vf=[6, 7]), 0),
        (dict(pi=[8]), 0),
    ],
)
def test_the_layers_that_both_have_in_the_same_sizes_from_the_first_on_are_shared(net_arch: Any, n_shared: int) -> None:
    policy = SharedMlpPolicy(VECTOR, ACTION_SPACES["Box"], lambda _: 1e-3, net_arch=net_arch)
    batch = training_batch(policy)
    groups = groups_of(policy, batch)
    parts = [f"mlp_extractor.policy_net.{2 * layer}.{part}" for layer in range(n_shared) for part in ("weight", "bias")]
    assert names_of(policy, groups.of_both) == set(parts)
    assert {id(parameter) for parameter in groups.of_both} <= {id(parameter) for parameter in groups.of_policy}
    assert not {id(parameter) for parameter in groups.of_both} & {id(parameter) for parameter in groups.of_value}
    features = th.randn(4, 3)
    hidden = features
    for layer in range(n_shared):
        hidden = th.tanh(policy.mlp_extractor.policy_net[2 * layer](hidden))
    for latent, net in zip(
        policy.mlp_extractor(features), (policy.mlp_extractor.policy_net, policy.mlp_extractor.value_net), strict=True
    ):
        assert th.equal(latent, net[2 * n_shared :](hidden))


def test_shared_layers_begin_as_sb3s_do() -> None:
    policy = SharedMlpPolicy(VECTOR, ACTION_SPACES["Box"], lambda _: 1e-3)
    for linear, gain in [
        (policy.mlp_extractor.value_net[2], math.sqrt(2.0)),
        (policy.action_net, 0.01),
        (policy.value_net, 1),
    ]:
        product = linear.weight @ linear.weight.t()
        th.testing.assert_close(product, gain**2 * th.eye(len(product)), rtol=1e-4, atol=1e-5)
        assert not linear.bias.any()
    assert len({id(parameter) for group in policy.optimizer.param_groups for parameter in group["params"]}) == 9
