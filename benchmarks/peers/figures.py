"""Learning curves of the results page. White behind, so that they can be read on a dark page, too."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.peers.aggregates import curve_over_tasks, normalized
from benchmarks.peers.algorithms import ALGORITHMS, TRPO
from benchmarks.peers.comparison import (
    Runs,
    common_algorithms,
    mujoco_runs,
    on_one_processor,
    scores_after,
    training_seconds,
)
from benchmarks.peers.curves import Run, against_seconds, against_steps, scores_of
from benchmarks.peers.protocol import EVALUATIONS, MUJOCO_STEPS
from sb3_gae.sweep.statistics import Estimate, estimate

_COLUMNS = 3


def draw_all(table: pd.DataFrame) -> dict[str, Figure]:
    """
    :param table: of results
    :return: figures by the name of their file; none where there are no results whose times can be compared
    """
    runs = mujoco_runs(table)
    if not (timed := on_one_processor(runs)):
        return {}
    return {
        "peers_steps": _tasks_figure(runs, lambda own: against_steps(own, MUJOCO_STEPS), 1e6, "million steps"),
        "peers_seconds": _tasks_figure(timed, against_seconds, 60.0, "minutes of training"),
        "peers_over_tasks": _over_tasks_figure(runs, timed),
    }


def _tasks_figure(runs: Runs, curve: Callable[[list[Run]], tuple[np.ndarray, np.ndarray]], unit: float, label: str) -> Figure:
    n_rows = -(-len(runs) // _COLUMNS)
    figure = Figure(figsize=(3.4 * min(len(runs), _COLUMNS), 2.7 * n_rows + 0.5), layout="constrained")
    for place, (task, own) in enumerate(runs.items(), start=1):
        axes = figure.add_subplot(n_rows, min(len(runs), _COLUMNS), place)
        for name, algorithm_runs in own.items():
            grid, returns = curve(algorithm_runs)
            _band(axes, name, grid / unit, estimate(returns))
        axes.set_title(task)
        axes.set_xlabel(label)
        if place % _COLUMNS == 1 or len(runs) == 1:
            axes.set_ylabel("return, deterministic policy")
    _legend(figure)
    return figure


def _over_tasks_figure(runs: Runs, timed: Runs) -> Figure:
    figure = Figure(figsize=(9.2, 3.9), layout="constrained")
    by_steps, by_seconds = figure.subplots(1, 2, sharey=True)
    fractions = np.linspace(0, 1, EVALUATIONS + 1)
    reference = [scores_of(own[TRPO]) for own in runs.values()]
    for name in common_algorithms(runs):
        curves = [against_steps(own[name], MUJOCO_STEPS)[1] for own in runs.values()]
        by_evaluation = [normalized([curve[:, place] for curve in curves], reference) for place in range(len(fractions))]
        _band(by_steps, name, fractions, curve_over_tasks(np.stack(by_evaluation, axis=-1)))
    at_times = [scores_after(runs, fraction) for fraction in fractions]
    for name in common_algorithms(timed):
        _band(by_seconds, name, fractions, curve_over_tasks(np.stack([scores[name] for scores in at_times], axis=-1)))
    by_steps.set_xlabel("million steps")
    seconds = [training_seconds(own[TRPO]) for own in timed.values()]
    by_seconds.set_xlabel(f"part of the time that sb3-contrib's TRPO takes ({min(seconds):.0f} to {max(seconds):.0f} s)")
    by_steps.set_ylabel("IQM over tasks, sb3-contrib's TRPO = 1")
    _legend(figure)
    return figure


def _band(axes: Axes, name: str, x: np.ndarray, curve: Estimate) -> None:
    style: dict[str, Any] = {"color": ALGORITHMS[name].colour, "linestyle": ALGORITHMS[name].dash}
    axes.plot(x, curve.iqm, label=ALGORITHMS[name].title, linewidth=1.7, zorder=3, **style)
    axes.fill_between(x, curve.low, curve.high, color=style["color"], alpha=0.15, linewidth=0)
    axes.grid(alpha=0.25)
    axes.set_xlim(left=0)


def _legend(figure: Figure) -> None:
    held = {label: handle for axes in figure.axes for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)}
    figure.legend(held.values(), held.keys(), loc="outside lower center", ncols=3)
