"""What a command asks for."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from sb3_gae.checks import check_count
from sb3_gae.sweep.conditions import find_condition
from sb3_gae.sweep.errors import SweepError, checks
from sb3_gae.sweep.grid import Cell, Curve, cells_of, product
from sb3_gae.sweep.liveness import SILENT_AFTER
from sb3_gae.sweep.presets import find_preset


@dataclass(frozen=True)
class Options:
    """
    How cells are run, whatever they are.

    :param conf_file: settings file; None for the shipped one
    :param gym_packages: modules that register environments
    :param threads: of PyTorch and of the physics, for each process
    :param device: of PyTorch
    """

    conf_file: str | None = None
    gym_packages: tuple[str, ...] = ()
    threads: int = 1
    device: str = "auto"


@dataclass(frozen=True)
class Plan:
    """
    What a command asks for; every worker gets the same.

    :param name: of the sweep
    :param location: of the storage
    :param cells: of the grid
    :param options: how they are run
    :param silent_after: seconds after which a silent machine's cell is taken over
    """

    name: str
    location: str | None
    cells: tuple[Cell, ...]
    options: Options
    silent_after: float = SILENT_AFTER


def make_cells(
    preset: str | None = None,
    *,
    env: str | Iterable[str] | None = None,
    gammas: Iterable[float] | None = None,
    lambdas: Iterable[float] | None = None,
    conditions: Iterable[str] | None = None,
    seeds: int | Iterable[int] | None = None,
    iterations: int | None = None,
    hyperparams: Mapping[str, Any] | None = None,
) -> list[Cell]:
    """
    :param preset: a key of :data:`~sb3_gae.sweep.presets.PRESETS`; None for the product of what follows
    :param env: one or several tasks; with a preset, in place of its task
    :param gammas: discount factors; not with a preset, which has its own
    :param lambdas: weights of longer estimates; not with a preset
    :param conditions: names of conditions; not with a preset. None for ``trust_region``
    :param seeds: how many, from 0, or which; None for the preset's
    :param iterations: batches of each run; None for the preset's
    :param hyperparams: that differ from the settings file, and from the preset
    :return: the grid
    :raises SweepError: if something is missing or outside its domain
    """
    tasks = [env] if isinstance(env, str) else None if env is None else list(env)
    curves: list[Curve]
    if preset is not None:
        chosen = find_preset(preset)
        for name, value in {"gammas": gammas, "lambdas": lambdas, "conditions": conditions}.items():
            if value is not None:
                raise SweepError(f"`{name}` belongs to the preset {preset!r}; leave out one of them.")
        tasks, curves = tasks or [chosen.task], list(chosen.curves)
        seeds = chosen.seeds if seeds is None else seeds
        iterations = chosen.iterations if iterations is None else iterations
        hyperparams = {**chosen.overrides, **(hyperparams or {})}
    else:
        for name, needed in {"env": tasks, "gammas": gammas, "seeds": seeds, "iterations": iterations}.items():
            if needed is None:
                raise SweepError(f"`{name}` is missing; give it, or a preset.")
        conditions, lambdas = ["trust_region"] if conditions is None else list(conditions), _listed(lambdas)
        needing = [name for name in conditions if find_condition(name).uses_lambda]
        if needing and not lambdas:
            raise SweepError(f"`lambdas` is missing, of which the condition {needing[0]!r} needs at least one.")
        curves = product(conditions, _listed(gammas), lambdas)
    which = range(check_seeds(seeds)) if isinstance(seeds, int | np.integer) else _listed(seeds)
    return cells_of(tasks or [], curves, which, iterations or 0, hyperparams)


def _listed(values: Iterable[Any] | None) -> list[Any]:
    # Arrays, too, of which there is no telling whether they are true
    return [] if values is None else list(values)


def check_seeds(count: int) -> int:
    """
    :param count: number of seeds
    :return: the same
    :raises SweepError: if there is not at least one
    """
    with checks():
        check_count("seeds", count)
    return count


def default_name(preset: str | None, tasks: Iterable[str]) -> str:
    """
    :param preset: of the grid, if it has one
    :param tasks: of the grid
    :return: a name for the sweep
    """
    return preset or "_".join(dict.fromkeys(tasks)).replace("/", "-").replace(":", "-")
