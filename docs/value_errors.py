"""
Which error of a value function predicts the bias of λ? Prints the tables of docs/why-it-works.md and draws
docs/images/value_errors.svg, from the exact gridworld and from what docs/training_diagnostics.py has stored.

    python docs/value_errors.py

Measures and bias have no units: errors are over the variance of the returns, bias squared over the squared gradient.
"""

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import matplotlib.pyplot as plt
import numpy as np
from gridworld_figures import GAMMA, tidy
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FixedLocator, NullFormatter
from scipy.stats import rankdata
from training_diagnostics import Result, stored

from sb3_gae.gridworld import TabularPolicy, exact_value_errors, fitted_values, gridworld, sample_episodes
from sb3_gae.presets import PAPER_LAMBDAS

IMAGE = Path(__file__).parent / "images" / "value_errors.svg"
LAMBDAS = (0.0, 0.92, 0.96)
EPISODES = 200
RESAMPLES = 1000

UNEXPLAINED, MONTE_CARLO, TD = "1 − explained variance", "Monte-Carlo error", "TD error"
BELLMAN, TRUE_ERROR = "Bellman error", "error against the exact V"
GRADIENT, GRADIENT_NOISE = "error in the gradient", "the same over its variance"

COLORS = {
    "learned": "tab:blue",
    "refitted": "tab:cyan",
    "noisy": "tab:orange",
    "earlier": "tab:green",
    "half": "tab:purple",
    "zero": "tab:red",
    "offset": "black",
}
MARKERS = {"gridworld": "o", "GaeCartPole-v0": "o", "Pendulum-v1": "^", "GaeBiped-v0": "s"}


class Case(NamedTuple):
    """
    A policy with a value function that is not its own.

    :param task: what it acts in
    :param run: what cases are drawn from independently
    :param policy: of the run
    :param kind: of value function, a key of :data:`COLORS`
    :param measures: of the value function's error
    :param bias_squared: at each of PAPER_LAMBDAS, over the squared gradient
    :param bias_error: its standard error, likewise
    :param variance: of a batch's gradient, likewise
    """

    task: str
    run: str
    policy: str
    kind: str
    measures: dict[str, float]
    bias_squared: np.ndarray
    bias_error: np.ndarray
    variance: np.ndarray

    @property
    def best_place(self) -> int:
        """Of the λ with the least sum of bias squared and variance."""
        return int(np.argmin(np.maximum(self.bias_squared, 0.0) + self.variance))


# --- Cases ---


def gridworld_cases(n_runs: int = 6, n_steps: Sequence[int] = (4, 10, 20, 40)) -> list[Case]:
    """Everything in them is exact but how the value functions came about."""
    cases: list[Case] = []
    for run in range(n_runs):
        generator = np.random.default_rng(run)
        mdp = gridworld()
        policies = [TabularPolicy(mdp, generator.normal(size=(mdp.n_states, mdp.n_actions)))]
        for _ in range(max(n_steps)):
            policies.append(TabularPolicy(mdp, policies[-1].logits + policies[-1].true_gradient(GAMMA)))
        for step in n_steps:
            for kind, values in wrong_values(policies[: step + 1], generator):
                cases.append(exact_case(policies[step], values, f"run {run}", f"run {run}, step {step}", kind))
    return cases


