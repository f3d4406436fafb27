"""
Draws docs/images/training_*.svg from what docs/training_diagnostics.py has stored, and prints tables of it.

    python docs/training_figures.py
"""

from collections.abc import Iterable, Sequence
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from gridworld_figures import tidy
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, NullFormatter, NullLocator
from training_diagnostics import TASKS, Result, stored

from sb3_gae.estimators.advantages import effective_horizon
from sb3_gae.presets import PAPER_LAMBDAS

IMAGES = Path(__file__).parent / "images"
TITLES = {"GaeCartPole-v0": "Cart-pole", "Pendulum-v1": "Pendulum", "GaeBiped-v0": "Biped"}
# Early, in between, and late
CHECKPOINTS = {"GaeCartPole-v0": (3, 10, 30), "Pendulum-v1": (5, 20, 50), "GaeBiped-v0": (5, 20, 60)}
COLORS = ("tab:blue", "tab:orange", "tab:green")


def rows_of(rows: Iterable[Result], env: str, iteration: int | None = None) -> list[Result]:
    """:return: by seed and iteration"""
    found = [row for row in rows if row["env"] == env and iteration in (None, row["iteration"])]
    return sorted(found, key=lambda row: (row["seed"], row["iteration"]))


def tasks_of(rows: Iterable[Result]) -> list[str]:
    known = {row["env"] for row in rows}
    return [env for env in TITLES if env in known]


def shown_checkpoints(rows: Iterable[Result], env: str) -> list[int]:
    known = {row["iteration"] for row in rows_of(rows, env)}
    return [iteration for iteration in CHECKPOINTS[env] if iteration in known]


def errors_of(row: Result, kind: str = "own") -> tuple[np.ndarray, np.ndarray]:
    """
    :return: bias squared and variance, each with its standard error, shape (2, L), in units of the variance at λ = 1 with
        the value function that training goes on with
    """
    found = row["value_functions"][kind]
    scale = row["value_functions"]["own"]["variance"][0][-1]
    return np.array(found["bias_squared"]) / scale, np.array(found["variance"]) / scale


def total_error(row: Result, kind: str = "own") -> np.ndarray:
    """Bias squared and variance together, in the same units, shape (L,)."""
    bias_squared, variance = errors_of(row, kind)
    return np.maximum(bias_squared[0], 0.0) + variance[0]


# --- Figures ---


def draw_lambdas(rows: Sequence[Result]) -> Figure:
    tasks = tasks_of(rows)
    figure, axes = plt.subplots(len(tasks), 4, figsize=(12.0, 2.9 * len(tasks)), squeeze=False, layout="constrained")
    titles = ["bias squared", "variance", "bias squared + variance", "advantages"]
    for line, env in zip(axes, tasks, strict=True):
        for axis, title in zip(line, titles, strict=True):
            tidy(axis, f"{TITLES[env]}: {title}")
            show_horizons(axis, TASKS[env].gamma)
        for color, iteration in zip(COLORS, shown_checkpoints(rows, env), strict=False):
            for number, row in enumerate(rows_of(rows, env, iteration)):
                label = f"iteration {iteration}" if number == 0 else None
                draw_errors(line[:3], row, env, color, label)
                draw_advantages(line[3], row, env, color)
        for axis in line[:2]:
            # Linear up to a tenth: estimates of a vanishing bias scatter around zero
            axis.set_yscale("symlog", linthresh=0.1)
            axis.set_ylim(bottom=0.0)
        line[2].set_yscale("log")
        line[2].yaxis.set_major_locator(FixedLocator([0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0]))
        line[2].yaxis.set_major_formatter("{x:g}")
        line[2].yaxis.set_minor_locator(NullLocator())
        # Room for the legend
        line[3].set_ylim(0.0, 1.3 * line[3].get_ylim()[1])
        line[0].set_ylabel("over the variance at λ = 1")
        line[3].set_ylabel("over the deviation at λ = 1")
        line[1].legend(frameon=False, fontsize=8, loc="lower right")
    styles = [plt.Line2D([], [], color="gray", linestyle=style) for style in ("-", "--")]
    labels = ["deviation", "rms difference from λ = 1"]
    axes[0, 3].legend(styles, labels, frameon=False, fontsize=8, loc="upper right")
    return figure


def draw_errors(axes: Sequence[Axes], row: Result, env: str, color: str, label: str | None) -> None:
    """Lines with bands of one standard error; of the sum without one, for the two are not independent."""
    horizons = effective_horizon(TASKS[env].gamma, PAPER_LAMBDAS)
    bias_squared, variance = errors_of(row)
    for axis, (value, error) in zip(axes, (bias_squared, variance), strict=False):
        axis.plot(horizons, value, color=color, linewidth=1.3, label=label)
        axis.fill_between(horizons, value - error, value + error, color=color, alpha=0.15, linewidth=0)
    total = total_error(row)
    axes[2].plot(horizons, total, color=color, linewidth=1.3)
    axes[2].plot(horizons[total.argmin()], total.min(), "o", color=color, markersize=4.5)


