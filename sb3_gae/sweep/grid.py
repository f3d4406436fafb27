"""Cells of a grid, each one training run, and the ways to lay one out."""

import itertools
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple, Self

from sb3_gae.checks import check_count, check_number
from sb3_gae.sweep.conditions import find_condition
from sb3_gae.sweep.errors import SweepError, checks

#: of NumPy's and torch's seeds as SB3 sets them
LARGEST_SEED = 2**32 - 1


@dataclass(frozen=True)
class Cell:
    """
    One training run.

    :param task: id of the environment
    :param condition: a name in :data:`~sb3_gae.sweep.conditions.CONDITIONS`
    :param gamma: discount factor
    :param gae_lambda: λ of the advantages; None where the condition has no use for it
    :param seed: of the run
    :param iterations: batches
    :param overrides: hyperparameters that differ from the settings file, as JSON with sorted keys
    :raises SweepError: if an argument is outside its domain
    """

    task: str
    condition: str
    gamma: float
    gae_lambda: float | None
    seed: int
    iterations: int
    overrides: str = "{}"

    def __post_init__(self) -> None:
        uses_lambda = find_condition(self.condition).uses_lambda
        with checks():
            check_number("gamma", self.gamma, 0.0, 1.0)
            if uses_lambda:
                check_number("gae_lambda", self.gae_lambda, 0.0, 1.0)
            check_count("seeds", self.seed, low=0)
            check_number("seeds", self.seed, 0, LARGEST_SEED)
            check_count("iterations", self.iterations)
        # 0 and 0.0 are one cell, numbers of NumPy those of Python, and so are all λ where λ has no meaning
        object.__setattr__(self, "seed", int(self.seed))
        object.__setattr__(self, "iterations", int(self.iterations))
        object.__setattr__(self, "gamma", float(self.gamma))
        object.__setattr__(self, "gae_lambda", float(self.gae_lambda) if uses_lambda else None)  # type: ignore[arg-type]

    @property
    def key(self) -> str:
        """What makes the cell this one: the same on every machine and in every version of Python."""
        return json.dumps(asdict(self), sort_keys=True)

    @classmethod
    def from_key(cls, key: str) -> Self:
        """
        :param key: of a cell
        :return: the cell
        """
        return cls(**json.loads(key))

    @property
    def hyperparameters(self) -> dict[str, Any]:
        """What differs from the settings file, as rl-zoo3's ``-params`` would have it."""
        own = {"gamma": self.gamma} | ({} if self.gae_lambda is None else {"gae_lambda": self.gae_lambda})
        return json.loads(self.overrides) | dict(find_condition(self.condition).settings) | own

    @property
    def label(self) -> str:
        """Its curve in words."""
        of_lambda = "" if self.gae_lambda is None else f", λ = {self.gae_lambda:g}"
        return f"{self.task}, {self.condition}, γ = {self.gamma:g}{of_lambda}"

    def __str__(self) -> str:
        return f"{self.label}, seed {self.seed}, {self.iterations} iterations"


class Curve(NamedTuple):
    """
    What the seeds of a learning curve have in common.

    :param gamma: discount factor
    :param gae_lambda: λ; None where the condition has no use for it
    :param condition: its name
    """

    gamma: float
    gae_lambda: float | None
    condition: str = "trust_region"


def product(conditions: Iterable[str], gammas: Iterable[float], lambdas: Iterable[float]) -> list[Curve]:
    """
    :param conditions: their names
    :param gammas: discount factors
    :param lambdas: weights of longer estimates
    :return: every combination; a condition without λ once for each γ
    :raises SweepError: if there is no condition of a name
    """
    weights: list[float | None] = [*lambdas] or [None]
    pairs = itertools.product(conditions, gammas, weights)
    curves = (Curve(gamma, lam if find_condition(name).uses_lambda else None, name) for name, gamma, lam in pairs)
    return list(dict.fromkeys(curves))


def cells_of(
    tasks: Sequence[str],
    curves: Sequence[Curve],
    seeds: Iterable[int],
    iterations: int,
    overrides: Mapping[str, Any] | None = None,
) -> list[Cell]:
    """
    :param tasks: ids of environments
    :param curves: what is compared
    :param seeds: of the runs
    :param iterations: batches of each run
    :param overrides: hyperparameters that differ from the settings file
    :return: one cell for each combination; seeds outermost, so that an unfinished grid has all its curves already
    :raises SweepError: if a value is outside its domain, or nothing is left to run
    """
    text = overrides_as_json(overrides or {})
    cells = [
        Cell(task, curve.condition, curve.gamma, curve.gae_lambda, seed, iterations, text)
        for seed, task, curve in itertools.product(seeds, tasks, curves)
    ]
    if not cells:
        raise SweepError("The grid is empty: give at least one task, one gamma, one lambda and one seed.")
    return list(dict.fromkeys(cells))


def overrides_as_json(overrides: Mapping[str, Any]) -> str:
    """
    :param overrides: hyperparameters by name
    :return: the same text whatever their order
    :raises SweepError: if a value cannot be stored
    """
    try:
        return json.dumps(dict(overrides), sort_keys=True)
    except TypeError as error:
        raise SweepError(
            f"`-params` takes numbers, texts, lists and dictionaries ({error}); quote what is to be evaluated later, "
            "for example -params \"policy_kwargs:'dict(activation_fn=nn.ReLU)'\"."
        ) from None