def wrong_values(policies: Sequence[TabularPolicy], generator: np.random.Generator) -> list[tuple[str, np.ndarray]]:
    """:param policies: of a run, the last being the present one"""
    policy = policies[-1]
    exact = policy.values(GAMMA)
    deviation = np.sqrt(exact_value_errors(policy, exact, GAMMA).return_variance)
    learned = [fitted_values(policy, sample_episodes(policy, count, generator), GAMMA) for count in (5, 20, 80, 320)]
    noisy = [exact + size * generator.normal(size=exact.shape) for size in (0.03, 0.1, 0.3)]
    earlier = [policies[len(policies) // 2].values(GAMMA), policies[0].values(GAMMA)]
    return [
        *(("learned", values) for values in learned),
        *(("noisy", values) for values in noisy),
        *(("earlier", values) for values in earlier),
        ("half", exact / 2),
        ("zero", np.zeros_like(exact)),
        ("offset", exact + deviation),
    ]


def exact_case(policy: TabularPolicy, values: np.ndarray, run: str, name: str, kind: str) -> Case:
    errors = exact_value_errors(policy, values, GAMMA)
    curve = policy.lambda_curve(values, GAMMA, PAPER_LAMBDAS)
    norm = np.square(policy.true_gradient(GAMMA)).sum()
    bias_squared, variance = curve.bias_squared / norm, curve.variance / EPISODES / norm
    scale = errors.return_variance
    measures = {
        UNEXPLAINED: 1.0 - errors.explained_variance,
        MONTE_CARLO: errors.monte_carlo_error / scale,
        TD: errors.td_error / scale,
        BELLMAN: errors.bellman_error / scale,
        TRUE_ERROR: errors.value_error / scale,
        GRADIENT: bias_squared[0],
        GRADIENT_NOISE: bias_squared[0] / variance[-1],
    }
    return Case("gridworld", run, name, kind, measures, bias_squared, np.zeros_like(variance), variance)


def training_cases(rows: Iterable[Result]) -> list[Case]:
    return [measured_case(row, kind, found) for row in rows for kind, found in row["value_functions"].items()]


def measured_case(row: Result, kind: str, found: Result) -> Case:
    norm, scale = row["squared_gradient"][0], row["value_functions"]["refitted"]["return_variance"]
    (bias_squared, bias_error), variance = np.array(found["bias_squared"]) / norm, np.array(found["variance"][0]) / norm
    measures = {
        UNEXPLAINED: 1.0 - found["explained_variance"],
        MONTE_CARLO: found["monte_carlo_error"] / scale,
        TD: found["td_error"] / scale,
        GRADIENT: bias_squared[0],
        GRADIENT_NOISE: bias_squared[0] / variance[-1],
    }
    run = f"{row['env']}, seed {row['seed']}"
    policy = f"{run}, iteration {row['iteration']}"
    return Case(row["env"], run, policy, "learned" if kind == "own" else kind, measures, bias_squared, bias_error, variance)


# --- Correlations ---

Target = Callable[[Case], float]


def bias_at(gae_lambda: float) -> Target:
    place = PAPER_LAMBDAS.index(gae_lambda)
    return lambda case: float(case.bias_squared[place])


def best_lambda(case: Case) -> float:
    return float(case.best_place)


def rank_correlation(first: Sequence[float], second: Sequence[float]) -> float:
    """Spearman's; not a number if either is constant."""
    ranks = rankdata(first), rankdata(second)
    if min(np.ptp(each) for each in ranks) == 0.0:
        return float("nan")
    return float(np.corrcoef(*ranks)[0, 1])


def within_policies(cases: Sequence[Case], measure: str, target: Target) -> dict[str, list[float]]:
    """For each run: rank correlations over the value functions of one policy, where neither side is constant."""
    found: dict[str, list[float]] = {}
    for policy in dict.fromkeys(case.policy for case in cases):
        own = [case for case in cases if case.policy == policy]
        correlation = rank_correlation([case.measures[measure] for case in own], [target(case) for case in own])
        found.setdefault(own[0].run, []).extend([] if np.isnan(correlation) else [correlation])
    return found


def of_all_policies(cases: Sequence[Case], measure: str, target: Target) -> float:
    return rank_correlation([case.measures[measure] for case in cases], [target(case) for case in cases])


class Interval(NamedTuple):
    """A number and its bootstrap interval of 95 %."""

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.value:.2f} [{self.low:.2f}, {self.high:.2f}]"


def mean_or_nan(numbers: Sequence[float]) -> float:
    return float(np.mean(numbers)) if numbers else float("nan")


def mean_within(cases: Sequence[Case], measure: str, target: Target) -> float:
    return mean_or_nan([each for run in within_policies(cases, measure, target).values() for each in run])


def interval_within(cases: Sequence[Case], measure: str, target: Target) -> Interval:
    """Mean over policies; runs are resampled."""
    runs = list(within_policies(cases, measure, target).values())
    draws = np.random.default_rng(0).integers(len(runs), size=(RESAMPLES, len(runs)))
    means = [mean_or_nan([each for run in draw for each in runs[run]]) for draw in draws]
    return Interval(mean_within(cases, measure, target), *np.nanpercentile(means, [2.5, 97.5]))


def interval_of_all(cases: Sequence[Case], measure: str, target: Target) -> Interval:
    runs = [[case for case in cases if case.run == run] for run in dict.fromkeys(case.run for case in cases)]
    draws = np.random.default_rng(0).integers(len(runs), size=(RESAMPLES, len(runs)))
    found = [of_all_policies([case for run in draw for case in runs[run]], measure, target) for draw in draws]
    return Interval(of_all_policies(cases, measure, target), *np.nanpercentile(found, [2.5, 97.5]))


def without_a_kind(cases: Sequence[Case], measure: str, target: Target) -> Interval:
    """The mean over policies, and its range if value functions of any one kind are left out."""
    kinds = {case.kind for case in cases}
    kept = [[case for case in cases if case.kind != kind] for kind in kinds]
    means = [mean_within(part, measure, target) for part in kept]
    return Interval(mean_within(cases, measure, target), min(means), max(means))


def print_table(title: str, cases: Sequence[Case], interval: Callable[[Sequence[Case], str, Target], Interval]) -> None:
    targets = {f"bias at λ = {gae_lambda:g}": bias_at(gae_lambda) for gae_lambda in LAMBDAS} | {"best λ": best_lambda}
    print(f"\n{title}\n\n| {' | '.join(['measure', *targets])} |\n| --- |{' ---: |' * len(targets)}")
    for measure in cases[0].measures:
        print(f"| {measure} | {' | '.join(str(interval(cases, measure, target)) for target in targets.values())} |")


def print_tables(title: str, cases: Sequence[Case]) -> None:
    counts = [len({getattr(case, name) for case in cases}) for name in ("policy", "run")]
    places = [PAPER_LAMBDAS.index(gae_lambda) for gae_lambda in LAMBDAS]
    clear = np.mean([case.bias_squared > 2.0 * case.bias_error for case in cases], axis=0)[places]
    print(f"\n{title}: {len(cases)} value functions of {counts[0]} policies of {counts[1]} runs;")
    print(f"bias squared above two standard errors in {', '.join(f'{part:.0%}' for part in clear)} at λ = {LAMBDAS}")
    print_table(f"{title}, within a policy, bootstrap over runs", cases, interval_within)
    print_table(f"{title}, within a policy, range without any one kind of V", cases, without_a_kind)
    print_table(f"{title}, of all policies, bootstrap over runs", cases, interval_of_all)


# --- Figure ---


def draw(groups: dict[str, Sequence[Case]], gae_lambda: float = 0.96) -> Figure:
    measures = (UNEXPLAINED, MONTE_CARLO, TD, GRADIENT)
    figure, axes = plt.subplots(len(groups), len(measures), figsize=(11.0, 2.9 * len(groups) + 0.5), sharey="row",
                                squeeze=False, layout="constrained")  # fmt: skip
    for row, (title, cases) in zip(axes, groups.items(), strict=True):
        for axis, measure in zip(row, measures, strict=True):
            scatter(axis, cases, measure, bias_at(gae_lambda))
            tidy(axis, f"within a policy: ρ = {interval_within(cases, measure, bias_at(gae_lambda)).value:.2f}")
            axis.set_xlabel(measure)
        row[0].set_ylabel(f"{title}\nbias² at λ = {gae_lambda:g}")
    everything = [case for cases in groups.values() for case in cases]
    kinds, tasks = {case.kind for case in everything}, {case.task for case in everything} - {"gridworld"}
    blank = dict(linestyle="", markersize=5)
    handles = [
        *(Line2D([], [], marker="o", color=COLORS[kind], label=f"V: {kind}", **blank) for kind in COLORS if kind in kinds),
        *(Line2D([], [], marker=MARKERS[task], color="gray", label=task, **blank) for task in MARKERS if task in tasks),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False, fontsize=8)
    return figure


def scatter(axis: Axes, cases: Sequence[Case], measure: str, target: Target) -> None:
    """Estimates that noise has made negative are left out: the axes are logarithmic."""
    for task, kind in dict.fromkeys((case.task, case.kind) for case in cases):
        points = [(case.measures[measure], target(case)) for case in cases if (case.task, case.kind) == (task, kind)]
        style = dict(color=COLORS[kind], markersize=3.5, markeredgewidth=0, alpha=0.7, zorder=1)
        axis.plot(*zip(*points, strict=True), MARKERS[task], **style)
    # One picture of all points: as vectors they would take half a megabyte
    axis.set_rasterization_zorder(1.5)
    axis.set(xscale="log", yscale="log")
    if measure == UNEXPLAINED:
        # Less than two decades: matplotlib would label the minor ticks, too
        axis.xaxis.set_major_locator(FixedLocator([0.01, 0.1, 0.3, 1.0, 3.0]))
        axis.xaxis.set_major_formatter("{x:g}")
        axis.xaxis.set_minor_formatter(NullFormatter())


def main() -> None:
    plt.switch_backend("svg")
    plt.rcParams["svg.hashsalt"] = "sb3-gae"
    groups = {"Gridworld": gridworld_cases(), "Training": training_cases(stored())}
    for title, cases in groups.items():
        print_tables(title, cases)
    own = [case for case in groups["Training"] if case.kind == "learned"]
    print_table("Training, the own V of all checkpoints, bootstrap over runs", own, interval_of_all)
    for task in dict.fromkeys(case.task for case in groups["Training"]):
        of_task = [case for case in groups["Training"] if case.task == task]
        if len({case.run for case in of_task}) > 1:
            print_table(f"{task}, within a policy, bootstrap over runs", of_task, interval_within)
    draw(groups).savefig(IMAGE, dpi=130, facecolor="white", metadata={"Date": None, "Creator": None})
    print(f"\nwrote {IMAGE}")


if __name__ == "__main__":
    main()
