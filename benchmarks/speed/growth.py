"""How cost grows with size."""

import math
from collections.abc import Sequence

import numpy as np


def exponent(sizes: Sequence[float], costs: Sequence[float]) -> float:
    """
    The power of the size that the cost grows with, by least squares on logarithms.

    :param sizes: at least two different ones, positive
    :param costs: at each size, positive, in any unit
    :return: slope in log-log: 1 for a cost in proportion to the size, 0 for a constant one; not a number where there is none
    """
    if len(set(sizes)) < 2:
        return math.nan
    return float(np.polyfit(np.log(sizes), np.log(costs), 1)[0])
