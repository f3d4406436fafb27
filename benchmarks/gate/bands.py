"""Within which limits a measured number counts as unchanged, derived from recorded ones (pure functions)."""

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

#: deviations of the mean that are still taken for chance: once in about 16 000 where it is normally distributed
LEARNING_DEVIATIONS = 4.0
#: by how much a ratio of times may exceed the median of what is recorded: unchanged code differs by as much as a fifth between
#: kinds of processor, and between days on one kind
SPEED_MARGIN = 1.5
#: by how much a count may exceed the largest of other seeds: a step of conjugate gradient more in one of the value steps
WORK_MARGIN = 1.05


class Band(NamedTuple):
    """
    :param low: the least that passes
    :param high: the most that passes
    """

    low: float
    high: float

    def holds(self, value: float) -> bool:
        """
        :param value: measured
        :return: whether it is within the band; a value that is not a number never is
        """
        return self.low <= value <= self.high


def learning_band(recorded: Sequence[float], n_seeds: int) -> Band:
    """
    :param recorded: scores of many seeds
    :param n_seeds: of those whose mean is judged
    :return: for the mean; a score above it is as suspicious as one below
    :raises ValueError: if there are fewer than two scores
    """
    if len(recorded) < 2:
        raise ValueError(f"`recorded` must hold at least two scores, got {len(recorded)}.")
    mean, deviation = float(np.mean(recorded)), float(np.std(recorded, ddof=1))
    # Two means, of the recorded and of the judged
    reach = LEARNING_DEVIATIONS * deviation * math.sqrt(1.0 / n_seeds + 1.0 / len(recorded))
    return Band(mean - reach, mean + reach)


def cost_band(recorded: Sequence[float], margin: float) -> Band:
    """
    :param recorded: costs of several runs
    :param margin: how many times the largest of them still passes
    :return: without a lower end: cheaper is never wrong
    :raises ValueError: if nothing is recorded
    """
    if not recorded:
        raise ValueError("`recorded` must hold at least one cost.")
    return Band(0.0, margin * max(recorded))


def verdicts(measured: Mapping[str, float], bands: Mapping[str, Band]) -> dict[str, bool]:
    """
    :param measured: by name
    :param bands: by name
    :return: whether each is within its band
    :raises ValueError: if there is no band for a name
    """
    if missing := sorted(set(measured) - set(bands)):
        raise ValueError(f"Nothing is recorded of {', '.join(missing)}; record it: python -m benchmarks.gate record")
    return {name: bands[name].holds(value) for name, value in measured.items()}
