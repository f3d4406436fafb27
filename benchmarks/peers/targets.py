"""What the benchmark is to show, and whether it does."""

import math
from collections.abc import Collection, Iterable

import pandas as pd

from benchmarks.peers.aggregates import Interval, Scores, interquartile_means, ratio
from benchmarks.peers.algorithms import ALGORITHMS, OURS, TRPO
from benchmarks.peers.comparison import (
    Runs,
    fewest_runs,
    final_scores,
    learned,
    mujoco_runs,
    on_one_processor,
    score,
    times_to_reach,
    unlearned,
    verdict,
)
from benchmarks.peers.curves import Run, all_runs, runs_of
from benchmarks.peers.page import markdown_table
from benchmarks.peers.plan import CLASSIC_SEEDS, FEW_SEEDS, SEEDS
from benchmarks.peers.protocol import CLASSIC_TASKS, LONG_STEPS, MUJOCO_TASKS, PUBLISHED_PPO
from benchmarks.peers.texts import decimal_text, is_any_former, number

#: how many times as large as the best peer's ours is to be, over all tasks and over those that sb3-contrib's TRPO learns
GOAL = 1.3


def targets_table(table: pd.DataFrame) -> str:
    """
    :param table: of results
    :return: each target, what was measured, on how many of the tasks that are planned, and whether it is met
    """
    runs = mujoco_runs(table)
    rows = [*_mujoco_targets(runs)] if runs else []
    classic = {task: all_runs(table, task, steps) for task, steps in CLASSIC_TASKS.items()}
    if complete := {task: own for task, own in classic.items() if OURS in own and TRPO in own}:
        short = [task for task, own in complete.items() if verdict(own) != "yes"]
        measured = f"{len(complete) - len(short)} of {len(complete)} tasks" + (f"; not {', '.join(short)}" if short else "")
        behind = _Behind([own[name] for own in complete.values() for name in (OURS, TRPO)], len(complete), CLASSIC_TASKS)
        rows.append(["classic control: at least as good as the zoo's trpo", measured, *behind.met(not short, CLASSIC_SEEDS)])
    long = {task: runs_of(table, task, OURS, LONG_STEPS) for task in PUBLISHED_PPO}
    if found := {task: score(own).point for task, own in long.items() if own}:
        below = [task for task, value in found.items() if value <= PUBLISHED_PPO[task]]
        measured = ", ".join(f"{task} {number(value)}" for task, value in found.items())
        behind = _Behind([own for own in long.values() if own], len(found), PUBLISHED_PPO)
        rows.append(["3 million steps: above tianshou's published PPO", measured, *behind.met(not below)])
    return markdown_table(["target", "measured", "tasks", "fewest runs", "met"], rows)


def _mujoco_targets(runs: Runs) -> Iterable[list[str]]:
    scores = final_scores(runs)
    best, factor = _best_peer(scores)
    missing = [ALGORITHMS[name].title for name in ALGORITHMS if name not in scores]
    without = f"; without {' and '.join(missing)}" if missing else ""
    of_learned, on_learned = _on_learned_tasks(runs)
    is_met = factor.point >= GOAL
    only_with = ", ".join(unlearned(runs)) if is_met and of_learned < GOAL else ""
    of_all = _Behind([own[name] for own in runs.values() for name in scores], len(runs), MUJOCO_TASKS)
    yield [
        f"IQM over tasks at least {GOAL} times the best peer's",
        f"{decimal_text(factor, of_all.fewest)} ({ALGORITHMS[best].title}{without}){on_learned}",
        *of_all.met(is_met, FEW_SEEDS, is_complete=not missing, only_with=only_with),
    ]
    under = [task for task, own in runs.items() if verdict(own) == "no"]
    of_both = _Behind([own[name] for own in runs.values() for name in (OURS, TRPO)], len(runs), MUJOCO_TASKS)
    yield ["no task under sb3-contrib's TRPO by more than the bands", ", ".join(under) or "none is", *of_both.met(not under)]
    if not on_one_processor(runs):
        return
    timed = on_one_processor(learned(runs))
    parts = {task: reach.part for task, reach in times_to_reach(runs).items()}
    slow = [f"{task} ({part:.2f})" if math.isfinite(part) else f"{task} (never)" for task, part in parts.items() if part > 0.2]
    measured = "not on " + ", ".join(slow) if slow else f"on all {len(parts)} that it learns" if parts else "it learns none"
    planned = [task for task in MUJOCO_TASKS if task not in unlearned(runs)]
    of_timed = _Behind([own[name] for own in timed.values() for name in (OURS, TRPO)], len(timed), planned)
    yield ["its final return in a fifth of its time", measured, *of_timed.met(not slow and bool(parts))]


def _best_peer(scores: Scores) -> tuple[str, Interval]:
    """Whose interquartile mean is the largest, and how many times as large ours is."""
    means = {name: mean.point for name, mean in interquartile_means(scores).items() if name != OURS}
    best = max(means, key=lambda name: means[name])
    return best, ratio(scores[OURS], scores[best], scores[TRPO])


def _on_learned_tasks(runs: Runs) -> tuple[float, str]:
    """The same without tasks whose unit is less than what an untrained agent gets: how many times as large, and in words."""
    if not (without := unlearned(runs)) or len(without) == len(runs):
        return math.inf, ""
    of_learned = learned(runs)
    scores = final_scores(of_learned)
    best, factor = _best_peer(scores)
    fewest = fewest_runs(own[name] for own in of_learned.values() for name in scores)
    return factor.point, f"; without {', '.join(without)} {decimal_text(factor, fewest)} ({ALGORITHMS[best].title})"


class _Behind:
    """
    What a statement stands on.

    :param groups: of runs
    :param n_tasks: that they are of
    :param planned: all tasks that the statement is about
    """

    def __init__(self, groups: list[list[Run]], n_tasks: int, planned: Collection[str]):
        self.fewest = fewest_runs(groups)
        self._tasks = f"{n_tasks} of {len(planned)}"
        self._is_settled = n_tasks == len(planned) and not any(map(is_any_former, groups))

    def met(self, is_met: bool, enough: int = SEEDS, is_complete: bool = True, only_with: str = "") -> tuple[str, str, str]:
        """Tasks and runs that it stands on, and whether it holds, or with which tasks alone."""
        answer = f"only with {only_with}" if only_with else "yes" if is_met else "**no**"
        is_settled = self._is_settled and is_complete and self.fewest >= enough
        return self._tasks, str(self.fewest), answer if is_settled else f"so far {answer}"
