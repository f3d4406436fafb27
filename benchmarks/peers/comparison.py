"""What the tables and figures say, as numbers."""

import functools
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
import pandas as pd

from benchmarks.peers.aggregates import Interval, Scores, normalized
from benchmarks.peers.algorithms import OURS, TRPO
from benchmarks.peers.curves import Run, all_runs, first_reach, scores_of
from benchmarks.peers.protocol import MUJOCO_STEPS, MUJOCO_TASKS
from sb3_gae.sweep.statistics import estimate, interquartile_mean

#: runs of each algorithm, by task
Runs = dict[str, dict[str, list[Run]]]


def mujoco_runs(table: pd.DataFrame) -> Runs:
    """
    :param table: of results
    :return: of the tasks that ours and sb3-contrib's TRPO have both been run on
    """
    found = {task: all_runs(table, task, MUJOCO_STEPS) for task in MUJOCO_TASKS}
    return {task: runs for task, runs in found.items() if OURS in runs and TRPO in runs}


def on_one_processor(runs: Runs) -> Runs:
    """
    :param runs: of all tasks
    :return: of each task the runs on that processor which most of both ours and sb3-contrib's TRPO have been run on, so that
        their seconds can be compared, of several such that with most of them in all; without the tasks that have none
    """
    found = {task: max(_by_processor(own), key=_numbers_of_runs) for task, own in runs.items()}
    return {task: own for task, own in found.items() if min(_numbers_of_runs(own)) > 0}


def _by_processor(own: dict[str, list[Run]]) -> list[dict[str, list[Run]]]:
    processors = sorted({run.processor for of_one in own.values() for run in of_one})
    parts = [
        {name: [run for run in of_one if run.processor == processor] for name, of_one in own.items()}
        for processor in processors
    ]
    return [{name: of_one for name, of_one in part.items() if of_one} for part in parts]


def _numbers_of_runs(own: dict[str, list[Run]]) -> list[int]:
    """Of ours and of sb3-contrib's TRPO, the smaller one first."""
    return sorted(len(own.get(name, [])) for name in (OURS, TRPO))


def score(runs: list[Run]) -> Interval:
    """
    :param runs: of one algorithm on one task
    :return: interquartile mean of the scores
    """
    return _score(tuple(scores_of(runs)))


@functools.cache
def _score(scores: tuple[float, ...]) -> Interval:
    # Several tables and targets ask for the same one
    return Interval(*(float(part[0]) for part in estimate(np.array(scores)[:, None])))


def verdict(own: dict[str, list[Run]]) -> str:
    """
    :param own: runs of one task by algorithm
    :return: whether ours is at least as good as sb3-contrib's TRPO
    """
    ours, other = score(own[OURS]), score(own[TRPO])
    if ours.point >= other.point:
        return "yes"
    return "no" if ours.high < other.low else "within the bands"


def returns_after(runs: list[Run], seconds: float) -> np.ndarray:
    """
    :param runs: of one algorithm on one task
    :param seconds: of training
    :return: return of each run then; its last one if it has ended by then, shape (runs,)
    """
    return np.array([np.interp(seconds, run.seconds, run.returns) for run in runs])


def training_seconds(runs: list[Run]) -> float:
    """
    :param runs: of one algorithm on one task
    :return: median over runs of what the whole training takes
    """
    return float(np.median([run.seconds[-1] for run in runs]))


def common_algorithms(runs: Runs) -> list[str]:
    """
    :param runs: of all tasks
    :return: algorithms that have been run on every one of them
    """
    return [name for name in next(iter(runs.values()), {}) if all(name in own for own in runs.values())]


def final_scores(runs: Runs) -> Scores:
    """
    :param runs: of all tasks
    :return: scores of each algorithm that has all tasks, in units of sb3-contrib TRPO's
    """
    reference = [scores_of(own[TRPO]) for own in runs.values()]
    return {name: normalized([scores_of(own[name]) for own in runs.values()], reference) for name in common_algorithms(runs)}


def scores_after(runs: Runs, fraction: float) -> Scores:
    """
    :param runs: of all tasks
    :param fraction: of the time that sb3-contrib's TRPO trains for on each task
    :return: scores of each algorithm then, in units of sb3-contrib TRPO's at its end, over the tasks that
        :func:`on_one_processor` has; the units are of all runs
    """
    timed = on_one_processor(runs)
    reference = [scores_of(runs[task][TRPO]) for task in timed]
    until = [fraction * training_seconds(own[TRPO]) for own in timed.values()]
    return {
        name: normalized(
            [returns_after(own[name], seconds) for own, seconds in zip(timed.values(), until, strict=True)], reference
        )
        for name in common_algorithms(timed)
    }


class Reach(NamedTuple):
    """
    How soon ours is where sb3-contrib's TRPO ends, and how soon TRPO is there for the first time. Medians over runs, infinite
    where half of them never are. What has to do with seconds is of the runs on one processor, all else of all.

    :param target: interquartile mean of TRPO's scores
    :param steps: of ours
    :param peer_steps: of TRPO, to get there for the first time
    :param seconds: of ours
    :param peer_seconds: of TRPO, to get there for the first time
    :param peer_training: of TRPO, for the whole training
    """

    target: float
    steps: float
    peer_steps: float
    seconds: float
    peer_seconds: float
    peer_training: float

    @property
    def part(self) -> float:
        """Seconds of ours, of those of TRPO's training."""
        return self.seconds / self.peer_training


def is_learned(own: dict[str, list[Run]]) -> bool:
    """
    :param own: runs of one task by algorithm
    :return: whether sb3-contrib's TRPO ends with more than it begins with, so that what it ends with says something
    """
    begins = np.array([run.returns[0] for run in own[TRPO]])
    return float(interquartile_mean(scores_of(own[TRPO]))) > float(interquartile_mean(begins))


def learned(runs: Runs) -> Runs:
    """
    :param runs: of all tasks
    :return: of those that sb3-contrib's TRPO learns
    """
    return {task: own for task, own in runs.items() if is_learned(own)}


def unlearned(runs: Runs) -> list[str]:
    """
    :param runs: of all tasks
    :return: the tasks that sb3-contrib's TRPO does not learn
    """
    return [task for task, own in runs.items() if not is_learned(own)]


def times_to_reach(runs: Runs) -> dict[str, Reach]:
    """
    :param runs: of all tasks
    :return: times until the first evaluation at or above the target, of each task that TRPO learns and
        :func:`on_one_processor` has
    """
    return {task: _time_to_reach(own, runs[task]) for task, own in on_one_processor(learned(runs)).items()}


def _time_to_reach(timed: dict[str, list[Run]], own: dict[str, list[Run]]) -> Reach:
    target = float(interquartile_mean(scores_of(own[TRPO])))

    def steps(name: str) -> float:
        return float(np.median([first_reach(run, target)[0] for run in own[name]]))

    def seconds(name: str) -> float:
        return float(np.median([first_reach(run, target)[1] for run in timed[name]]))

    return Reach(target, steps(OURS), steps(TRPO), seconds(OURS), seconds(TRPO), training_seconds(timed[TRPO]))


def fewest_runs(groups: Iterable[list[Run]]) -> int:
    """
    :param groups: of runs that something is said of
    :return: the smallest number of runs; 0 of none
    """
    return min((len(runs) for runs in groups), default=0)
