"""
Draws docs/images/gridworld_*.svg: bias, variance and response function on the exact gridworld, and how well they are measured.

    python docs/gridworld_figures.py
"""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sb3_gae.estimators.group_statistics import gradient_errors
from sb3_gae.gridworld import (
    TabularPolicy,
    episode_advantages,
    episode_gradients,
    fitted_values,
    gridworld,
    lagged_gradients,
    response_function,
    sample_episodes,
)
from sb3_gae.presets import PAPER_LAMBDAS

IMAGES = Path(__file__).parent / "images"
GAMMA = 0.95
LAMBDAS = np.linspace(0.0, 1.0, 201)
STYLES = {
    "exact": dict(color="black", linestyle="-"),
    "learned": dict(color="tab:blue", linestyle="--"),
    "noisy": dict(color="tab:orange", linestyle="-."),
    "zero": dict(color="tab:red", linestyle=":"),
}


def half_trained_policy() -> TabularPolicy:
    """:return: after 20 steps up the true gradient from the uniform policy"""
    mdp = gridworld()
    logits = np.zeros((mdp.n_states, mdp.n_actions))
    for _ in range(20):
        logits = logits + TabularPolicy(mdp, logits).true_gradient(GAMMA)
    return TabularPolicy(mdp, logits)


def value_functions(policy: TabularPolicy) -> dict[str, np.ndarray]:
    generator = np.random.default_rng(0)
    exact = policy.values(GAMMA)
    return {
        "exact": exact,
        "learned": fitted_values(policy, sample_episodes(policy, 40, generator), GAMMA),
        "noisy": exact + 0.1 * generator.normal(size=exact.shape),
        "zero": np.zeros_like(exact),
    }


def draw_bias_and_variance(policy: TabularPolicy, values: dict[str, np.ndarray]) -> Figure:
    figure, axes = plt.subplots(2, 2, figsize=(9.0, 6.4), sharex=True, layout="constrained")
    norm = np.square(policy.true_gradient(GAMMA)).sum()
    for name, function in values.items():
        curve = policy.lambda_curve(function, GAMMA, LAMBDAS)
        axes[0, 0].plot(LAMBDAS, curve.bias_squared / norm, label=f"{name} V", **STYLES[name])
        axes[0, 1].plot(LAMBDAS, curve.variance / norm, **STYLES[name])
        for axis, n_episodes in zip(axes[1], (20, 200), strict=True):
            error = (curve.bias_squared + curve.variance / n_episodes) / norm
            axis.plot(LAMBDAS, error, **STYLES[name])
            axis.plot(LAMBDAS[error.argmin()], error.min(), "o", color=STYLES[name]["color"], clip_on=False, zorder=3)
    axes[0, 0].legend(frameon=False)
    titles = [
        "Bias squared",
        "Variance, one episode",
        "Bias squared + variance, 20 episodes",
        "Bias squared + variance, 200 episodes",
    ]
    for axis, title in zip(axes.flat, titles, strict=True):
        tidy(axis, title)
        axis.set(xlim=(0.0, 1.0), ylim=(0.0, None))
    for axis in axes[1]:
        axis.set_xlabel("λ")
    for axis in axes[:, 0]:
        axis.set_ylabel("in units of the squared gradient")
    return figure


