"""Figures into files."""

import re
from collections.abc import Callable
from pathlib import Path

import pandas as pd
from matplotlib import rc_context, rcdefaults, rcParams
from matplotlib.figure import Figure

from sb3_gae.sweep.errors import SweepError
from sb3_gae.sweep.figures.curves import curves_figure
from sb3_gae.sweep.figures.heatmap import heatmap_figure
from sb3_gae.sweep.figures.lambda_curve import lambda_figure
from sb3_gae.sweep.figures.style import STYLE

FIGURES: dict[str, Callable[..., Figure]] = {"curves": curves_figure, "heatmap": heatmap_figure, "lambda": lambda_figure}
SUFFIXES = (".png", ".svg")


def write_figure(kind: str, table: pd.DataFrame, output: Path, iteration: int | None, by: str) -> list[Path]:
    """
    :param kind: a key of :data:`FIGURES`
    :param table: what a :class:`~sb3_gae.sweep.selection.Selection` kept
    :param output: as :func:`~sb3_gae.sweep.figures.draw`
    :param iteration: as there
    :param by: as there
    :return: paths of the files
    :raises SweepError: if there is nothing to show, or a file cannot be written
    """
    if output.suffix not in SUFFIXES and re.fullmatch(r"\.[A-Za-z]{2,}", output.suffix):
        raise SweepError(f"`output` must end in {' or '.join(SUFFIXES)}, or have no ending for both, got {output.name!r}.")
    paths = [output] if output.suffix in SUFFIXES else [output.with_name(output.name + suffix) for suffix in SUFFIXES]
    with rc_context():
        # Whatever the process that draws it has set: the same results, the same file
        rcdefaults()
        rcParams.update(STYLE)
        figure = FIGURES[kind](table) if kind == "curves" else FIGURES[kind](table, iteration, by)
        try:
            output.parent.mkdir(parents=True, exist_ok=True)
            for path in paths:
                save_figure(figure, path)
        except OSError as error:
            raise SweepError(f"`output`: {output} cannot be written ({error}); name another file.") from error
    return paths


def save_figure(figure: Figure, path: Path) -> None:
    """
    :param figure: to be saved, the same figure as the same file
    :param path: ending in one of :data:`SUFFIXES`
    """
    # Without the date, and without the version of matplotlib
    metadata = {"Date": None} if path.suffix == ".svg" else {"Software": None}
    figure.savefig(path, dpi=160, bbox_inches="tight", metadata=metadata)
