"""Learning curves."""

from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from sb3_gae.sweep.errors import SweepError
from sb3_gae.sweep.figures.style import RETURN_LABEL, line_styles, new_figure
from sb3_gae.sweep.figures.wording import label_of, mean_over_seeds, what
from sb3_gae.sweep.series import Series, series_of
from sb3_gae.sweep.statistics import estimate


def curves_figure(table: pd.DataFrame) -> Figure:
    """
    Interquartile mean over seeds at each iteration, and its bootstrap interval of 95 % as a band.

    Where episodes end in fewer than half of all iterations, as those of environments in step do, dots say in which.

    :param table: what a :class:`~sb3_gae.sweep.selection.Selection` kept
    :return: the figure
    :raises SweepError: if there is no iteration by which an episode had ended in every run
    """
    series = series_of(table)
    n_iterations = max(one.returns.shape[1] for one in series)
    figure, axes = new_figure(7.8, 4.3)
    for one, style in zip(series, line_styles(series), strict=True):
        # From where every run has had an episode
        known = ~np.isnan(one.returns).any(axis=0)
        if not known.any():
            raise SweepError("There are no curves to draw: in some runs no episode has ended; run more --iterations.")
        iterations = 1 + np.flatnonzero(known)
        result = estimate(one.returns[:, known])
        axes.plot(iterations, result.iqm, label=label_of(one.curve, series), zorder=3, **style, **_dots(one, known))
        axes.fill_between(iterations, result.low, result.high, color=style["color"], alpha=0.13, linewidth=0)
    axes.set_xlabel("iteration (batch)")
    axes.set_ylabel(RETURN_LABEL)
    axes.set_xlim(1, max(2, n_iterations))
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.grid(alpha=0.25)
    axes.legend(loc="center left", bbox_to_anchor=(1.01, 0.5), fontsize=9)
    dots = ", dots: episodes ended" if any(_is_sparse(one) for one in series) else ""
    axes.set_title(f"{what(table, series)}\n{mean_over_seeds(series)}, bands: 95 % bootstrap intervals{dots}")
    return figure


def _is_sparse(one: Series) -> bool:
    return float(one.ended.any(axis=0).mean()) < 0.5


def _dots(one: Series, known: np.ndarray) -> dict[str, Any]:
    """Of a line that would otherwise look as if each of its steps were measured."""
    if not _is_sparse(one):
        return {}
    places = np.flatnonzero(one.ended[:, known].any(axis=0))
    return {"marker": "o", "markersize": 4.0, "markevery": places.tolist()}
