"""Which runs of a table of results a figure or a ranking is made of."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import pandas as pd

from sb3_gae.sweep.agreement import check_alike, made_in
from sb3_gae.sweep.errors import SweepError
from sb3_gae.sweep.runs import finished


@dataclass(frozen=True)
class Selection:
    """
    What to keep; None for all, as long as one task, one length, one set of overrides and one of settings are left.

    :param tasks: ids of environments
    :param conditions: by name
    :param gammas: discounts
    :param lambdas: of cells whose condition has a λ; the others are kept beside them
    :param iterations: of the cells, their length
    """

    tasks: Iterable[str] | None = None
    conditions: Iterable[str] | None = None
    gammas: Iterable[float] | None = None
    lambdas: Iterable[float] | None = None
    iterations: int | None = None
    _wanted: dict[str, list[Any]] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        wanted = {
            "task": self.tasks,
            "condition": self.conditions,
            "gamma": self.gammas,
            "gae_lambda": self.lambdas,
            "iterations": None if self.iterations is None else [self.iterations],
        }
        # Once and for all: any of them may be an iterator
        found = {column: list(values) for column, values in wanted.items() if values is not None}
        object.__setattr__(self, "_wanted", found)

    def of(self, table: pd.DataFrame) -> pd.DataFrame:
        """
        :param table: of results; of partial ones those of finished cells count
        :return: one task's rows, with runs of one length, one set of overrides, and one of settings
        :raises SweepError: if nothing is left, or several kinds are left that do not go together
        """
        table = finished(table)
        if table.empty:
            raise SweepError("No cell has finished yet; see: python -m sb3_gae.sweep status")
        for column, chosen in self._wanted.items():
            table = _narrowed(table, column, chosen)
        for column, option in {
            "task": "--env",
            "iterations": "--of-iterations",
            "overrides": "--from a file of one of them",
        }.items():
            found = sorted(table[column].unique())
            if len(found) > 1:
                raise SweepError(
                    f"The selection mixes runs whose {column} differ ({_listed(found)}); choose one with {option}."
                )
        check_alike(made_in(table), "leave out one of the files, or choose other --conditions, --gammas or --lambdas")
        return table

    def has(self, run: pd.DataFrame) -> bool:
        """
        :param run: rows of one run
        :return: whether it would be kept
        """
        return all(_keeps(run, column, chosen).all() for column, chosen in self._wanted.items())


def _narrowed(table: pd.DataFrame, column: str, chosen: list[Any]) -> pd.DataFrame:
    if not table[column].isin(chosen).any():
        held = sorted(table[column].dropna().unique())
        there = f"there are {_listed(held)}" if held else "there is none"
        raise SweepError(f"The selection is empty: no finished cell has {column} {_listed(chosen)}; {there}.")
    return table[_keeps(table, column, chosen)]


def _keeps(table: pd.DataFrame, column: str, chosen: list[Any]) -> "pd.Series[bool]":
    """:return: for each row, whether it is kept; a condition without λ has none to choose by"""
    kept = table[column].isin(chosen)
    return kept | table[column].isna() if column == "gae_lambda" else kept


def _listed(values: Iterable[Any]) -> str:
    return ", ".join(f"{value:g}" if isinstance(value, float) else str(value) for value in values)


EVERYTHING = Selection()
