"""What pytest-benchmark times; run by ``python -m benchmarks.speed run``, and no part of the tests."""

import time
from typing import Any

import pytest
import torch as th

from benchmarks.speed.case import Case
from benchmarks.speed.cases import all_cases
from benchmarks.speed.plan import Plan, plan, rounds


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """A test for each case."""
    options = metafunc.config.option
    chosen = plan(options.quick, options.threads)
    metafunc.parametrize(("case", "chosen"), [pytest.param(case, chosen, id=str(case)) for case in all_cases(chosen)])


# sb3-contrib's: of a last minibatch that is smaller, and of the mean of no value losses
@pytest.mark.filterwarnings("ignore:You have specified a mini-batch size", "ignore:Mean of empty slice")
@pytest.mark.filterwarnings("ignore:invalid value encountered")
def test_speed(case: Case, chosen: Plan, benchmark: Any) -> None:
    """Time one case."""
    th.set_num_threads(chosen.threads)
    prepared = case.prepare()

    def before() -> None:
        if prepared.before is not None:
            prepared.before()

    before()
    start = time.perf_counter()
    prepared.call()
    n_rounds = rounds(chosen, time.perf_counter() - start)
    benchmark.group = f"{case.part}, {case.varied} {case.size}"
    benchmark.extra_info.update(part=case.part, varied=case.varied, size=case.size, contender=case.contender)
    benchmark.extra_info.update(repeats=prepared.repeats, facts=dict(prepared.facts))
    benchmark.pedantic(prepared.call, setup=before, rounds=n_rounds)
