"""
Prints the tables of docs/why-it-works.md: what becomes of the policy gradient if λ is chosen by what rollouts say of it.

    python docs/measured_lambda.py
"""

from collections.abc import Callable, Sequence

import numpy as np
from gridworld_figures import GAMMA, half_trained_policy, value_functions

from sb3_gae.diagnostics.rollout_diagnostics import expected_improvement
from sb3_gae.estimators.group_statistics import gradient_errors
from sb3_gae.gridworld import TabularPolicy, episode_advantages, episode_gradients, sample_episodes
from sb3_gae.presets import PAPER_LAMBDAS

N_GROUPS, N_ROLLOUTS, AVERAGED = 10, 200, 10

#: of quantities of shape (..., 4, L) in the order of :func:`exact`, shape (..., L); the larger the better
CRITERIA: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "error": lambda of: -(np.maximum(of[..., 0, :], 0.0) + of[..., 1, :]),
    "improvement": lambda of: expected_improvement(of[..., 3, :], of[..., 2, :] + of[..., 1, :]),
}


def exact(
    policy: TabularPolicy, values: np.ndarray, n_episodes: int, lambdas: Sequence[float | np.ndarray] = PAPER_LAMBDAS
) -> np.ndarray:
    """:return: bias squared, variance, squared norm and product with the true gradient, for each λ, shape (4, L)"""
    truth = policy.true_gradient(GAMMA)
    moments = [policy.gradient_moments(values, GAMMA, gae_lambda) for gae_lambda in lambdas]
    means, variances = np.stack([each.mean for each in moments]), np.array([each.variance for each in moments])
    over = (1, 2)
    norms, products = np.square(means).sum(axis=over), (means * truth).sum(axis=over)
    return np.stack([np.square(means - truth).sum(axis=over), variances / n_episodes, norms, products])


def measured(
    policy: TabularPolicy,
    values: np.ndarray,
    n_episodes: int,
    generator: np.random.Generator,
    n_projections: int | None = None,
) -> np.ndarray:
    """:return: the same, estimated from one rollout, or from random projections of its gradients"""
    episodes = sample_episodes(policy, n_episodes, generator)
    gradients = [
        episode_gradients(policy, episodes, episode_advantages(policy, episodes, values, GAMMA, gae_lambda))
        for gae_lambda in PAPER_LAMBDAS
    ]
    size = n_episodes // N_GROUPS
    sums = np.stack(gradients, axis=1).reshape(N_GROUPS, size, len(PAPER_LAMBDAS), -1).sum(axis=1)
    if n_projections is not None:
        sums = sums @ generator.normal(size=(sums.shape[-1], n_projections)) / np.sqrt(n_projections)
    return np.stack([each.value for each in gradient_errors(sums, np.full(N_GROUPS, size))])


def table(criterion: str, policy: TabularPolicy, unit: Callable[[np.ndarray], float]) -> None:
    """
    :param criterion: a key of :data:`CRITERIA`
    :param policy: on the gridworld
    :param unit: of the numbers, given the merit of each λ
    """
    merit, generator = CRITERIA[criterion], np.random.default_rng(2)
    print(f"| V | episodes | best λ | its {criterion} | λ = 0.96 | λ = 1 | chosen by 1 rollout | by {AVERAGED} |")
    print("| --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: |")
    for name, values in value_functions(policy).items():
        for n_episodes in (20, 200):
            true = merit(exact(policy, values, n_episodes))
            estimates = np.stack([measured(policy, values, n_episodes, generator) for _ in range(N_ROLLOUTS)])
            averages = estimates.reshape(-1, AVERAGED, *estimates.shape[1:]).mean(axis=1)
            chosen = [float(true[merit(each).argmax(axis=1)].mean()) for each in (estimates, averages)]
            numbers = np.array([true.max(), true[PAPER_LAMBDAS.index(0.96)], true[-1], *chosen]) / unit(true)
            cells = " | ".join(f"{number:.2f}" for number in numbers)
            print(f"| {name} | {n_episodes} | {PAPER_LAMBDAS[true.argmax()]:g} | {cells} |")


def main() -> None:
    policy = half_trained_policy()
    norm = float(np.square(policy.true_gradient(GAMMA)).sum())
    table("error", policy, lambda true: -norm)
    print()
    # A step along the true gradient gains its length
    table("improvement", policy, lambda true: np.sqrt(norm))


if __name__ == "__main__":
    main()
