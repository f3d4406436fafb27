"""Markdown of the results page."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from benchmarks.peers.page import markdown_table
from benchmarks.speed.case import DOUBLE_BACKWARD, LIMIT, OURS, PEER
from benchmarks.speed.table import TITLES, Group, Row, groups_of
from benchmarks.speed.targets import TARGETS

#: keys of a result's origin, as they are shown
_ORIGIN = {
    "processor": "processor",
    "cores_of_run": "cores",
    "python": "Python",
    "sb3_gae": "sb3-gae",
    "commit": "commit",
    "torch": "torch",
    "numpy": "NumPy",
    "mujoco": "mujoco",
    "envpool": "envpool",
    "stable_baselines3": "stable-baselines3",
    "sb3_contrib": "sb3-contrib",
}


def targets_table(rows: Sequence[Row]) -> str:
    """
    :param rows: of what was timed in turn
    :return: each target, what was measured at the largest size, and whether it is met
    """
    by_name = {(row["part"], row["varied"]): row for row in rows}
    cells = [
        [
            target.title,
            f"{target.varied} {_whole(row['size'])}",
            f"{row['ratio']:.2f} ({row['low']:.2f} to {row['high']:.2f})",
            f"{1.0 / row['ratio']:.2f}",
            "yes" if row["ratio"] <= target.largest else "**no**",
        ]
        for target in TARGETS
        if (row := by_name.get((target.part, target.varied))) is not None
    ]
    return markdown_table(["target", "at", "times the limit's time", "times its speed", "met"], cells)


def parts_table(rows: Sequence[Row]) -> str:
    """
    :param rows: of what was timed
    :return: cost of each part at each size, and its ratios to peer and limit
    """
    cells = [_part_cells(group, size) for group in groups_of(rows) for size in group.sizes]
    heads = ["part", "size", "ours", "interquartile range", "double backward", "peer", "limit", "peer / ours", "ours / limit"]
    return markdown_table(heads, cells)


def _part_cells(group: Group, size: int) -> list[str]:
    found = {who: group.at(who, size) for who in TITLES}
    ours = found[OURS]
    costs = ["" if found[who] is None else duration(found[who]["median"]) for who in (DOUBLE_BACKWARD, PEER, LIMIT)]  # type: ignore[index]
    ratios = [group.ratio(PEER, OURS, size), group.ratio(OURS, LIMIT, size)]
    own = ["", ""] if ours is None else [duration(ours["median"]), duration(ours["iqr"])]
    shown = ["" if ratio is None else f"{ratio:.2f}" for ratio in ratios]
    return [group.part, f"{group.varied} {_whole(size)}", *own, *costs, *shown]


def growth_table(rows: Sequence[Row]) -> str:
    """
    :param rows: of what was timed
    :return: the exponents with which cost grows
    """
    cells = []
    for group in groups_of(rows):
        found = {who: group.growth(who) for who in TITLES if who in group.contenders}
        shown = [f"{found[who]:.2f}" if who in found and math.isfinite(found[who]) else "" for who in TITLES]
        cells.append([group.part, f"{group.varied} {_whole(group.sizes[0])} to {_whole(group.sizes[-1])}", *shown])
    return markdown_table(["part", "size", *TITLES.values()], cells)


def arithmetic_table(rows: Sequence[Row]) -> str:
    """
    :param rows: of what was timed
    :return: operations of the parts that have a count, the rate of them, and what the run took
    """
    cells = []
    for row in rows:
        if row["contender"] == OURS and "operations" in row:
            rate = row["operations"] / row["median"] / 1e9
            work = [str(row[name]) if name in row else "" for name in ("cg_steps", "trials")]
            count = f"{row['operations'] / 1e9:.3g}"
            cells.append([row["part"], f"{row['varied']} {_whole(row['size'])}", count, f"{rate:.1f}", *work])
    heads = ["part", "size", "operations, 10⁹", "ours, 10⁹ a second", "steps of conjugate gradient", "trials of line searches"]
    return markdown_table(heads, cells)


def seconds_table(rows: Sequence[Row]) -> str:
    """
    :param rows: of the sections of iterations
    :return: seconds of each, and their share
    """
    cells = []
    for task in dict.fromkeys(row["task"] for row in rows):
        of = [row for row in rows if row["task"] == task]
        whole = sum(row["seconds"] for row in of)
        for row in of:
            cells.append(
                [
                    f"{task}, {_whole(row['batch'])} steps",
                    row["phase"],
                    row["part"],
                    duration(row["seconds"]),
                    f"{100 * row['seconds'] / whole:.0f} %",
                ]
            )
    return markdown_table(["iteration", "phase", "part", "time", "share"], cells)


def threads_table(rows: Sequence[Row]) -> str:
    """
    :param rows: of combinations of threads
    :return: times of an iteration with each
    """
    cells = [
        [
            f"{row['task']}, {_whole(row['batch'])} steps",
            f"{row['torch_threads']}",
            f"{row['physics_threads']}",
            "nothing set" if row["nothing_set"] else "",
            *(duration(row[name]) for name in ("rollout", "update", "iteration", "processor")),
        ]
        for row in rows
    ]
    heads = ["iteration", "torch threads", "physics threads", "", "rollout", "update", "whole", "time of processors"]
    return markdown_table(heads, cells)


def origin_list(found: Mapping[str, Any]) -> str:
    """
    :param found: a file of results
    :return: versions and machine that it is from
    """
    if not found["rows"]:
        return ""
    lines = [f"- {title}: {found['origin'][name]}" for name, title in _ORIGIN.items() if name in found["origin"]]
    lines += [f"- threads of torch and of the physics: {found['threads']}"] if "threads" in found else []
    lines += ["- **by `--quick`: these numbers mean nothing**"] if found.get("quick") else []
    return "\n".join(lines)


def duration(seconds: float) -> str:
    """
    :param seconds: not negative
    :return: with three digits, in a unit that suits
    """
    for factor, unit in ((1.0, "s"), (1e3, "ms"), (1e6, "µs")):
        if seconds * factor >= 1.0 or unit == "µs":
            return f"{_three_digits(seconds * factor)} {unit}"
    raise AssertionError


def _three_digits(value: float) -> str:
    return f"{value:.{max(0, 2 - math.floor(math.log10(value)))}f}" if value > 0.0 else "0"


def _whole(value: int) -> str:
    return f"{value:,}".replace(",", " ")
