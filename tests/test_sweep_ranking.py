"""The order of a sweep's curves, and what of it is beyond chance."""

import numpy as np
import pandas as pd
import pytest

from sb3_gae.sweep.errors import SweepError
from sb3_gae.sweep.grid import Curve
from sb3_gae.sweep.ranking import Rank, as_markdown, caution, rank_curves
from sb3_gae.sweep.statistics import difference, interquartile_mean

ITERATIONS = 4


def table_of(returns: dict[Curve, np.ndarray]) -> pd.DataFrame:
    """:param returns: of each curve, shape (seeds, iterations)"""
    rows = [
        (curve.condition, curve.gamma, curve.gae_lambda, seed, iteration + 1, value)
        for curve, runs in returns.items()
        for (seed, iteration), value in np.ndenumerate(runs)
    ]
    return pd.DataFrame(rows, columns=["condition", "gamma", "gae_lambda", "seed", "iteration", "mean_return"])


def is_behind(rank: Rank) -> bool:
    """By more than chance would explain."""
    return rank.behind is not None and bool(rank.behind.low[0] > 0.0)


@pytest.fixture
def returns() -> dict[Curve, np.ndarray]:
    noise = np.random.default_rng(0).normal(size=(3, 9, ITERATIONS))
    late, early, poor = np.array([0, 0, 0, 60]), np.array([30, 30, 30, 30]), np.array([0, 1, 2, 3])
    curves = [Curve(0.9, 1.0), Curve(0.9, 0.5), Curve(0.9, None, "no_vf")]
    return {curve: shape + 0.1 * draws for curve, shape, draws in zip(curves, (late, early, poor), noise, strict=True)}


@pytest.mark.parametrize(("by", "iteration", "first"), [("training", None, 0.5), ("last", None, 1.0), ("last", 3, 0.5)])
def test_the_criterion_decides_the_order(
    returns: dict[Curve, np.ndarray], by: str, iteration: int | None, first: float
) -> None:
    ranks = rank_curves(table_of(returns), iteration, by)
    assert ranks[0].curve.gae_lambda == first and ranks[0].behind is None
    assert ranks[-1].curve.condition == "no_vf" or by == "last"
    assert all(is_behind(rank) for rank in ranks[1:])
    for rank in ranks:
        runs = returns[rank.curve][:, :iteration]
        assert rank.n_seeds == 9
        assert rank.training.iqm[0] == pytest.approx(interquartile_mean(runs.mean(axis=1)))
        assert rank.last.iqm[0] == pytest.approx(interquartile_mean(runs[:, -1]))


def test_equals_are_not_told_apart() -> None:
    noise = np.random.default_rng(1).normal(size=(2, 21, ITERATIONS))
    ranks = rank_curves(table_of({Curve(0.9, 1.0): noise[0], Curve(0.9, 0.5): noise[1]}))
    assert not is_behind(ranks[1])


def test_iterations_without_an_episode_do_not_count_in_the_mean() -> None:
    runs = np.array([[np.nan, np.nan, 2.0, 4.0], [1.0, np.nan, 3.0, 5.0]])
    (rank,) = rank_curves(table_of({Curve(0.9, 1.0): runs}))
    assert rank.training.iqm[0] == pytest.approx((3.0 + 2.5) / 2)  # the gap of the second goes on with 1


def test_difference_is_that_of_a_bootstrap_of_two_samples() -> None:
    generator = np.random.default_rng(2)
    first, second = generator.normal(1.0, 1.0, 12), generator.normal(0.0, 2.0, 20)
    result = difference(first, second, resamples=4_000)
    draws = [sample[generator.integers(0, len(sample), (len(sample), 4_000))] for sample in (first, second)]
    direct = np.percentile(interquartile_mean(draws[0]) - interquartile_mean(draws[1]), [2.5, 97.5])
    np.testing.assert_allclose([result.low[0], result.high[0]], direct, atol=0.08)
    assert result.iqm[0] == pytest.approx(interquartile_mean(first) - interquartile_mean(second))
    assert difference(first, second, resamples=4_000) == result, "the same numbers at each call"


def test_as_a_table(returns: dict[Curve, np.ndarray]) -> None:
    lines = as_markdown(rank_curves(table_of(returns))).splitlines()
    assert len({line.count("|") for line in lines}) == 1 and len(lines) == 5
    assert lines[2].startswith("| value function by trust region | 0.9 | 0.5 | 9 | 30.0 [")
    assert lines[2].endswith("|  |") and lines[-1].startswith("| no value function | 0.9 |  | 9 | 1.")


@pytest.mark.parametrize("few", [4, 5])
def test_intervals_of_few_seeds_come_with_a_caution(returns: dict[Curve, np.ndarray], few: int) -> None:
    returns[Curve(0.9, 0.5)] = returns[Curve(0.9, 0.5)][:few]
    said = caution(rank_curves(table_of(returns)))
    assert said == ("With fewer than 5 seeds the intervals are too narrow to tell chance." if few < 5 else "")


def test_what_it_does_not_know(returns: dict[Curve, np.ndarray]) -> None:
    with pytest.raises(SweepError, match="`by` must be one of last, training, got 'first'"):
        rank_curves(table_of(returns), by="first")
    with pytest.raises(SweepError, match="`iteration` must be from 1 to 4"):
        rank_curves(table_of(returns), iteration=5)
