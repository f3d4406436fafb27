"""The map of γ and λ."""

from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from sb3_gae.sweep.figures.style import RED, new_figure, readable_on
from sb3_gae.sweep.figures.wording import best, mean_name, rounded, what
from sb3_gae.sweep.series import Series, scores_of, series_of, with_lambda
from sb3_gae.sweep.statistics import estimate_each


def heatmap_figure(table: pd.DataFrame, iteration: int | None = None, by: str = "last") -> Figure:
    """
    Interquartile mean over seeds; each cell has its number of seeds, the best one a frame.

    :param table: what a :class:`~sb3_gae.sweep.selection.Selection` kept
    :param iteration: from 1; None for the last
    :param by: one of :data:`~sb3_gae.sweep.series.SCORES`
    :return: the figure
    :raises SweepError: if there is not one condition with λ
    """
    series = with_lambda(series_of(table))
    values, when = scores_of(series, by, iteration)
    results = estimate_each(values)
    means = [float(result.iqm[0]) for result in results]
    gammas = sorted({one.curve.gamma for one in series})
    lambdas = sorted({one.curve.gae_lambda or 0.0 for one in series})
    # Column and row of each
    places = [(lambdas.index(one.curve.gae_lambda or 0.0), gammas.index(one.curve.gamma)) for one in series]
    figure, axes = new_figure(2.2 + 0.66 * max(len(lambdas), 5), 1.5 + 0.5 * max(len(gammas), 3))
    mesh = _draw_cells(axes, places, means, (len(gammas), len(lambdas)))
    _write_into_cells(axes, mesh, places, means, series)
    first = int(np.argmax(means))
    axes.add_patch(Rectangle(places[first], 1, 1, fill=False, edgecolor=RED, linewidth=2.4, clip_on=False, zorder=5))
    axes.set_xticks(np.arange(len(lambdas)) + 0.5, [f"{value:g}" for value in lambdas])
    axes.set_yticks(np.arange(len(gammas)) + 0.5, [f"{value:g}" for value in gammas])
    axes.tick_params(length=0)
    axes.set_xlabel("λ")
    axes.set_ylabel("γ", rotation=0, labelpad=10)
    axes.spines[:].set_visible(False)
    colorbar = figure.colorbar(mesh, ax=axes, label=f"mean return {when} ({mean_name(series)})", pad=0.02)
    colorbar.outline.set_visible(False)
    axes.set_title(f"{what(table, series)}\nbest (framed): {best(series[first].curve, results[first])}")
    return figure


def _draw_cells(axes: Axes, places: list[tuple[int, int]], means: list[float], shape: tuple[int, int]) -> QuadMesh:
    grid = np.full(shape, np.nan)
    for (column, row), mean in zip(places, means, strict=True):
        grid[row, column] = mean
    # What was not run stays grey
    axes.set_facecolor("0.9")
    edges = (np.arange(shape[1] + 1), np.arange(shape[0] + 1))
    return axes.pcolormesh(*edges, grid, cmap="viridis", edgecolors="white", linewidth=0.8)


def _write_into_cells(
    axes: Axes, mesh: QuadMesh, places: list[tuple[int, int]], means: list[float], series: list[Series]
) -> None:
    for (column, row), mean, one in zip(places, means, series, strict=True):
        red, green, blue = mesh.to_rgba(np.array([mean]))[0, :3]
        font: Any = {"ha": "center", "va": "center", "color": readable_on((red, green, blue))}
        axes.text(column + 0.5, row + 0.6, rounded(mean), fontsize=9.5, **font)
        axes.text(column + 0.5, row + 0.23, f"n = {one.n_seeds}", fontsize=6.5, **font)
