"""Small MDPs, and brute force on them: every trajectory with its probability, every sum term by term."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from sb3_gae.gridworld import TabularMDP, TabularPolicy


def layered_mdp(seed: int, n_states: int = 5, n_actions: int = 2) -> TabularMDP:
    """Every move leads to a later state, the last two being terminal: there are finitely many trajectories."""
    generator = np.random.default_rng(seed)
    transitions = np.triu(generator.uniform(size=(n_actions, n_states, n_states)), k=1).swapaxes(0, 1).copy()
    terminal = np.arange(n_states) >= n_states - 2
    transitions[~terminal] /= transitions[~terminal].sum(axis=2, keepdims=True)
    transitions[terminal] = 0.0
    start = np.where(terminal, 0.0, generator.uniform(size=n_states))
    return TabularMDP(transitions, generator.normal(size=transitions.shape), start / start.sum(), terminal)


def cyclic_mdp(seed: int, n_states: int = 5, n_actions: int = 3, ending: float = 0.0) -> TabularMDP:
    """Every state can follow every other one, itself among them; the last is terminal, and follows at least so often."""
    generator = np.random.default_rng(seed)
    transitions = (1.0 - ending) * generator.dirichlet(np.ones(n_states), size=(n_states, n_actions))
    transitions[:, :, -1] += ending
    terminal = np.arange(n_states) == n_states - 1
    transitions[terminal] = 0.0
    start = np.where(terminal, 0.0, generator.uniform(size=n_states))
    return TabularMDP(transitions, generator.normal(size=transitions.shape), start / start.sum(), terminal)


def random_policy(mdp: TabularMDP, seed: int) -> TabularPolicy:
    return TabularPolicy(mdp, np.random.default_rng(seed).normal(size=(mdp.n_states, mdp.n_actions)))


class Trajectory(NamedTuple):
    """``states`` has one entry more than ``actions``."""

    probability: float
    states: tuple[int, ...]
    actions: tuple[int, ...]

    def rewards(self, mdp: TabularMDP) -> list[float]:
        return [mdp.rewards[s, a, t] for s, a, t in zip(self.states, self.actions, self.states[1:], strict=False)]

    def advantages(self, mdp: TabularMDP, values: np.ndarray, gamma: float, gae_lambda: float | np.ndarray) -> list[float]:
        """The paper's equation 16, term by term; for a λ of shape (S,), with the product of those on the way."""
        known = [0.0 if mdp.terminal[s] else values[s] for s in self.states]
        deltas = [r + gamma * known[t + 1] - known[t] for t, r in enumerate(self.rewards(mdp))]
        factors = gamma * np.broadcast_to(gae_lambda, mdp.n_states)

        def weight(first: int, last: int) -> float:
            return float(np.prod(factors[list(self.states[first + 1 : last + 1])]))

        steps = range(len(deltas))
        return [sum(weight(t, k) * deltas[k] for k in steps if k >= t) for t in steps]

    def gradient(self, policy: TabularPolicy, signal: list[float]) -> np.ndarray:
        result = np.zeros_like(policy.logits)
        for state, action, factor in zip(self.states, self.actions, signal, strict=False):
            result[state, action] += factor
            result[state] -= factor * policy.probabilities[state]
        return result


def trajectories_from(
    policy: TabularPolicy, states: tuple[int, ...], actions: tuple[int, ...] = (), max_steps: int = 1000
) -> Iterator[Trajectory]:
    """All ways on from a beginning, with probabilities given it; those that take more than ``max_steps`` are left out."""
    mdp, state = policy.mdp, states[-1]
    if mdp.terminal[state]:
        yield Trajectory(1.0, states, actions)
        return
    for action in range(mdp.n_actions) if len(actions) < max_steps else ():
        for following in np.flatnonzero(mdp.transitions[state, action]).tolist():
            chance = policy.probabilities[state, action] * mdp.transitions[state, action, following]
            for rest in trajectories_from(policy, (*states, following), (*actions, action), max_steps):
                yield rest._replace(probability=rest.probability * chance)


def all_trajectories(policy: TabularPolicy, max_steps: int = 1000) -> list[Trajectory]:
    return [
        trajectory._replace(probability=trajectory.probability * policy.mdp.start[state])
        for state in np.flatnonzero(policy.mdp.start).tolist()
        for trajectory in trajectories_from(policy, (state,), max_steps=max_steps)
    ]
