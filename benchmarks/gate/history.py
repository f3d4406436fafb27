"""The history of what the gate measured, as a figure."""

from pathlib import Path

import matplotlib.pyplot as plt
import pandas as pd

from benchmarks.gate.parts import PARTS
from benchmarks.gate.records import HISTORY

FIGURE = Path(__file__).parents[2] / "docs" / "images" / "gate_history.svg"


def draw(history: Path = HISTORY, figure_path: Path = FIGURE) -> Path:
    """
    A panel for each number: its value at each recorded commit, and the band that it was judged by.

    :param history: CSV file
    :param figure_path: to be written
    :return: ``figure_path``
    """
    table = pd.read_csv(history, dtype={"commit": str})
    names = list(dict.fromkeys(table["name"]))
    columns = 4
    rows = -(-len(names) // columns)
    figure, axes = plt.subplots(rows, columns, figsize=(3.0 * columns, 2.4 * rows), layout="constrained", squeeze=False)
    for axis, name in zip(axes.flat, names, strict=False):
        of = table[table["name"] == name]
        places = range(len(of))
        # Bars, since an area between single points is none
        axis.vlines(places, of["low"], of["high"], alpha=0.2, linewidth=10)
        axis.plot(places, of["value"], "o-", markersize=4)
        axis.set_xticks(places, [commit[:7] for commit in of["commit"].fillna("")], rotation=60, fontsize=7)
        axis.set_title(name, fontsize=9)
        axis.set_ylabel(PARTS[of["part"].iloc[0]].unit, fontsize=8)
    for axis in axes.flat[len(names) :]:
        axis.set_visible(False)
    figure.savefig(figure_path)
    plt.close(figure)
    return figure_path
