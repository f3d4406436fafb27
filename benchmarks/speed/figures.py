"""Figures of the results page, in Okabe and Ito's colours. White behind, so that they can be read on a dark page, too."""

from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter, NullLocator

from benchmarks.speed.case import DOUBLE_BACKWARD, LIMIT, OURS, PEER
from benchmarks.speed.stopwatch import POLICY_STEP, ROLLOUT, UPDATE, VALUE_FIT
from benchmarks.speed.table import TITLES, Group, Row, groups_of

_LINES: dict[str, dict[str, Any]] = {
    OURS: {"color": "#0072b2", "marker": "o"},
    DOUBLE_BACKWARD: {"color": "#56b4e9", "marker": "s", "linestyle": "--"},
    PEER: {"color": "#d55e00", "marker": "^"},
    LIMIT: {"color": "#000000", "marker": "", "linestyle": ":"},
}
_COLUMNS = 4
_AXES = {"batch": "steps in the batch", "parameters": "parameters of the policy"}

# Of a rollout, and of an update
_ROLLOUT_PARTS = {
    "physics": "#0072b2",
    "policy": "#e69f00",
    "rewards and endings": "#009e73",
    "resets": "#f0e442",
    "normalisation": "#cc79a7",
    "advantages": "#56b4e9",
    "bookkeeping": "#d55e00",
}
_UPDATE_PARTS = {
    "gradient": "#0072b2",
    "curvature products": "#e69f00",
    "preconditioner": "#cc79a7",
    "line search": "#009e73",
    "other": "#999999",
}


def growth_figure(rows: Sequence[Row]) -> Figure:
    """
    :param rows: of what was timed
    :return: a panel for each part and varied size: cost against size
    """
    groups = groups_of(rows)
    n_rows = -(-len(groups) // _COLUMNS)
    figure = Figure(figsize=(3.0 * _COLUMNS, 2.45 * n_rows + 0.4), layout="constrained")
    for place, group in enumerate(groups, start=1):
        _growth_panel(figure.add_subplot(n_rows, _COLUMNS, place), group, first_in_row=place % _COLUMNS == 1)
    held = {label: line for axes in figure.axes for line, label in zip(*axes.get_legend_handles_labels(), strict=True)}
    order = [title for title in TITLES.values() if title in held]
    figure.legend([held[title] for title in order], order, loc="outside lower center", ncols=len(order))
    return figure


def _growth_panel(axes: Axes, group: Group, first_in_row: bool) -> None:
    for who in group.contenders:
        found = [(size, row["median"], row["iqr"]) for size in group.sizes if (row := group.at(who, size)) is not None]
        sizes, medians, spreads = zip(*found, strict=True)
        axes.errorbar(sizes, medians, yerr=[spread / 2 for spread in spreads], label=TITLES[who], markersize=4, **_LINES[who])
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xticks(group.sizes)
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.0f}".replace(",", "\u202f")))
    axes.xaxis.set_minor_locator(NullLocator())
    low, high = axes.get_ylim()
    # At least two labels
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if high < 30.0 * low else (1.0,)))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: _tick(value)))
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.tick_params(labelsize=8)
    axes.set_title(group.part, fontsize=9)
    axes.set_xlabel(_AXES.get(group.varied, group.varied), fontsize=8.5)
    if first_in_row:
        axes.set_ylabel("time")
    axes.grid(alpha=0.25)


def _tick(seconds: float) -> str:
    for factor, unit in ((1.0, "s"), (1e3, "ms"), (1e6, "µs")):
        if seconds * factor > 0.999:
            return f"{seconds * factor:.0f} {unit}"
    return f"{1e6 * seconds:g} µs"


def seconds_figure(rows: Sequence[Row]) -> Figure:
    """
    :param rows: of the sections of iterations
    :return: for each task the rollout and the phases of the update, each cut into its parts, to the same scale
    """
    tasks = list(dict.fromkeys(row["task"] for row in rows))
    figure = Figure(figsize=(9.6, 1.9 * len(tasks) + 1.3), layout="constrained")
    panels = figure.subplots(len(tasks), 2, sharex="row", squeeze=False)
    for task, (rollout, update) in zip(tasks, panels, strict=True):
        of = [row for row in rows if row["task"] == task]
        _bars(rollout, [row for row in of if row["phase"] == ROLLOUT], (ROLLOUT,), _ROLLOUT_PARTS)
        _bars(update, [row for row in of if row["phase"] != ROLLOUT], (POLICY_STEP, VALUE_FIT, UPDATE), _UPDATE_PARTS)
        steps = f"{of[0]['batch']:,}".replace(",", "\u202f")
        rollout.set_title(f"{task}, {steps} steps: rollout")
        update.set_title("update")
    for axes in panels[-1]:
        axes.legend(loc="upper center", bbox_to_anchor=(0.45, -0.4), ncols=3, fontsize=8.5)
    return figure


def _bars(axes: Axes, rows: Sequence[Row], phases: Sequence[str], parts: Mapping[str, str]) -> None:
    seconds = {(row["phase"], row["part"]): row["seconds"] for row in rows}
    ends = [0.0] * len(phases)
    for part, colour in parts.items():
        lengths = [1e3 * seconds.get((phase, part), 0.0) for phase in phases]
        axes.barh(phases, lengths, 0.6, left=ends, color=colour, label=part, edgecolor="white", linewidth=0.5)
        ends = [end + length for end, length in zip(ends, lengths, strict=True)]
    axes.set_yticks(range(len(phases)), ["the rest" if phase == UPDATE else phase for phase in phases])
    # One bar as thick as each of several
    axes.set_ylim(len(phases) - 0.4, -0.6) if len(phases) > 1 else axes.set_ylim(1.6, -1.6)
    axes.set_xlabel("milliseconds")
    axes.set_axisbelow(True)
    axes.grid(axis="x", alpha=0.25)
