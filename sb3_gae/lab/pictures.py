"""
Charts as SVG text, as pure functions of numbers. Colours are CSS classes, so that a page's theme decides them.

Nothing but numbers and the labels of this package goes into a picture.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from sb3_gae.gridworld import MOVE_NAMES, MOVES

WIDTH, HEIGHT = 420, 150
_LEFT, _RIGHT, _TOP, _BOTTOM = 46, 10, 10, 22
# No screen shows more points of a curve
_MAX_POINTS = 300


class Line(NamedTuple):
    """
    :param xs: shape (n,)
    :param ys: not-a-numbers are left out, shape (n,)
    :param style: CSS class
    """

    xs: np.ndarray
    ys: np.ndarray
    style: str


class Band(NamedTuple):
    """
    :param xs: shape (n,)
    :param lows: shape (n,)
    :param highs: shape (n,)
    :param style: CSS class
    """

    xs: np.ndarray
    lows: np.ndarray
    highs: np.ndarray
    style: str


class Axes(NamedTuple):
    """
    :param label: what a screen reader says of the whole chart
    :param x_range: of the picture
    :param y_range: of the picture
    :param y_format: of a number at the axis
    :param x_label: under the axis
    """

    label: str
    x_range: tuple[float, float]
    y_range: tuple[float, float]
    y_format: Callable[[float], str] = "{:g}".format
    x_label: str = "step"


def line_chart(axes: Axes, lines: Sequence[Line], marks: Sequence[float] = (), bands: Sequence[Band] = ()) -> str:
    """
    :param axes: of the chart
    :param lines: drawn over each other
    :param marks: places on the x axis to mark with an upright line
    :param bands: drawn under all
    :return: an ``<svg>`` element
    """
    parts = [*(_band(axes, band) for band in bands), *(_upright(axes, place) for place in marks)]
    for line in lines:
        kept = np.isfinite(line.ys)
        xs, ys = np.asarray(line.xs, dtype=float)[kept], np.asarray(line.ys, dtype=float)[kept]
        stride = max(1, len(xs) // _MAX_POINTS)
        # Counted from the end, so that the present is always in the picture
        points = " ".join(
            f"{_x(axes, x):.1f},{_y(axes, y):.1f}" for x, y in zip(xs[::-1][::stride], ys[::-1][::stride], strict=True)
        )
        parts.append(f'<polyline class="line {line.style}" points="{points}"/>')
        if len(xs):
            parts.append(f'<circle class="dot {line.style}" cx="{_x(axes, xs[-1]):.1f}" cy="{_y(axes, ys[-1]):.1f}" r="3"/>')
    return _framed(axes, parts)


def bar_chart(axes: Axes, heights: Sequence[np.ndarray], styles: Sequence[str], lines: Sequence[Line] = ()) -> str:
    """
    :param axes: of the chart; bar number k stands from k - 0.5 to k + 0.5
    :param heights: of groups of bars side by side, each of shape (n,)
    :param styles: CSS class of each group
    :param lines: drawn over the bars
    :return: an ``<svg>`` element
    """
    parts, width = [], 0.8 / len(heights)
    base = _y(axes, 0.0)
    thickness = max(_x(axes, width) - _x(axes, 0.0), 0.5)
    for group, (values, style) in enumerate(zip(heights, styles, strict=True)):
        # One path for all: a browser takes far longer for as many elements
        outlines = []
        for place, value in enumerate(values):
            left, top = _x(axes, place - 0.4 + group * width), _y(axes, float(value))
            outlines.append(f"M{left:.1f} {base:.1f}h{thickness:.1f}V{top:.1f}h-{thickness:.1f}z")
        parts.append(f'<path class="bar {style}" d="{"".join(outlines)}"/>')
    for line in lines:
        points = " ".join(f"{_x(axes, x):.1f},{_y(axes, y):.1f}" for x, y in zip(line.xs, line.ys, strict=True))
        parts.append(f'<polyline class="line {line.style}" points="{points}"/>')
    return _framed(axes, parts)


def round_up(value: float) -> float:
    """
    :param value: of data
    :return: the next of 1, 2 and 5 times a power of ten, for the end of an axis
    """
    if not 0.0 < value < np.inf:
        return 1.0
    power = 10.0 ** np.floor(np.log10(value))
    return float(next(power * factor for factor in (1.0, 2.0, 5.0, 10.0, 20.0) if power * factor >= value))


def cell_arrows(probabilities: np.ndarray) -> str:
    """
    :param probabilities: of the moves in one cell, shape (4,)
    :return: an ``<svg>`` with an arrow for each, as long as it is probable, the longest marked as the favourite
    """
    favourite, arrows = int(np.argmax(probabilities)), []
    # The favourite last, over the others
    for move in sorted(range(len(MOVES)), key=lambda move: move == favourite):
        down, right = MOVES[move]
        reach = 4.0 + 16.0 * float(probabilities[move])
        x, y = 24.0 + right * reach, 24.0 + down * reach
        style, head = ("favourite", 5.0) if move == favourite else ("other", 2.5)
        tip = f"{x + right * head:.1f},{y + down * head:.1f}"
        sides = [f"{x + sign * down * head * 0.8:.1f},{y + sign * right * head * 0.8:.1f}" for sign in (1, -1)]
        arrows.append(
            f'<g class="arrow {style}"><line x1="24" y1="24" x2="{x:.1f}" y2="{y:.1f}"/>'
            f'<polygon points="{tip} {sides[0]} {sides[1]}"/></g>'
        )
    return f'<svg viewBox="0 0 48 48" aria-hidden="true" focusable="false">{"".join(arrows)}</svg>'


def favourite_move(probabilities: np.ndarray) -> str:
    """
    :param probabilities: of the moves in one cell, shape (4,)
    :return: name of the most probable
    """
    return MOVE_NAMES[int(np.argmax(probabilities))]


def _x(axes: Axes, x: float) -> float:
    low, high = axes.x_range
    return float(_LEFT + (WIDTH - _LEFT - _RIGHT) * (x - low) / ((high - low) or 1.0))


def _y(axes: Axes, y: float) -> float:
    low, high = axes.y_range
    within = min(max(y, low), high)
    return float(_TOP + (HEIGHT - _TOP - _BOTTOM) * (high - within) / ((high - low) or 1.0))


def _upright(axes: Axes, place: float) -> str:
    x = _x(axes, place)
    return f'<line class="mark" x1="{x:.1f}" x2="{x:.1f}" y1="{_TOP}" y2="{HEIGHT - _BOTTOM}"/>'


def _band(axes: Axes, band: Band) -> str:
    # There on one side and back on the other
    xs, ys = np.append(band.xs, band.xs[::-1]), np.append(band.lows, band.highs[::-1])
    points = " ".join(f"{_x(axes, x):.1f},{_y(axes, y):.1f}" for x, y in zip(xs, ys, strict=True))
    return f'<polygon class="band {band.style}" points="{points}"/>'


def _framed(axes: Axes, parts: Sequence[str]) -> str:
    low, high = axes.y_range
    frame = []
    for y in np.linspace(low, high, 5 if low < 0.0 < high else 3).tolist():
        place = f'x1="{_LEFT}" x2="{WIDTH - _RIGHT}" y1="{_y(axes, y):.1f}" y2="{_y(axes, y):.1f}"'
        frame.append(f'<line class="grid" {place}/>')
        frame.append(f'<text x="{_LEFT - 5}" y="{_y(axes, y) + 4:.1f}" text-anchor="end">{axes.y_format(y)}</text>')
    for x, anchor in zip(axes.x_range, ("start", "end"), strict=True):
        # Bars stand half a place further out than the first and the last number
        shown = x + 0.5 if anchor == "start" and x % 1.0 else x - 0.5 if x % 1.0 else x
        frame.append(f'<text x="{_x(axes, shown):.1f}" y="{HEIGHT - 6}" text-anchor="{anchor}">{shown:g}</text>')
    frame.append(f'<text x="{(_LEFT + WIDTH) / 2}" y="{HEIGHT - 6}" text-anchor="middle">{axes.x_label}</text>')
    content = "".join((*frame, *parts))
    return f'<svg class="chart" viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{axes.label}">{content}</svg>'
