"""How long the runs that are left will take."""

import csv
from collections.abc import Iterable, Mapping
from pathlib import Path

import gymnasium as gym

from benchmarks.peers.algorithms import TRPO
from benchmarks.peers.journal import Record
from benchmarks.peers.plan import Cell
from benchmarks.peers.protocol import EPISODES, EVALUATIONS

SPEEDS = Path(__file__).with_name("speeds.csv")
#: stands in the place of an algorithm for the steps of an evaluation
EVALUATION = "evaluation"
COLUMNS = ("task", "algorithm", "steps_per_cpu_second")

#: steps in a second of one core, by task and algorithm
Speeds = Mapping[tuple[str, str], float]


def read_speeds(path: Path = SPEEDS) -> dict[tuple[str, str], float]:
    """
    :param path: of a table that ``python -m benchmarks.peers measure`` wrote
    :return: its numbers
    """
    with path.open() as file:
        return {(row["task"], row["algorithm"]): float(row["steps_per_cpu_second"]) for row in csv.DictReader(file)}


def cost_of(cell: Cell, speeds: Speeds, runs: Iterable[tuple[Cell, Record]]) -> float:
    """
    :param cell: of the plan
    :param speeds: measured beforehand
    :param runs: that have been run, here
    :return: seconds of one core that the whole run takes, with its evaluations
    """
    known = [
        seconds / record.steps * cell.steps
        for other, record in runs
        if (other.task, other.algorithm, other.variant) == (cell.task, cell.algorithm, cell.variant)
        and record.steps > 0
        and (seconds := seconds_of(record)) > 0
    ]
    return sum(known) / len(known) if known else _expected(cell, speeds)


def seconds_of(record: Record) -> float:
    """
    :param record: of a run
    :return: that it took until its last evaluation, with all evaluations
    """
    if not record.evaluations:
        return 0.0
    return float(record.evaluations[-1]["cpu_seconds"]) + sum(line["evaluation_seconds"] for line in record.evaluations)


def _expected(cell: Cell, speeds: Speeds) -> float:
    # A peer that was not there when speeds were measured is taken to be as fast as the one that is most like it
    speed = speeds.get((cell.task, cell.algorithm)) or speeds[cell.task, TRPO]
    longest = gym.spec(cell.task).max_episode_steps or 1000
    # Episodes that last to their time limit, which is the most that an evaluation can take
    evaluation = EPISODES * longest / speeds[cell.task, EVALUATION]
    return cell.steps / speed + (EVALUATIONS + 1) * evaluation
