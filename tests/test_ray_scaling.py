"""The model of many workers, on costs that can be reckoned by hand."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent.parent / "benchmarks"))
from ray_scaling_model import WORKERS, Costs, costs_from, first_at_limit, main, predict, table  # isort: skip

COSTS = Costs(
    worker_seconds=1e-3,
    learner_seconds=1e-5,
    update_seconds=2.0,
    weights_bytes=1e6,
    step_bytes=500.0,
    worker_overhead=0.01,
)
GIGABYTE = 1e9


def test_parts_of_an_iteration() -> None:
    one = predict(COSTS, workers=8, batch=200_000, bytes_per_second=GIGABYTE)
    assert one.collecting == pytest.approx(25.0)
    assert one.network == pytest.approx((8e6 + 1e8) / 1e9)
    assert one.learner == pytest.approx(0.08 + 2.0 + 2.0)
    assert one.seconds == pytest.approx(25.0 + 0.108 + 4.08)
    assert not one.learner_is_the_limit


def test_a_machine_gets_the_weights_once_and_the_slowest_worker_counts() -> None:
    assert predict(COSTS, 32, 200_000, GIGABYTE, cores=16).network == pytest.approx((2e6 + 1e8) / 1e9)
    assert predict(COSTS, 33, 200_000, GIGABYTE, cores=16).network == pytest.approx((3e6 + 1e8) / 1e9)
    assert predict(COSTS, 3, 100, GIGABYTE).collecting == pytest.approx(34e-3)


def test_the_learner_is_the_limit_from_where_its_part_is_the_longer_one() -> None:
    limit = first_at_limit(COSTS, 200_000, GIGABYTE)
    assert limit is not None
    for workers in range(1, 3 * limit):
        assert predict(COSTS, workers, 200_000, GIGABYTE).learner_is_the_limit == (workers >= limit)
    assert first_at_limit(COSTS._replace(update_seconds=1e9), 200_000, GIGABYTE) == 1
    free = Costs(1e-3, 0.0, 0.0, 0.0, 0.0, 0.0)
    assert first_at_limit(free, 1_000, GIGABYTE) is None


def rows(
    worker_s: float, collection_s: float, workers: int = 1, task: str = "task", way: str = "ray workers"
) -> dict[str, str]:
    return {
        **{"task": task, "way": way, "workers": str(workers), "batch": "1000"},
        **{"rollout_s": str(collection_s + 0.5), "update_s": "3.0", "collection_s": str(collection_s)},
        **{"worker_s": str(worker_s), "weights_bytes": "4000", "shares_bytes": "90000", "states_bytes": "10000"},
    }


MESSAGES = [rows(0.0, seconds, workers=k, way="messages") for k, seconds in ((1, 0.05), (1, 0.01), (1, 0.02), (3, 0.04))]


def test_costs_are_medians_of_the_rows_with_the_fewest_workers() -> None:
    measured = [rows(2.0, 2.2), rows(4.0, 4.3), rows(3.0, 3.1), rows(1.0, 9.0, workers=2), rows(9.0, 9.0, task="other")]
    costs = costs_from(measured + MESSAGES, "task")
    # A worker adds 0.01 s; of the 0.2 s between the worker's time and the whole, 0.19 are of the batch
    assert costs == pytest.approx(Costs(3e-3, 6.9e-4, 3.0, 4000.0, 100.0, 0.01))
    with pytest.raises(ValueError, match="no rows of messages"):
        costs_from(measured, "task")
    with pytest.raises(ValueError, match=r"no rows of another with workers; run benchmarks/ray_speed\.py first"):
        costs_from(measured, "another")


def test_the_table_has_a_line_for_each_number_of_workers() -> None:
    lines = table([predict(COSTS, workers, 200_000, GIGABYTE) for workers in WORKERS], 200_000).splitlines()
    assert len(lines) == 2 + len(WORKERS)
    assert lines[2].startswith("| 1 | 200.00 |") and lines[2].endswith("| 1.00 | workers |")
    assert lines[-1].startswith("| 256 |") and lines[-1].endswith("| learner |")


def test_the_page_has_the_table_of_the_committed_costs(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", ["ray_scaling_model.py"])
    main()
    printed = [line for line in capsys.readouterr().out.splitlines() if line.startswith("|")]
    assert "\n".join(printed) in (Path(__file__).parent.parent / "docs" / "scaling.md").read_text()
