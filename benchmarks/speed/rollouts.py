"""Rollouts to learn from, and the peer with the same one, each made once."""

import functools
from typing import Any, NamedTuple

import torch as th
from sb3_contrib import TRPO
from stable_baselines3.common.distributions import kl_divergence
from torch import nn

from benchmarks.speed.operations import Layer, layers_of
from benchmarks.update_speed import N_ACTIONS, N_STATES, Update, ours, theirs
from sb3_gae import TRPOGAE
from sb3_gae.batch import TrainingBatch
from sb3_gae.networks.distributions import snapshot
from sb3_gae.presets import LOCOMOTION_NETWORKS
from sb3_gae.rollout.evaluation import training_batch
from sb3_gae.update.shared_parameters import ParameterGroups

#: of the paper's robots
HIDDEN = tuple(LOCOMOTION_NETWORKS["net_arch"]["pi"])


class Rollout(NamedTuple):
    """
    :param model: that has collected it and not yet learned from it
    :param batch: what an update takes
    :param parameters: what an update moves
    :param update: that brings the model back to its start
    :param policy_layers: of its policy network
    :param value_layers: of its value network
    """

    model: TRPOGAE
    batch: TrainingBatch
    parameters: ParameterGroups
    update: Update
    policy_layers: list[Layer]
    value_layers: list[Layer]


@functools.lru_cache(maxsize=3)
def rollout(batch_size: int, hidden: tuple[int, ...] = HIDDEN) -> Rollout:
    """
    :param batch_size: samples, a multiple of the number of environments
    :param hidden: widths of the hidden layers of both networks
    :return: of the noisy oscillators
    """
    networks: dict[str, Any] = dict(net_arch=dict(pi=list(hidden), vf=list(hidden)), activation_fn=nn.Tanh)
    model = ours(batch_size, networks)
    batch = training_batch(model.rollout_buffer, model.action_space)
    value_layers = layers_of(N_STATES, hidden, 1)
    return Rollout(model, batch, model._parameter_groups(batch), Update(model), policy_layers(hidden), value_layers)


def policy_layers(hidden: tuple[int, ...]) -> list[Layer]:
    """
    :param hidden: widths of the hidden layers
    :return: of the policy network
    """
    return layers_of(N_STATES, hidden, N_ACTIONS)


class PeerGradients(NamedTuple):
    """
    What sb3-contrib's update has at hand when it begins to solve for the direction.

    :param peer: the algorithm
    :param parameters: of its policy
    :param of_divergence: with a graph, shape (n,)
    :param of_objective: shape (n,)
    """

    peer: TRPO
    parameters: list[nn.Parameter]
    of_divergence: th.Tensor
    of_objective: th.Tensor


def peer_gradients(of: Rollout) -> PeerGradients:
    """
    :param of: our rollout
    :return: the gradients as the first half of ``TRPO.train`` computes them
    """
    peer = theirs(of.model)
    with th.no_grad():
        old = snapshot(peer.policy.get_distribution(of.batch.observations))
    new = peer.policy.get_distribution(of.batch.observations)
    log_prob = new.log_prob(of.batch.actions)
    objective = (of.batch.advantages * th.exp(log_prob - log_prob.detach())).mean()
    divergence = kl_divergence(new, old).mean()
    parameters, of_objective, of_divergence, _ = peer._compute_actor_grad(divergence, objective)
    return PeerGradients(peer, parameters, of_divergence, of_objective)
