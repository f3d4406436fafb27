"""
Prints a table of docs/why-it-works.md: what a λ for each state could gain, and what choosing by random projections loses.

    python docs/lambda_variants.py
"""

import numpy as np
from gridworld_figures import GAMMA, half_trained_policy, value_functions
from measured_lambda import AVERAGED, CRITERIA, N_ROLLOUTS, exact, measured

from sb3_gae.gridworld import TabularPolicy
from sb3_gae.presets import PAPER_LAMBDAS

#: of 100 numbers of a gradient
PROJECTIONS = (None, 16, 4)
MERIT = CRITERIA["improvement"]


def best_for_each_state(policy: TabularPolicy, values: np.ndarray, n_episodes: int) -> float:
    """:return: the largest improvement that was found, one state after the other, from the best λ of all states on"""
    start = MERIT(exact(policy, values, n_episodes))
    lambdas, best, before = np.full(policy.mdp.n_states, PAPER_LAMBDAS[start.argmax()]), float(start.max()), -np.inf
    while best > before + 1e-6:
        before = best
        for state in np.flatnonzero(~policy.mdp.terminal):
            trials = np.repeat(lambdas[None], len(PAPER_LAMBDAS), axis=0)
            trials[:, state] = PAPER_LAMBDAS
            found = MERIT(exact(policy, values, n_episodes, list(trials)))
            if found.max() > best:
                lambdas, best = trials[found.argmax()], float(found.max())
    return best


def chosen(policy: TabularPolicy, values: np.ndarray, n_episodes: int, n_projections: int | None) -> float:
    """:return: the mean improvement of the λ that is best by averages over some rollouts"""
    generator = np.random.default_rng(3)
    estimates = [measured(policy, values, n_episodes, generator, n_projections) for _ in range(N_ROLLOUTS)]
    averages = np.stack(estimates).reshape(-1, AVERAGED, *estimates[0].shape).mean(axis=1)
    return float(MERIT(exact(policy, values, n_episodes))[MERIT(averages).argmax(axis=1)].mean())


def main() -> None:
    policy = half_trained_policy()
    unit = np.linalg.norm(policy.true_gradient(GAMMA))
    print("| V | episodes | best λ | a λ for each state | chosen by 10 rollouts | by 16 projections | by 4 |")
    print("| --- | ---: | ---: | ---: | ---: | ---: | ---: |")
    for name, values in value_functions(policy).items():
        for n_episodes in (20, 200):
            one = float(MERIT(exact(policy, values, n_episodes)).max())
            each = best_for_each_state(policy, values, n_episodes)
            numbers = [one, each, *(chosen(policy, values, n_episodes, count) for count in PROJECTIONS)]
            print(f"| {name} | {n_episodes} | " + " | ".join(f"{number / unit:.2f}" for number in numbers) + " |")


if __name__ == "__main__":
    main()
