"""What all figures look like."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sb3_gae.sweep.series import Series

#: white behind, so that a figure can be read on a dark page as well
STYLE: Any = {
    "figure.facecolor": "white",
    "savefig.facecolor": "white",
    "font.size": 9.5,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlesize": 10.5,
    "axes.titlelocation": "left",
    "legend.frameon": False,
    "svg.hashsalt": "sb3-gae",
}

RETURN_LABEL = "mean return of the iteration's episodes"
#: of conditions without λ
GREY = "0.25"
#: of the best
RED = "#d62728"


def new_figure(width: float, height: float) -> tuple[Figure, Axes]:
    """
    :param width: inches
    :param height: inches
    :return: a figure that belongs to no window, and its axes
    """
    figure = Figure(figsize=(width, height), layout="constrained")
    return figure, figure.add_subplot()


def line_styles(series: Sequence[Series]) -> list[dict[str, Any]]:
    """
    :param series: in the order in which they are drawn
    :return: for each: colours in that order, a condition without λ in grey; dashes tell γ apart
    """
    n_with_lambda = sum(one.curve.gae_lambda is not None for one in series)
    shades = iter(colormaps["turbo"](np.linspace(0.06, 0.92, max(n_with_lambda, 1))))
    gammas = sorted({one.curve.gamma for one in series if one.curve.gae_lambda is not None}, reverse=True)
    dashes = ("-", "--", "-.", ":")
    styles: list[dict[str, Any]] = []
    for one in series:
        if one.curve.gae_lambda is None:
            styles.append({"color": GREY, "linestyle": (0, (5, 2)), "linewidth": 2.0})
        else:
            dash = dashes[gammas.index(one.curve.gamma) % len(dashes)]
            styles.append({"color": next(shades), "linestyle": dash, "linewidth": 1.7})
    return styles


def readable_on(colour: Sequence[float]) -> str:
    """
    :param colour: red, green, blue in [0, 1]
    :return: black or white, whichever can be read on it
    """
    red, green, blue = colour[:3]
    return "black" if 0.299 * red + 0.587 * green + 0.114 * blue > 0.55 else "white"
