"""Titles and labels."""

import math
from collections.abc import Sequence

import pandas as pd

from sb3_gae.sweep.conditions import CONDITIONS
from sb3_gae.sweep.grid import Curve
from sb3_gae.sweep.series import Series
from sb3_gae.sweep.statistics import TRIMMED_FROM, Estimate


def label_of(curve: Curve, series: Sequence[Series]) -> str:
    """
    :param curve: one of them
    :param series: that a figure shows
    :return: what tells it from the others
    """
    parts = []
    if curve.gae_lambda is None or len({one.curve.condition for one in series if one.curve.gae_lambda is not None}) > 1:
        parts.append(CONDITIONS[curve.condition].title)
    if len({one.curve.gamma for one in series}) > 1:
        parts.append(f"γ = {curve.gamma:g}")
    if curve.gae_lambda is not None:
        parts.append(f"λ = {curve.gae_lambda:g}")
    return ", ".join(parts)


def what(table: pd.DataFrame, series: Sequence[Series]) -> str:
    """
    :param table: that a figure shows
    :param series: the same
    :return: the task, and what all curves share
    """
    parts = [str(table["task"].iloc[0])]
    if len(gammas := {one.curve.gamma for one in series}) == 1:
        parts.append(f"γ = {gammas.pop():g}")
    if len(conditions := {one.curve.condition for one in series}) == 1:
        parts.append(CONDITIONS[conditions.pop()].title)
    return ", ".join(parts)


def seeds(series: Sequence[Series]) -> str:
    """
    :param series: that a figure shows
    :return: how many runs each has
    """
    counts = sorted({one.n_seeds for one in series})
    if len(counts) > 1:
        return f"{counts[0]} to {counts[-1]} seeds"
    return f"{counts[0]} seed{'s' if counts[0] > 1 else ''}"


def mean_name(series: Sequence[Series]) -> str:
    """
    :param series: that a figure shows
    :return: what the interquartile mean is of so many runs
    """
    return "IQM" if max(one.n_seeds for one in series) >= TRIMMED_FROM else "mean"


def mean_over_seeds(series: Sequence[Series]) -> str:
    """
    :param series: that a figure shows
    :return: which mean it shows, of how many runs
    """
    name = mean_name(series)
    mixed = name == "IQM" and min(one.n_seeds for one in series) < TRIMMED_FROM
    return f"{name} over {seeds(series)}" + (f" (of fewer than {TRIMMED_FROM} the mean)" if mixed else "")


def best(curve: Curve, result: Estimate) -> str:
    """
    :param curve: the best one
    :param result: at one point
    :return: which it is, its interquartile mean and interval
    """
    return f"γ = {curve.gamma:g}, λ = {curve.gae_lambda:g}: {with_interval(result)}"


def with_interval(result: Estimate) -> str:
    """
    :param result: at one point
    :return: its interquartile mean and interval
    """
    iqm, low, high = (rounded(float(part[0])) for part in result)
    return f"{iqm} [{low}, {high}]"


def rounded(value: float) -> str:
    """
    :param value: any
    :return: three digits, or all before the point
    """
    if value == 0 or not math.isfinite(value):
        return f"{value:g}"
    return f"{value:.{max(0, 2 - math.floor(math.log10(abs(value))))}f}"