def draw_advantages(axis: Axes, row: Result, env: str, color: str) -> None:
    horizons = effective_horizon(TASKS[env].gamma, PAPER_LAMBDAS)
    found = row["advantages"]
    for name, style in (("deviation", "-"), ("rms_difference", "--")):
        axis.plot(horizons, np.array(found[name]) / found["deviation"][-1], color=color, linestyle=style, linewidth=1.3)


def show_horizons(axis: Axes, gamma: float) -> None:
    """A logarithmic axis of horizons, whose ticks also say which λ has them."""
    # Those that have room beside that of λ = 1
    shown = [each for each in (0.0, 0.68, 0.92, 0.98) if effective_horizon(gamma, 1.0) > 1.5 * effective_horizon(gamma, each)]
    shown.append(1.0)
    horizons = effective_horizon(gamma, shown)
    axis.set_xscale("log")
    axis.minorticks_off()
    axis.set_xticks(horizons, [f"{horizon:.0f}\n{gae_lambda:g}" for horizon, gae_lambda in zip(horizons, shown, strict=True)])
    axis.set_xlabel("horizon 1/(1 − γλ) in steps, and λ")


def draw_response(rows: Sequence[Result]) -> Figure:
    tasks = tasks_of(rows)
    n_columns = max(len(shown_checkpoints(rows, env)) for env in tasks)
    figure, axes = plt.subplots(
        len(tasks), n_columns, figsize=(3.4 * n_columns, 2.7 * len(tasks)), squeeze=False, layout="constrained"
    )
    for line, env in zip(axes, tasks, strict=True):
        shown = shown_checkpoints(rows, env)
        for axis in line[len(shown) :]:
            axis.set_axis_off()
        for axis, iteration in zip(line, shown, strict=False):
            tidy(axis, f"{TITLES[env]}, iteration {iteration}")
            for number, row in enumerate(rows_of(rows, env, iteration)):
                draw_norms(axis, row, "response_of_rewards", "tab:red", "rewards" if number == 0 else None)
                draw_norms(axis, row, "response_of_shaped_rewards", "tab:blue", "shaped by V" if number == 0 else None)
            axis.set_xscale("symlog", linthresh=1.0)
            ticks = [tick for tick in (0, 1, 2, 5, 10, 20, 50, 120) if tick <= max(TASKS[env].lags)]
            axis.minorticks_off()
            axis.set_xticks(ticks, [str(tick) for tick in ticks])
            axis.set_yscale("log")
            axis.set_ylim(2e-3, 2.0)
            axis.set_xlabel("delay l in steps")
        line[0].set_ylabel("norm of γˡ gₗ, over the gradient's")
    axes[0, 0].legend(frameon=False, fontsize=8, loc="upper right")
    return figure


def draw_norms(axis: Axes, row: Result, name: str, color: str, label: str | None) -> None:
    lags = np.array(row["lags"])
    discounts = np.square(TASKS[row["env"]].gamma ** lags.astype(float))
    square, error = discounts * np.array(row[name]) / row["squared_gradient"][0]
    low, middle, high = (np.sqrt(np.maximum(each, 0.0)) for each in (square - error, square, square + error))
    # Where noise leaves nothing there is a gap: the axis is logarithmic
    axis.plot(lags, np.where(middle > 0.0, middle, np.nan), color=color, marker=".", markersize=4, linewidth=1.2, label=label)
    axis.fill_between(lags, low, high, color=color, alpha=0.15, linewidth=0)