def draw_response(policy: TabularPolicy, values: dict[str, np.ndarray]) -> Figure:
    figure, (left, right) = plt.subplots(1, 2, figsize=(9.0, 3.6), layout="constrained")
    lags = np.arange(31)
    discounts, norm = GAMMA ** lags.astype(float), np.linalg.norm(policy.true_gradient(GAMMA))
    # How often each action is taken in each state
    frequencies = policy.visits[:, None] * policy.probabilities * ~policy.mdp.terminal[:, None] / policy.mean_length
    # Shaped by V = 0, rewards are themselves
    labels = {"zero": "rewards", "learned": "shaped by a learned V", "exact": "shaped by the exact V"}
    for name, label in labels.items():
        response = response_function(policy, len(lags), values[name], GAMMA)
        size = np.sqrt(np.einsum("lsa,sa->l", np.square(response), frequencies))
        left.plot(lags, discounts * size, label=label, marker=".", markersize=5, **STYLES[name])
        size = np.sqrt(np.square(lagged_gradients(policy, len(lags), values[name], GAMMA)).sum(axis=(1, 2)))
        right.plot(lags, discounts * size / norm, marker=".", markersize=5, **STYLES[name])
    left.legend(frameon=False)
    tidy(left, "Response function, root mean square over visits")
    left.set(ylabel="γˡ χ(l; s, a)")
    tidy(right, "Part of the policy gradient at each delay")
    right.set(ylabel="norm, in units of the gradient's")
    for axis in (left, right):
        axis.set(xlabel="delay l in steps", xlim=(-0.5, 30.0), ylim=(0.0, None))
    return figure


def draw_measured(policy: TabularPolicy, function: np.ndarray, n_episodes: int = 200, n_rollouts: int = 25) -> Figure:
    """What rollouts alone say, beside the truth."""
    generator, measured = np.random.default_rng(1), []
    for _ in range(n_rollouts):
        episodes = sample_episodes(policy, n_episodes, generator)
        gradients = [
            episode_gradients(policy, episodes, episode_advantages(policy, episodes, function, GAMMA, gae_lambda))
            for gae_lambda in PAPER_LAMBDAS
        ]
        groups = np.stack(gradients, axis=1).reshape(20, n_episodes // 20, len(PAPER_LAMBDAS), -1).sum(axis=1)
        measured.append(gradient_errors(groups, np.full(20, n_episodes / 20)))
    exact, norm = policy.lambda_curve(function, GAMMA, LAMBDAS), np.square(policy.true_gradient(GAMMA)).sum()
    figure, axes = plt.subplots(1, 2, figsize=(9.0, 3.6), layout="constrained")
    pairs = (("bias_squared", exact.bias_squared), ("variance", exact.variance / n_episodes))
    for axis, (name, truth) in zip(axes, pairs, strict=True):
        values, errors = np.array([getattr(each, name) for each in measured]).swapaxes(0, 1) / norm
        positions = np.array(PAPER_LAMBDAS)
        axis.plot(LAMBDAS, truth / norm, color="black", label="exact")
        axis.errorbar(positions - 0.008, values[0], errors[0], fmt="o", color="tab:blue", ms=4, capsize=3, label="one rollout")
        spread = values.std(axis=0, ddof=1) / np.sqrt(n_rollouts)
        label = f"mean of {n_rollouts} rollouts"
        axis.errorbar(positions, values.mean(axis=0), spread, fmt="s", color="tab:orange", ms=4, capsize=3, label=label)
        tidy(axis, {"bias_squared": "Bias squared", "variance": "Variance"}[name] + f", rollouts of {n_episodes} episodes")
        axis.set(xlabel="λ", xlim=(-0.03, 1.03))
    axes[0].set_ylabel("in units of the squared gradient")
    axes[0].legend(frameon=False)
    axes[1].set_ylim(0.0, None)
    return figure


def tidy(axis: Axes, title: str) -> None:
    axis.set_title(title, fontsize=10)
    axis.spines[["top", "right"]].set_visible(False)
    axis.grid(alpha=0.25)


def main() -> None:
    plt.switch_backend("svg")
    # The same file at every run
    plt.rcParams["svg.hashsalt"] = "sb3-gae"
    policy = half_trained_policy()
    values = value_functions(policy)
    figures = {
        "bias_variance": draw_bias_and_variance(policy, values),
        "response": draw_response(policy, values),
        "measured": draw_measured(policy, values["learned"]),
    }
    IMAGES.mkdir(exist_ok=True)
    for name, figure in figures.items():
        path = IMAGES / f"gridworld_{name}.svg"
        figure.savefig(path, facecolor="white", metadata={"Date": None, "Creator": None})
        print(f"wrote {path}")


if __name__ == "__main__":
    main()
