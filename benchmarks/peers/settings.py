"""The settings of each run, from the files that their owners tuned and published."""

import functools
import importlib.util
import inspect
import json
from pathlib import Path
from typing import Any

import yaml

from benchmarks.peers.algorithms import ALGORITHMS, OURS
from benchmarks.peers.errors import PeersError
from benchmarks.peers.places import ROOT
from benchmarks.peers.plan import Cell
from benchmarks.peers.tianshou_settings import TIANSHOU_SETTINGS
from benchmarks.peers.variants import EVERY_VARIANT

_OUR_FILE = ROOT / "hyperparams" / "trpo_gae.yml"


def settings_of(cell: Cell) -> dict[str, Any]:
    """
    :param cell: of the plan
    :return: what its library is given
    :raises PeersError: if there are no settings for the task
    """
    if ALGORITHMS[cell.algorithm].library == "tianshou":
        return TIANSHOU_SETTINGS[cell.algorithm] | {"steps": cell.steps}
    path = _OUR_FILE if cell.algorithm == OURS else zoo_file(cell.algorithm)
    shipped = settings_for(yaml.safe_load(path.read_text()), cell.task, path.name)
    return shipped | EVERY_VARIANT[cell.variant].overrides | {"n_timesteps": cell.steps}


def settings_for(table: dict[str, dict[str, Any]], task: str, file: str) -> dict[str, Any]:
    """
    :param table: of rl-zoo3, by task
    :param task: id of the environment
    :param file: that the table is from
    :return: its settings; those of version 4 where there are none of version 5
    :raises PeersError: if there are neither
    """
    older = task.removesuffix("-v5") + "-v4" if task.endswith("-v5") else task
    for name in (task, older):
        if name in table:
            return table[name]
    raise PeersError(f"`task`: {file} has no settings for {task}.")


def zoo_file(algorithm: str) -> Path:
    """
    :param algorithm: one of rl-zoo3's
    :return: the file of its settings that rl-zoo3 comes with
    :raises PeersError: if rl-zoo3 is not installed
    """
    # Without importing it, and PyTorch with it
    package = importlib.util.find_spec("rl_zoo3")
    if package is None or package.origin is None:
        raise PeersError("rl_zoo3 is not installed; use the environment that `make` makes.")
    return Path(package.origin).parent / "hyperparams" / f"{algorithm}.yml"


def described(algorithm: str, settings: dict[str, Any]) -> str:
    """
    :param algorithm: key of :data:`~benchmarks.peers.algorithms.ALGORITHMS`
    :param settings: of a run
    :return: by which two runs are known to have had the same; ours with the defaults of what they leave out, so that to spell
        one out changes nothing
    """
    defaults = our_defaults() if algorithm == OURS else {}
    return json.dumps(defaults | settings, sort_keys=True)


@functools.cache
def our_defaults() -> dict[str, Any]:
    """:return: of :class:`~sb3_gae.TRPOGAE`"""
    # Here, since it brings PyTorch along
    from sb3_gae import TRPOGAE

    arguments = inspect.signature(TRPOGAE).parameters
    return {name: argument.default for name, argument in arguments.items() if argument.default is not inspect.Parameter.empty}
