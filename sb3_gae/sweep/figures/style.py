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

RETURN_LABEL = "mean episode return (sum of rewards)"
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


_DASHES = ("-", "--", "-.", ":")


def line_styles(series: Sequence[Series]) -> list[dict[str, Any]]:
    """
    :param series: in the order in which they are drawn
    :return: for each: a condition without λ in grey; colours tell λ apart and dashes γ, or colours all where there are
        more γ than dashes, or several conditions
    """
    of_lambda = [one.curve for one in series if one.curve.gae_lambda is not None]
    gammas = sorted({curve.gamma for curve in of_lambda}, reverse=True)
    by_lambda = len(gammas) <= len(_DASHES) and len({curve.condition for curve in of_lambda}) == 1
    hues = list(dict.fromkeys(curve.gae_lambda if by_lambda else curve for curve in of_lambda))
    shades = colormaps["turbo"](np.linspace(0.06, 0.92, max(len(hues), 1)))
    styles: list[dict[str, Any]] = []
    for one in series:
        if one.curve.gae_lambda is None:
            styles.append({"color": GREY, "linestyle": (0, (5, 2)), "linewidth": 2.0})
        else:
            shade = shades[hues.index(one.curve.gae_lambda if by_lambda else one.curve)]
            dash = _DASHES[gammas.index(one.curve.gamma)] if by_lambda else "-"
            styles.append({"color": shade, "linestyle": dash, "linewidth": 1.7})
    return styles


def readable_on(colour: Sequence[float]) -> str:
    """
    :param colour: red, green, blue in [0, 1]
    :return: black or white, whichever can be read on it
    """
    red, green, blue = colour[:3]
    return "black" if 0.299 * red + 0.587 * green + 0.114 * blue > 0.55 else "white"
