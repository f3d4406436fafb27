"""Whether runs that are to be one sweep, or in one figure, were made with the same settings."""

import json
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import pandas as pd

from sb3_gae.sweep.conditions import find_condition
from sb3_gae.sweep.errors import SweepError

#: in which the curves of a sweep differ on purpose
_OF_THE_GRID = ("gamma", "gae_lambda")


class Made(NamedTuple):
    """
    How runs were made.

    :param task: id of the environment
    :param condition: its name
    :param overrides: of the cell, as JSON
    :param settings: hyperparameters, those of the settings file included, as JSON; empty if they are not known
    """

    task: str
    condition: str
    overrides: str
    settings: str

    @property
    def values(self) -> dict[str, Any]:
        """The settings without those of the grid."""
        return _without_grid(json.loads(self.settings or "{}"))


def made_in(table: pd.DataFrame) -> list[Made]:
    """
    :param table: of results
    :return: how its runs were made, each way once
    """
    return [Made(*row) for row in table[list(Made._fields)].drop_duplicates().itertuples(index=False, name=None)]


def changes(before: Mapping[str, Any], now: Mapping[str, Any]) -> str:
    """
    :param before: settings
    :param now: settings
    :return: each one that differs, from what to what; empty if none does
    """
    names = [name for name in sorted({*before, *now}) if before.get(name) != now.get(name)]
    return ", ".join(f"{name} {before.get(name)!r} -> {now.get(name)!r}" for name in names)


def check_alike(made: Iterable[Made], advice: str) -> None:
    """
    :param made: runs that are to be compared
    :param advice: what to do if they cannot be
    :raises SweepError: if those of the same task, condition and overrides have different settings
    """
    first: dict[tuple[str, str, str], dict[str, Any]] = {}
    for one in made:
        if not one.values:
            continue
        if found := changes(first.setdefault(one[:3], one.values), one.values):
            raise SweepError(f"Runs of {one.task}, {one.condition} have different settings ({found}); {advice}.")


def check_made_with(made: Iterable[Made], settings: Mapping[str, Mapping[str, Any]], advice: str) -> None:
    """
    :param made: runs
    :param settings: of tasks, as the settings file has them; those of other tasks are not checked
    :param advice: what to do if runs have others
    :raises SweepError: if runs have others
    """
    for one in made:
        if not one.values or one.task not in settings:
            continue
        own = json.loads(one.overrides) | dict(find_condition(one.condition).settings)
        if found := changes(_without_grid({**settings[one.task], **own}), one.values):
            raise SweepError(f"Runs of {one.task}, {one.condition} have other settings than the sweep ({found}); {advice}.")


def _without_grid(settings: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in settings.items() if name not in _OF_THE_GRID}
