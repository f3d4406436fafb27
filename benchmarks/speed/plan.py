"""At which sizes everything is timed, and for how long."""

import os
from typing import NamedTuple


class Plan(NamedTuple):
    """
    :param quick: whether the numbers mean nothing
    :param threads: of torch, and of the physics
    :param batches: samples of an update, 16 environments each
    :param widths: of the two hidden layers where the number of parameters is varied
    :param width_batch: samples there
    :param grids: numbers of γ and λ
    :param n_envs: numbers of environments that are stepped at once
    :param biped_envs: environments of the biped's iterations
    :param biped_steps: of each of them
    :param cheetah_steps: likewise for HalfCheetah-v5, 8 environments each
    :param seconds: that the rounds of one case take together, if they are not too few
    :param least_rounds: of a case, after one to warm up
    :param most_rounds: of a case
    """

    quick: bool
    threads: int
    batches: tuple[int, ...]
    widths: tuple[int, ...]
    width_batch: int
    grids: tuple[tuple[int, int], ...]
    n_envs: tuple[int, ...]
    biped_envs: int
    biped_steps: tuple[int, ...]
    cheetah_steps: tuple[int, ...]
    seconds: float
    least_rounds: int
    most_rounds: int


def plan(quick: bool, threads: int) -> Plan:
    """
    :param quick: whether to do next to nothing
    :param threads: of torch, and of the physics
    :return: sizes and rounds
    """
    grids = ((2, 3), (4, 6), (8, 12))
    if quick:
        sizes = ((784, 1_568, 3_136), (16, 32, 64), 784, grids, (4, 8, 16), 32, (12, 24, 49), (32, 64, 128))
        return Plan(True, threads, *sizes, seconds=0.05, least_rounds=2, most_rounds=5)
    sizes = ((3_136, 12_544, 50_176), (64, 128, 256), 12_544, grids, (16, 64, 256), 256, (12, 49, 196), (256, 1_024, 4_096))
    return Plan(False, threads, *sizes, seconds=1.0, least_rounds=3, most_rounds=30)


def rounds(of: Plan, seconds: float) -> int:
    """
    :param of: the plan
    :param seconds: that one call takes
    :return: how often to time it
    """
    return int(min(of.most_rounds, max(of.least_rounds, of.seconds / max(seconds, 1e-9))))


def cores() -> int:
    """:return: that this process may use"""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
