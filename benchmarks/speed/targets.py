"""
What is to be reached, and how far it is: ours and its limit in turn.

A limit that is timed a minute before or after may have seen another machine: other programs, another clock rate.
"""

import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch as th

from benchmarks.speed import results
from benchmarks.speed.case import LIMIT, OURS, Case, Prepared
from benchmarks.speed.plan import Plan, plan

#: seconds before each call, in which the threads of the call before stop spinning
PAUSE = 0.3
ROUNDS, QUICK_ROUNDS = 31, 2


class Target(NamedTuple):
    """
    :param title: for people
    :param part: what is timed
    :param largest: the most that ours may cost, in units of the limit
    :param varied: at the largest batch, or number of environments, that is timed
    """

    title: str
    part: str
    largest: float
    varied: str = "batch"


TARGETS = (
    Target("update: at most 2 times the matrix products of its arithmetic", "update", 2.0),
    Target("collecting: at most 1.5 times the batched physics, GaeBiped-v0", "rollout, GaeBiped-v0", 1.5),
    Target("collecting: at most 1.5 times the batched physics, HalfCheetah-v5", "rollout, HalfCheetah-v5", 1.5),
    Target("… with more environments", "rollout, HalfCheetah-v5", 1.5, "environments"),
    Target("the biped end to end: at least 0.3 of the speed of open-loop physics", "iteration, GaeBiped-v0", 1 / 0.3),
)


def measure(output: Path, quick: bool, threads: int) -> None:
    """
    :param output: file of results, to be written
    :param quick: whether to do next to nothing
    :param threads: of torch, and of the physics
    """
    # Here, since the report needs none of what is timed
    from benchmarks.speed.cases import all_cases

    th.set_num_threads(threads)
    chosen = plan(quick, threads)
    results.write(output, list(_rows(all_cases(chosen), chosen)), quick=quick, threads=threads)


def _rows(cases: list[Case], chosen: Plan) -> Iterator[dict[str, Any]]:
    for target in TARGETS:
        own = [case for case in cases if (case.part, case.varied) == (target.part, target.varied)]
        if not own:
            continue
        size = max(case.size for case in own)
        ours, limit = (next(case for case in own if (case.size, case.contender) == (size, who)) for who in (OURS, LIMIT))
        ratios = _ratios(ours.prepare(), limit.prepare(), QUICK_ROUNDS if chosen.quick else ROUNDS)
        row = {"part": target.part, "varied": target.varied, "size": size, "rounds": len(ratios)}
        row |= {name: float(f"{value:.4g}") for name, value in _summary(ratios).items()}
        print(row, flush=True)
        yield row


def _ratios(ours: Prepared, limit: Prepared, rounds: int) -> np.ndarray:
    """Ours over the limit in each round, after one to warm up."""
    times = np.array([[_seconds(ours), _seconds(limit)] for _ in range(rounds + 1)])[1:]
    return times[:, 0] / times[:, 1]


def _seconds(prepared: Prepared) -> float:
    if prepared.before is not None:
        prepared.before()
    time.sleep(PAUSE)
    start = time.perf_counter()
    prepared.call()
    return (time.perf_counter() - start) / prepared.repeats


def _summary(ratios: np.ndarray) -> Mapping[str, float]:
    low, median, high = np.quantile(ratios, [0.25, 0.5, 0.75])
    return {"ratio": median, "low": low, "high": high}
