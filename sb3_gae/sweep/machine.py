"""Refusals of what this machine cannot run."""

import torch as th
from stable_baselines3.common.utils import get_device

from sb3_gae.checks import check_count
from sb3_gae.sweep.errors import SweepError, checks, in_one_line
from sb3_gae.sweep.plan import Options


def check_jobs(jobs: int) -> None:
    """
    :param jobs: processes
    :raises SweepError: if there is not at least one
    """
    with checks():
        check_count("jobs", jobs)


def check_options(options: Options) -> None:
    """
    :param options: how cells are run
    :raises SweepError: if there is not at least one thread, or no such device here
    """
    with checks():
        check_count("threads", options.threads)
    try:
        device = get_device(options.device)
        # A tensor on a GPU would take hundreds of MiB of it for as long as the command runs
        there = (
            (device.index or 0) < th.cuda.device_count() if device.type == "cuda" else th.zeros(1, device=device).item() == 0
        )
    except (RuntimeError, NotImplementedError, AssertionError, ImportError) as error:
        raise SweepError(f"`device`: PyTorch cannot use {options.device!r} here ({in_one_line(error)}).") from None
    if not there:
        raise SweepError(f"`device`: there is no {options.device!r}; PyTorch sees {th.cuda.device_count()} of that kind.")
