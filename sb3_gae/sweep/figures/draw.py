"""Figures into files."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pandas as pd
from matplotlib import rc_context
from matplotlib.figure import Figure

from sb3_gae.sweep.errors import SweepError
from sb3_gae.sweep.figures.curves import curves_figure
from sb3_gae.sweep.figures.heatmap import heatmap_figure
from sb3_gae.sweep.figures.lambda_curve import lambda_figure
from sb3_gae.sweep.figures.style import STYLE
from sb3_gae.sweep.results import select

FIGURES: dict[str, Callable[..., Figure]] = {"curves": curves_figure, "heatmap": heatmap_figure, "lambda": lambda_figure}
SUFFIXES = (".png", ".svg")


def draw(kind: str, table: pd.DataFrame, output: str | Path, iteration: int | None = None, **selection: Any) -> list[Path]:
    """
    Draw a figure as PNG and SVG. The same results give the same files, bit for bit.

    :param kind: ``curves``, ``heatmap`` or ``lambda``
    :param table: of results
    :param output: path; with the ending ``.png`` or ``.svg`` only that one is written
    :param iteration: whose returns are shown, from 1; None for the last. Of no use to ``curves``
    :param selection: arguments of :func:`~sb3_gae.sweep.results.select`
    :return: paths of the files
    :raises SweepError: if the selection has nothing to show, or a file cannot be written
    """
    if kind not in FIGURES:
        raise SweepError(f"`figure` knows {', '.join(FIGURES)}, got {kind!r}.")
    chosen = select(table, **selection)
    output = Path(output)
    paths = [output] if output.suffix in SUFFIXES else [output.with_name(output.name + suffix) for suffix in SUFFIXES]
    with rc_context(STYLE):
        figure = FIGURES[kind](chosen) if kind == "curves" else FIGURES[kind](chosen, iteration)
        try:
            output.parent.mkdir(parents=True, exist_ok=True)
            for path in paths:
                _save(figure, path)
        except OSError as error:
            raise SweepError(f"`output`: {output} cannot be written ({error}); name another file.") from error
    return paths


def _save(figure: Figure, path: Path) -> None:
    # Without the date, and without the version of matplotlib
    metadata = {"Date": None} if path.suffix == ".svg" else {"Software": None}
    figure.savefig(path, dpi=160, bbox_inches="tight", metadata=metadata)
