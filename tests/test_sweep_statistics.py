"""Interquartile means over the seeds of a sweep, and their intervals."""

import numpy as np
from rliable import metrics

from sb3_gae.sweep.statistics import estimate, estimate_each, interquartile_mean


def test_interquartile_mean_is_that_of_rliable_and_of_its_definition() -> None:
    values = np.random.default_rng(0).normal(size=(21, 6)) ** 3
    direct = np.sort(values, axis=0)[5:16].mean(axis=0)
    np.testing.assert_allclose(interquartile_mean(values), direct)
    np.testing.assert_allclose(interquartile_mean(values), [metrics.aggregate_iqm(column[:, None]) for column in values.T])
    np.testing.assert_allclose(estimate(values).iqm, direct)


def test_intervals_are_those_of_a_bootstrap_over_seeds() -> None:
    values = np.random.default_rng(1).normal(size=(12, 1))
    result = estimate(values, resamples=4_000)
    draws = np.random.default_rng(2).integers(0, 12, (4_000, 12))
    direct = np.percentile(interquartile_mean(values[draws, 0].T), [2.5, 97.5])
    np.testing.assert_allclose([result.low[0], result.high[0]], direct, atol=0.05)
    state = np.random.get_state()[1].copy()  # type: ignore[union-attr]
    again = estimate(values, resamples=4_000)
    assert again == result, "the same numbers at each call"
    np.testing.assert_array_equal(np.random.get_state()[1], state)
    single = estimate(values[:1], resamples=10)
    assert single.low == single.iqm == single.high == values[0]


def test_estimates_of_several_sizes_keep_their_places() -> None:
    samples = [np.full(4, 1.0), np.full(2, 2.0), np.full(4, 3.0)]
    results = estimate_each(samples)
    assert [float(result.iqm[0]) for result in results] == [1.0, 2.0, 3.0]
    assert [result.low.shape for result in results] == [(1,)] * 3
