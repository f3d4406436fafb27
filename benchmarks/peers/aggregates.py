"""Over tasks, as rliable recommends and computes it."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from rliable import library, metrics

from benchmarks.peers.errors import PeersError
from sb3_gae.sweep.statistics import CONFIDENCE, RESAMPLES, Estimate, fixed_random_numbers, interquartile_mean

#: scores of several algorithms: for each, an array of shape (runs, tasks)
Scores = dict[str, np.ndarray]


class Interval(NamedTuple):
    """
    :param point: an estimate
    :param low: lower end of its interval of 95 %
    :param high: upper end
    """

    point: float
    low: float
    high: float


def normalized(scores: list[np.ndarray], reference: list[np.ndarray]) -> np.ndarray:
    """
    :param scores: of one algorithm, for each task those of its runs
    :param reference: of the algorithm that counts as 1, likewise
    :return: scores in units of the reference's interquartile mean, shape (runs, tasks), with as many runs as all tasks have
    :raises PeersError: if a reference is not positive, so that to be a multiple of it means nothing
    """
    units = [float(interquartile_mean(runs)) for runs in reference]
    if any(unit <= 0 for unit in units):
        raise PeersError("`reference` must be positive for each task, or nothing can be a multiple of it.")
    n_runs = min(len(runs) for runs in scores)
    return np.stack([runs[:n_runs] / unit for runs, unit in zip(scores, units, strict=True)], axis=1)


def interquartile_means(scores: Scores) -> dict[str, Interval]:
    """
    :param scores: normalised, of each algorithm
    :return: over its runs and tasks
    """
    return {name: _interval((own,), metrics.aggregate_iqm) for name, own in scores.items()}


def curve_over_tasks(scores: np.ndarray) -> Estimate:
    """
    :param scores: normalised, of one algorithm at P points of its trainings, shape (runs, tasks, P)
    :return: interquartile means over runs and tasks at each point
    """
    return _bootstrap((scores,), lambda drawn: interquartile_mean(drawn.reshape(-1, drawn.shape[-1])))


def improvement(first: np.ndarray, second: np.ndarray) -> Interval:
    """
    :param first: scores of one algorithm, shape (runs, tasks)
    :param second: of another
    :return: probability that a run of the first is better than one of the second, mean over tasks
    """
    return _interval((first, second), probability_of_improvement)


def probability_of_improvement(first: np.ndarray, second: np.ndarray) -> float:
    """
    What ``rliable.metrics.probability_of_improvement`` gives, in a hundredth of its time, which a bootstrap needs.

    :param first: scores of one algorithm, shape (runs, tasks)
    :param second: of another
    :return: part of the pairs of runs of a task in which the first is better, equal ones counted half
    """
    return float((0.5 + 0.5 * np.sign(first[:, None] - second[None])).mean())


def ratio(first: np.ndarray, second: np.ndarray, reference: np.ndarray) -> Interval:
    """
    :param first: scores of one algorithm, shape (runs, tasks)
    :param second: of another
    :param reference: of the algorithm that counts as 1, which may be the second. Its runs are drawn anew with the others,
        since chance is in the units, too
    :return: how many times as large the interquartile mean of the first is
    """
    if second is reference:
        return _interval((first, second), lambda x, y: _ratio_in_units(x, y, y))
    return _interval((first, second, reference), _ratio_in_units)


def _ratio_in_units(first: np.ndarray, second: np.ndarray, reference: np.ndarray) -> float:
    units = interquartile_mean(reference)
    return float(interquartile_mean((first / units).ravel()) / interquartile_mean((second / units).ravel()))


def _interval(scores: tuple[np.ndarray, ...], function: Callable[..., float]) -> Interval:
    result = _bootstrap(scores, lambda *drawn: np.array([function(*drawn)]))
    return Interval(*(float(part[0]) for part in result))


def _bootstrap(scores: tuple[np.ndarray, ...], function: Callable[..., np.ndarray]) -> Estimate:
    data = scores[0] if len(scores) == 1 else scores
    with fixed_random_numbers():
        points, intervals = library.get_interval_estimates(
            {"": data}, function, reps=RESAMPLES, confidence_interval_size=CONFIDENCE
        )
    low, high = intervals[""]
    return Estimate(points[""], low, high)
