"""
Prints the table of docs/why-it-works.md: the error of the policy gradient if λ is chosen by what rollouts say of it.

    python docs/measured_lambda.py
"""

import numpy as np
from gridworld_figures import GAMMA, half_trained_policy, value_functions

from sb3_gae.callbacks import PAPER_LAMBDAS
from sb3_gae.gridworld import TabularPolicy, episode_advantages, episode_gradients, sample_episodes
from sb3_gae.group_statistics import gradient_errors

N_GROUPS, N_ROLLOUTS, AVERAGED = 10, 200, 10


def measured(policy: TabularPolicy, values: np.ndarray, n_episodes: int, generator: np.random.Generator) -> np.ndarray:
    """:return: bias squared and variance of each λ, estimated from one rollout, shape (2, L)"""
    episodes = sample_episodes(policy, n_episodes, generator)
    gradients = [
        episode_gradients(policy, episodes, episode_advantages(policy, episodes, values, GAMMA, gae_lambda))
        for gae_lambda in PAPER_LAMBDAS
    ]
    size = n_episodes // N_GROUPS
    sums = np.stack(gradients, axis=1).reshape(N_GROUPS, size, len(PAPER_LAMBDAS), -1).sum(axis=1)
    errors = gradient_errors(sums, np.full(N_GROUPS, size))
    return np.stack([errors.bias_squared.value, errors.variance.value])


def error_of_choice(estimates: np.ndarray, errors: np.ndarray) -> float:
    """
    :param estimates: of independent choices, shape (n, 2, L)
    :param errors: exact, shape (L,)
    :return: mean of the exact error at the λ that each estimate would choose
    """
    chosen = (np.maximum(estimates[:, 0], 0.0) + estimates[:, 1]).argmin(axis=1)
    return float(errors[chosen].mean())


def main() -> None:
    policy, generator = half_trained_policy(), np.random.default_rng(2)
    norm = np.square(policy.true_gradient(GAMMA)).sum()
    print(f"| V | episodes | best λ | its error | λ = 0.96 | λ = 1 | chosen by 1 rollout | by {AVERAGED} |")
    print("| --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: |")
    for name, values in value_functions(policy).items():
        for n_episodes in (20, 200):
            curve = policy.lambda_curve(values, GAMMA, PAPER_LAMBDAS)
            errors = (curve.bias_squared + curve.variance / n_episodes) / norm
            estimates = np.stack([measured(policy, values, n_episodes, generator) for _ in range(N_ROLLOUTS)])
            averages = estimates.reshape(-1, AVERAGED, *estimates.shape[1:]).mean(axis=1)
            numbers = [
                errors.min(),
                errors[PAPER_LAMBDAS.index(0.96)],
                errors[-1],
                error_of_choice(estimates, errors),
                error_of_choice(averages, errors),
            ]
            cells = " | ".join(f"{number:.2f}" for number in numbers)
            print(f"| {name} | {n_episodes} | {PAPER_LAMBDAS[errors.argmin()]:g} | {cells} |")


if __name__ == "__main__":
    main()
