"""How good a value function and an advantage estimate are, as pure functions of arrays (NumPy)."""

import numpy as np


def explained_variance(predictions: np.ndarray, targets: np.ndarray) -> float:
    r"""
    :math:`1 - \mathrm{Var}(y - \hat y) / \mathrm{Var}(y)`: 1 is perfect, 0 no better than a constant, below 0 worse.

    :param predictions: any shape
    :param targets: same shape
    :return: not a number if the targets are constant, as in SB3
    """
    # In double precision: the squares of returns of 1e20 overflow single
    variance = np.var(targets, dtype=np.float64)
    return float("nan") if variance == 0 else float(1.0 - np.var(targets - predictions, dtype=np.float64) / variance)