def draw_values(rows: Sequence[Result]) -> Figure:
    tasks = [env for env in tasks_of(rows) if len({row["iteration"] for row in rows_of(rows, env)}) > 1]
    size = 3.4 * len(tasks) + 2.0, 5.4
    figure, axes = plt.subplots(2, len(tasks), figsize=size, squeeze=False, layout="constrained", sharex="col")
    for (above, below), env in zip(axes.T, tasks, strict=True):
        for seed in sorted({row["seed"] for row in rows_of(rows, env)}):
            own = [row for row in rows_of(rows, env) if row["seed"] == seed]
            first = seed == min(row["seed"] for row in rows_of(rows, env))
            draw_over_iterations(above, own, errors_of_values(own), first)
            draw_over_iterations(below, own, biases(own), first)
        tidy(above, f"{TITLES[env]}: error of V")
        tidy(below, f"{TITLES[env]}: bias squared")
        below.set_xlabel("iteration")
    axes[0, 0].set_ylabel("over the variance of the returns")
    axes[1, 0].set_ylabel("over the squared gradient")
    for line in axes:
        handles, labels = line[0].get_legend_handles_labels()
        line[-1].legend(handles, labels, frameon=False, fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure


def errors_of_values(rows: Sequence[Result]) -> dict[str, np.ndarray]:
    own = [row["value_functions"]["own"] for row in rows]
    scale = np.array([row["value_functions"]["refitted"]["return_variance"] for row in rows])
    return {
        "1 − explained variance": np.array([1.0 - each["explained_variance"] for each in own]),
        "Monte-Carlo error": np.array([each["monte_carlo_error"] for each in own]) / scale,
        "TD error": np.array([each["td_error"] for each in own]) / scale,
    }


def biases(rows: Sequence[Result]) -> dict[str, np.ndarray]:
    curves = np.array(
        [np.array(row["value_functions"]["own"]["bias_squared"][0]) / row["squared_gradient"][0] for row in rows]
    )
    return {f"λ = {each:g}": curves[:, PAPER_LAMBDAS.index(each)] for each in (0.0, 0.92, 0.96)}


def draw_over_iterations(axis: Axes, rows: Sequence[Result], curves: dict[str, np.ndarray], labelled: bool) -> None:
    iterations = [row["iteration"] for row in rows]
    for color, (name, values) in zip(COLORS, curves.items(), strict=True):
        # What noise has made negative has no place on a logarithmic axis
        label = name if labelled else None
        axis.plot(iterations, np.where(values > 0.0, values, np.nan), ".-", color=color, linewidth=1.2, label=label)
    axis.set_yscale("log")
    axis.yaxis.set_minor_formatter(NullFormatter())


# --- Tables ---


def print_medians(rows: Sequence[Result]) -> None:
    """Over all checkpoints of all seeds: the error of a batch's gradient at fixed λ and at the best one."""
    shown = (0.0, 0.68, 0.92, 0.96, 0.98, 1.0)
    places = [PAPER_LAMBDAS.index(each) for each in shown]
    names = ["task", "checkpoints", "V", *(f"λ = {each:g}" for each in shown), "best λ", "its error", "middle half of best λ"]
    print(f"| {' | '.join(names)} |\n|{' --- |' * len(names)}")
    for env in tasks_of(rows):
        own = rows_of(rows, env)
        for kind in ("own", "refitted"):
            totals = np.array([total_error(row, kind) for row in own])
            best = np.take(PAPER_LAMBDAS, totals.argmin(axis=1))
            numbers = [*np.median(totals[:, places], axis=0), np.median(best), np.median(totals.min(axis=1))]
            low, high = np.percentile(best, [25, 75], method="nearest")
            cells = [TITLES[env], str(len(own)), kind, *(f"{number:.2f}" for number in numbers), f"{low:g} to {high:g}"]
            print(f"| {' | '.join(cells)} |")


def print_table(rows: Sequence[Result]) -> None:
    """Of the value function that training goes on with; numbers of all seeds."""
    columns = ["task", "iteration", "return", "squared gradient", "bias² at 0", "0.92", "0.96", "best λ", "its error", "0.96"]
    print(f"| {' | '.join(columns)} |\n|{' --- |' * len(columns)}")
    for row in sorted(rows, key=lambda row: (list(TITLES).index(row["env"]), row["iteration"], row["seed"])):
        bias_squared, bias_error = errors_of(row)[0]
        total = total_error(row)
        places = [PAPER_LAMBDAS.index(each) for each in (0.0, 0.92, 0.96)]
        cells = [
            row["env"],
            str(row["iteration"]),
            "–" if row["mean_return"] is None else f"{row['mean_return']:.0f}",
            f"{row['squared_gradient'][0] / row['value_functions']['own']['variance'][0][-1]:.2f}",
            *(f"{bias_squared[place]:.2f} ± {bias_error[place]:.2f}" for place in places),
            f"{PAPER_LAMBDAS[total.argmin()]:g}",
            f"{total.min():.2f}",
            f"{total[places[-1]]:.2f}",
        ]
        print(f"| {' | '.join(cells)} |")


def main() -> None:
    plt.switch_backend("svg")
    plt.rcParams["svg.hashsalt"] = "sb3-gae"
    rows = stored()
    print_medians(rows)
    print()
    print_table(rows)
    figures = {"lambdas": draw_lambdas(rows), "response": draw_response(rows), "values": draw_values(rows)}
    for name, figure in figures.items():
        path = IMAGES / f"training_{name}.svg"
        figure.savefig(path, facecolor="white", metadata={"Date": None, "Creator": None})
        print(f"wrote {path}")


if __name__ == "__main__":
    main()
