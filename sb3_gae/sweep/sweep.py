"""The command ``run`` as a function."""

import warnings
from collections.abc import Iterable, Mapping
from typing import Any

import pandas as pd

from sb3_gae.sweep.ledger import Status
from sb3_gae.sweep.liveness import SILENT_AFTER
from sb3_gae.sweep.plan import Options, Plan, default_name, make_cells
from sb3_gae.sweep.results import results_of, rows_of_cells
from sb3_gae.sweep.runner import run_plan
from sb3_gae.sweep.study import SweepStudy


def run_sweep(
    preset: str | None = None,
    *,
    env: str | Iterable[str] | None = None,
    gammas: Iterable[float] | None = None,
    lambdas: Iterable[float] | None = None,
    conditions: Iterable[str] | None = None,
    seeds: int | Iterable[int] | None = None,
    iterations: int | None = None,
    hyperparams: Mapping[str, Any] | None = None,
    name: str | None = None,
    storage: str | None = None,
    jobs: int = 1,
    threads: int = 1,
    device: str = "auto",
    conf_file: str | None = None,
    gym_packages: Iterable[str] = (),
    retry_failed: bool = False,
    progress: bool = True,
    silent_after: float = SILENT_AFTER,
    wait: bool = False,
) -> pd.DataFrame:
    """
    Run the cells of a grid that are not done yet.

    With ``jobs`` above 1 processes are spawned: call it below ``if __name__ == "__main__":``.

    :param preset: a key of ``sb3_gae.sweep.PRESETS``; None for the product of what follows
    :param env: one or several tasks; with a preset, in place of its task
    :param gammas: discount factors, each in [0, 1]
    :param lambdas: weights of longer estimates, each in [0, 1]
    :param conditions: keys of ``sb3_gae.sweep.CONDITIONS``; None for ``trust_region``
    :param seeds: how many, from 0, or which
    :param iterations: batches of each run
    :param hyperparams: that differ from the settings file, as rl-zoo3's ``-params``
    :param name: of the sweep; None for the preset's or the task's
    :param storage: URL of a database that Optuna knows, or path of a journal file; None for
        ``logs/sweeps/<name>.journal``
    :param jobs: processes; with 1 the cells run in this one
    :param threads: of PyTorch and of the physics, for each process
    :param device: of PyTorch
    :param conf_file: settings file as rl-zoo3's; None for the shipped one
    :param gym_packages: modules that register environments
    :param retry_failed: whether cells that failed are run again
    :param progress: whether to show a bar
    :param silent_after: seconds without a sign of life after which another machine's cell is taken over; signs are given
        15 times as often
    :param wait: whether to stay while other processes run cells of the grid, and take over those that they lose
    :return: a row for each iteration of each finished cell of the grid, as :func:`~sb3_gae.sweep.results.results_of`
    :raises SweepError: if an argument is wrong, or the storage cannot be used
    """
    grid = dict(env=env, gammas=gammas, lambdas=lambdas, conditions=conditions, seeds=seeds, iterations=iterations)
    cells = make_cells(preset, **grid, hyperparams=hyperparams)  # type: ignore[arg-type]
    plan = Plan(
        name or default_name(preset, (cell.task for cell in cells)),
        storage,
        tuple(cells),
        Options(conf_file, tuple(gym_packages), threads, device),
        silent_after,
    )
    table = run_plan(plan, jobs, retry_failed=retry_failed, progress=progress, wait=wait)
    for cell in cells:
        if table[cell.key].status == Status.FAILED:
            warnings.warn(f"{cell} failed: {table[cell.key].reason}", stacklevel=2)
    return rows_of_cells(results_of(SweepStudy(plan.name, plan.location, create=False)), cells)
