"""Options of the speed benchmarks, for ``python -m pytest benchmarks/speed/bench.py``."""

import pytest

from benchmarks.speed.plan import cores


def pytest_addoption(parser: pytest.Parser) -> None:
    """Added to pytest's own."""
    group = parser.getgroup("speed")
    group.addoption("--quick", action="store_true", help="small sizes and few rounds; the numbers mean nothing")
    group.addoption("--threads", type=int, default=cores(), help="of torch and of the physics (default: all cores)")
