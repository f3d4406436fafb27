"""The paper's figures, drawn from a table of results and nothing else."""

from pathlib import Path

import pandas as pd

from sb3_gae.sweep.errors import SweepError
from sb3_gae.sweep.selection import EVERYTHING, Selection

KINDS = ("curves", "heatmap", "lambda")


def draw(
    kind: str,
    table: pd.DataFrame,
    output: str | Path,
    iteration: int | None = None,
    by: str = "last",
    selection: Selection = EVERYTHING,
) -> list[Path]:
    """
    Draw a figure as PNG and SVG. The same results give the same files, bit for bit.

    :param kind: ``curves``, ``heatmap`` or ``lambda``
    :param table: of results
    :param output: path; with the ending ``.png`` or ``.svg`` only that one is written
    :param iteration: whose returns are shown, from 1; None for the last. Of no use to ``curves``
    :param by: ``last`` for the returns of that iteration, ``training`` for the mean over all until then
    :param selection: which runs of the table are shown
    :return: paths of the files
    :raises SweepError: if the selection has nothing to show, or a file cannot be written
    """
    if kind not in KINDS:
        raise SweepError(f"`figure` knows {', '.join(KINDS)}, got {kind!r}.")
    chosen = selection.of(table)
    # Every process of a sweep would wait for matplotlib and rliable
    from sb3_gae.sweep.figures.files import write_figure

    return write_figure(kind, chosen, Path(output), iteration, by)
