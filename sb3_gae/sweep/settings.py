"""Settings of a task as rl-zoo3 reads them, and refusals of tasks and names that it would not know."""

import contextlib
import importlib
import inspect
import io
import json
import sys
from argparse import Namespace
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import gymnasium
import yaml

import sb3_gae.zoo
from sb3_gae.sweep.conditions import did_you_mean, find_condition
from sb3_gae.sweep.errors import SweepError, in_one_line
from sb3_gae.sweep.grid import Cell
from sb3_gae.trpo_gae import TRPOGAE

#: of a hyperparameter file, beside the arguments of TRPOGAE
_ZOO_KEYS = {
    "batched_envs",
    "callback",
    "env_kwargs",
    "env_wrapper",
    "eval_freq",
    "frame_stack",
    "monitor_kwargs",
    "n_envs",
    "n_timesteps",
    "normalize",
    "vec_env_wrapper",
}

#: that have arguments of their own
_OF_THE_GRID = {"gamma": "gammas", "gae_lambda": "lambdas", "n_timesteps": "iterations", "seed": "seeds"}


def import_packages(gym_packages: Iterable[str]) -> None:
    """
    :param gym_packages: modules that register environments
    :raises SweepError: if one cannot be imported
    """
    # As `python -m` has it, which a program of the user's, or a worker, may not
    if "" not in sys.path and str(Path.cwd()) not in sys.path:
        sys.path.insert(0, str(Path.cwd()))
    for name in gym_packages:
        try:
            importlib.import_module(name)
        except ImportError as error:
            raise SweepError(
                f"`gym_packages`: {name} cannot be imported ({in_one_line(error)}); run where it lies, or install it."
            ) from error
        except Exception as error:
            what = f"{type(error).__name__}: {in_one_line(error)}"
            raise SweepError(f"`gym_packages`: {name} fails when it is imported ({what}); mend it first.") from error


def check_tasks(tasks: Iterable[str]) -> None:
    """
    :param tasks: ids of environments
    :raises SweepError: if gymnasium does not know one
    """
    for task in tasks:
        if task not in gymnasium.registry:
            raise SweepError(
                f"`env`: gymnasium does not know {task!r}{did_you_mean(task, gymnasium.registry)} "
                "Environments of your own come with --gym-packages."
            )


def check_overrides(cells: Iterable[Cell]) -> None:
    """
    :param cells: of the grid
    :raises SweepError: if a hyperparameter is unknown, or set by the grid or by a condition as well
    """
    known = {*inspect.signature(TRPOGAE).parameters, *_ZOO_KEYS}
    for condition, overrides in {(cell.condition, cell.overrides) for cell in cells}:
        for name in json.loads(overrides):
            if name in _OF_THE_GRID:
                raise SweepError(f"`-params {name}` belongs to the grid; use --{_OF_THE_GRID[name]}.")
            if name in find_condition(condition).settings:
                raise SweepError(f"`-params {name}` is what the condition {condition!r} sets; leave out one of them.")
            if name not in known:
                raise SweepError(f"`-params` has no {name!r}{did_you_mean(name, known)}")


def shipped_settings(task: str, conf_file: str | None = None) -> dict[str, Any]:
    """
    :param task: id of the environment
    :param conf_file: settings file; None for the shipped one
    :return: what the file has for the task, fit for JSON
    :raises SweepError: if the file cannot be read or has nothing for the task
    """
    from rl_zoo3.exp_manager import ExperimentManager  # slow to import, and not needed for figures

    sb3_gae.zoo.register()
    try:
        manager = ExperimentManager(Namespace(), sb3_gae.zoo.ALGO, task, "", config=conf_file, verbose=0)
        with contextlib.redirect_stdout(io.StringIO()):
            _, settings = manager.read_hyperparameters()
    except (OSError, ValueError, ImportError, KeyError, yaml.YAMLError) as error:
        what = in_one_line(error, longest=None)
        raise SweepError(f"`conf_file`: no settings of {task} in {conf_file or 'the shipped file'} ({what}).") from error
    return as_json(settings)


def as_json(settings: Mapping[str, Any]) -> dict[str, Any]:
    """
    :param settings: of a run
    :return: the same with what JSON does not know as text
    """
    return json.loads(json.dumps(dict(settings), sort_keys=True, default=str))
