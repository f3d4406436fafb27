"""The parts of the gate: what each measures, what is recorded of it, and the bands that follow from that."""

import datetime
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from benchmarks.gate.bands import SPEED_MARGIN, WORK_MARGIN, Band, cost_band, learning_band
from benchmarks.gate.learning import RUNS, SEEDS, learning_scores
from benchmarks.gate.speed import speed_ratios
from benchmarks.gate.work import work_counts
from benchmarks.peers.provenance import processor
from sb3_gae.sweep.provenance import provenance

#: of what is recorded by seed; the gate itself uses others
RECORDED_SEEDS = range(100, 120)
#: runs of a recording of speed
RECORDED_RUNS = 5
#: recordings of speed that are kept. Ratios differ more between days than within one recording
KEPT_RECORDINGS = 6


class Part(NamedTuple):
    """
    :param measure: what the gate judges, by name
    :param record: what bands are made from, given what was recorded before (None if nothing was)
    :param bands: by name, of what is recorded
    :param unit: of the numbers
    """

    measure: Callable[[], dict[str, float]]
    record: Callable[[Any], Any]
    bands: Callable[[Any], dict[str, Band]]
    unit: str


def record_work(_before: Any) -> dict[str, dict[str, float]]:
    """:return: counts by name and seed"""
    return _by_name({str(seed): work_counts(seed) for seed in RECORDED_SEEDS})


def work_bands(recorded: dict[str, dict[str, float]]) -> dict[str, Band]:
    """:return: by name"""
    return {name: cost_band(list(counts.values()), WORK_MARGIN) for name, counts in recorded.items()}


def record_speed(before: list[dict[str, Any]] | None) -> list[dict[str, Any]]:
    """:return: recordings, the last ones of before first: ratios by name and run, and when and on what they were taken"""
    ratios = _by_name({run: speed_ratios() for run in range(RECORDED_RUNS)})
    recording = {
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "commit": provenance()["commit"],
        "processor": processor(),
        "ratios": {name: list(runs.values()) for name, runs in ratios.items()},
    }
    return [*(before or []), recording][-KEPT_RECORDINGS:]


def speed_bands(recorded: list[dict[str, Any]]) -> dict[str, Band]:
    """:return: by name, for what the last recording has"""
    return {
        name: cost_band([float(np.median([ratio for of in recorded for ratio in of["ratios"].get(name, [])]))], SPEED_MARGIN)
        for name in recorded[-1]["ratios"]
    }


def measure_learning() -> dict[str, float]:
    """:return: mean score over the gate's seeds, by name"""
    return {name: float(np.mean(learning_scores(name))) for name in RUNS}


def record_learning(_before: Any) -> dict[str, dict[str, float]]:
    """:return: scores by name and seed"""
    return {name: {str(seed): round(learning_scores(name, [seed])[0], 2) for seed in RECORDED_SEEDS} for name in RUNS}


def learning_bands(recorded: dict[str, dict[str, float]]) -> dict[str, Band]:
    """:return: by name, for the mean over the gate's seeds"""
    return {name: learning_band(list(scores.values()), len(SEEDS)) for name, scores in recorded.items()}


def _by_name(runs: dict[Any, dict[str, float]]) -> dict[str, dict[Any, float]]:
    names = next(iter(runs.values()))
    return {name: {run: round(numbers[name], 4) for run, numbers in runs.items()} for name in names}


#: by name, the quickest first
PARTS = {
    "work": Part(work_counts, record_work, work_bands, "count"),
    "speed": Part(speed_ratios, record_speed, speed_bands, "ratio of times"),
    "learning": Part(measure_learning, record_learning, learning_bands, "mean return"),
}
