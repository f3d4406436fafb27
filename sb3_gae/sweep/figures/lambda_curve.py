"""The return as a function of λ, at one γ."""

from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sb3_gae.sweep.conditions import CONDITIONS
from sb3_gae.sweep.errors import SweepError
from sb3_gae.sweep.figures.style import RED, RETURN_LABEL, new_figure, style_without_lambda
from sb3_gae.sweep.figures.wording import best, mean_over_seeds, what
from sb3_gae.sweep.series import Series, scores_of, series_of, with_lambda
from sb3_gae.sweep.statistics import Estimate, estimate_each


def lambda_figure(table: pd.DataFrame, iteration: int | None = None, by: str = "last") -> Figure:
    """
    What each λ loses against the best one, a U between bias and variance; the right-hand axis has the return itself.

    :param table: what a :class:`~sb3_gae.sweep.selection.Selection` kept
    :param iteration: from 1; None for the last
    :param by: one of :data:`~sb3_gae.sweep.series.SCORES`
    :return: the figure
    :raises SweepError: if there is not one γ and one condition with λ, or there are fewer than two λ
    """
    everything = series_of(table)
    series = _rising(with_lambda(everything))
    without = [one for one in everything if one.curve.gae_lambda is None]
    values, when = scores_of([*series, *without], by, iteration)
    results = estimate_each(values)
    of_lambda, of_others = results[: len(series)], results[len(series) :]
    first = int(np.argmax([result.iqm[0] for result in of_lambda]))
    top = float(of_lambda[first].iqm[0])
    figure, axes = new_figure(6.8, 4.3)
    _draw_u(axes, of_lambda, top, first)
    _draw_others(axes, without, of_others, top)
    axes.set_xticks(range(len(series)), [f"{one.curve.gae_lambda:g}" for one in series])
    axes.set_xlabel("λ (evenly spaced, not to scale)")
    axes.set_ylabel(f"return lost against the best λ, {when}")

    def below(value: Any) -> Any:
        return top - value

    right = axes.secondary_yaxis("right", functions=(below, below))
    right.set_ylabel(RETURN_LABEL)
    axes.grid(alpha=0.25)
    axes.legend(loc="best", fontsize=9)
    shown = f"{mean_over_seeds([*series, *without])}, band: 95 % bootstrap interval"
    axes.set_title(f"{what(table, series)}\nbest: {best(series[first].curve, of_lambda[first])}\n{shown}")
    return figure


def _rising(series: list[Series]) -> list[Series]:
    gammas = sorted({one.curve.gamma for one in series})
    if len(gammas) != 1:
        held = ", ".join(f"{gamma:g}" for gamma in gammas)
        raise SweepError(f"A λ curve is drawn at one γ, and the selection has {held}; choose one with --gammas.")
    if len(series) < 2:
        raise SweepError("A λ curve needs at least two λ, and the selection has one.")
    return sorted(series, key=lambda one: one.curve.gae_lambda or 0.0)


def _draw_u(axes: Axes, results: list[Estimate], top: float, first: int) -> None:
    losses: np.ndarray = top - np.array([[float(part[0]) for part in result] for result in results])
    iqm, low, high = losses.T
    axes.fill_between(range(len(results)), high, low, color="C0", alpha=0.16, linewidth=0)
    axes.plot(range(len(results)), iqm, "o-", color="C0", zorder=3, label="value function and λ")
    axes.plot([first], [iqm[first]], "o", color=RED, markersize=8, zorder=4, linestyle="none", label="best λ")


def _draw_others(axes: Axes, series: list[Series], results: list[Estimate], top: float) -> None:
    for place, (one, result) in enumerate(zip(series, results, strict=True)):
        style, label = style_without_lambda(place), CONDITIONS[one.curve.condition].title
        axes.axhline(top - float(result.iqm[0]), label=label, **style)
        axes.axhspan(top - float(result.high[0]), top - float(result.low[0]), color=style["color"], alpha=0.1, linewidth=0)
