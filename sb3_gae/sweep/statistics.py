"""Interquartile means over seeds, with stratified bootstrap intervals, as rliable recommends and computes them."""

import contextlib
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from rliable import library
from scipy import stats

CONFIDENCE = 0.95
RESAMPLES = 2_000
#: runs from which on the interquartile mean leaves some out; of fewer it is the mean
TRIMMED_FROM = 4


class Estimate(NamedTuple):
    """
    :param iqm: interquartile mean over runs, shape (P,)
    :param low: lower end of the interval of 95 %, shape (P,)
    :param high: upper end, shape (P,)
    """

    iqm: np.ndarray
    low: np.ndarray
    high: np.ndarray


def interquartile_mean(values: np.ndarray) -> np.ndarray:
    """
    :param values: shape (runs, ...)
    :return: mean over the middle half of the runs, shape (...); the plain mean of fewer than four
    """
    return np.asarray(stats.trim_mean(values, proportiontocut=0.25, axis=0))


def estimate(values: np.ndarray, resamples: int = RESAMPLES) -> Estimate:
    """
    :param values: one task's scores, shape (runs, P)
    :param resamples: of the bootstrap
    :return: for each of the P points by itself; the same numbers at each call
    """
    with fixed_random_numbers():
        points, intervals = library.get_interval_estimates(
            {"": values[:, None, :]},  # rliable's axes: runs, tasks, points
            lambda scores: interquartile_mean(scores[:, 0]),
            reps=resamples,
            confidence_interval_size=CONFIDENCE,
        )
    low, high = intervals[""]
    return Estimate(points[""], low, high)


def estimate_each(samples: Sequence[np.ndarray]) -> list[Estimate]:
    """
    :param samples: one task's scores at different points, each of shape (runs,); their numbers of runs may differ
    :return: for each, with arrays of shape (1,)
    """
    results: list[Estimate | None] = [None] * len(samples)
    # One bootstrap for all of a size
    for size in {len(sample) for sample in samples}:
        places = [place for place, sample in enumerate(samples) if len(sample) == size]
        together = estimate(np.stack([samples[place] for place in places], axis=1))
        for column, place in enumerate(places):
            results[place] = Estimate(*(part[column : column + 1] for part in together))
    return [result for result in results if result is not None]


def difference(better: np.ndarray, other: np.ndarray, resamples: int = RESAMPLES) -> Estimate:
    """
    :param better: scores of one set of runs, shape (runs,)
    :param other: of another; the numbers of runs may differ
    :param resamples: of the bootstrap, which draws both sets independently
    :return: by how much the interquartile mean of the first is larger, with arrays of shape (1,)
    """
    with fixed_random_numbers():
        points, intervals = library.get_interval_estimates(
            {"": (better[:, None], other[:, None])},  # runs, tasks
            lambda first, second: interquartile_mean(first) - interquartile_mean(second),
            reps=resamples,
            confidence_interval_size=CONFIDENCE,
        )
    low, high = intervals[""]
    return Estimate(points[""], low, high)


@contextlib.contextmanager
def fixed_random_numbers() -> Iterator[None]:
    """rliable draws from NumPy's global generator, whatever it is given."""
    before = np.random.get_state()
    np.random.seed(0)
    try:
        yield
    finally:
        np.random.set_state(before)
