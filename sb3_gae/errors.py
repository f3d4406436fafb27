"""Errors that the package raises."""


class NumericalError(ValueError):
    """
    A number that must be finite is not, or a computation on it broke down.

    It is a ``ValueError`` because rl-zoo3 prunes an Optuna trial on that and lets anything else end the study.
    Whenever training raises it, policy and optimiser are as they were after the last completed update.
    """


class WorkersLostError(RuntimeError):
    """
    Workers that collect rollouts are gone and cannot be replaced.

    The training stands where its last iteration ended: a checkpoint of it can be written, and be continued from.
    """
