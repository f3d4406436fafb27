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
# Of a few conditions that have no order: Okabe and Ito's, which the colour-blind can tell apart
_UNORDERED = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9")
# Of conditions without λ, where there are several: none of the colours of λ, and dashes for those who see no colours
_WITHOUT_LAMBDA: tuple[tuple[str, tuple[int, ...]], ...] = (
    ("0.25", (5, 2)),
    ("#d6289a", (2, 1)),
    ("black", (6, 1, 1, 1)),
    ("#8c564b", (1, 1)),
)


def line_styles(series: Sequence[Series]) -> list[dict[str, Any]]:
    """
    :param series: in the order in which they are drawn
    :return: for each: conditions without λ dashed; colours tell λ apart and dashes γ, or colours all where there are
        more γ than dashes, or several conditions
    """
    of_lambda = [one.curve for one in series if one.curve.gae_lambda is not None]
    gammas = sorted({curve.gamma for curve in of_lambda}, reverse=True)
    by_lambda = len(gammas) <= len(_DASHES) and len({curve.condition for curve in of_lambda}) == 1
    hues = list(dict.fromkeys(curve.gae_lambda if by_lambda else curve for curve in of_lambda))
    ordered = by_lambda or len(hues) > len(_UNORDERED)
    shades = colormaps["turbo"](np.linspace(0.06, 0.92, max(len(hues), 1))) if ordered else _UNORDERED
    without = [one.curve for one in series if one.curve.gae_lambda is None]
    styles: list[dict[str, Any]] = []
    for one in series:
        if one.curve.gae_lambda is None:
            styles.append(style_without_lambda(without.index(one.curve)))
        else:
            shade = shades[hues.index(one.curve.gae_lambda if by_lambda else one.curve)]
            dash = _DASHES[gammas.index(one.curve.gamma)] if by_lambda else "-"
            styles.append({"color": shade, "linestyle": dash, "linewidth": 1.7})
    return styles


def style_without_lambda(place: int) -> dict[str, Any]:
    """
    :param place: of a condition among those without λ
    :return: of its line
    """
    colour, dashes = _WITHOUT_LAMBDA[place % len(_WITHOUT_LAMBDA)]
    return {"color": colour, "linestyle": (0, dashes), "linewidth": 2.0}


def readable_on(colour: Sequence[float]) -> str:
    """
    :param colour: red, green, blue in [0, 1]
    :return: black or white, whichever can be read on it
    """
    red, green, blue = colour[:3]
    return "black" if 0.299 * red + 0.587 * green + 0.114 * blue > 0.55 else "white"
