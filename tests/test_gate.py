"""The gate's arithmetic; what it measures is left to `python -m benchmarks.gate`, since tests do not time things."""

import contextlib
import math
import sys
from pathlib import Path

import numpy as np
import pytest
import torch as th

sys.path.insert(0, str(Path(__file__).parents[1]))

import benchmarks.gate.__main__ as gate
import benchmarks.gate.parts as gate_parts
from benchmarks.gate.bands import LEARNING_DEVIATIONS, Band, cost_band, learning_band, verdicts
from benchmarks.gate.learning import RUNS, SEEDS
from benchmarks.gate.parts import PARTS, Part, record_speed
from benchmarks.gate.plants import PLANTS, Plant, twice
from benchmarks.gate.records import read_records
from benchmarks.gate.speed import ROLLOUT_TASKS
from benchmarks.gate.work import COUNTS, SEED, calls, counted


def test_a_band_for_learning_reaches_as_far_as_the_error_of_two_means() -> None:
    recorded = [1.0, 2.0, 3.0, 6.0]
    band = learning_band(recorded, n_seeds=2)
    deviation = math.sqrt(sum((score - 3.0) ** 2 for score in recorded) / 3.0)
    reach = LEARNING_DEVIATIONS * deviation * math.sqrt(1 / 2 + 1 / 4)
    assert band == pytest.approx((3.0 - reach, 3.0 + reach))


def test_unchanged_learning_stays_in_its_band_and_a_shift_of_six_errors_does_not() -> None:
    generator = np.random.default_rng(0)
    draws = generator.normal(10.0, 2.0, size=(2_000, 26))
    inside = [learning_band(row[:20], 6).holds(row[20:].mean()) for row in draws]
    assert np.mean(inside) > 0.998
    shifted = [learning_band(row[:20], 6).holds(row[20:].mean() - 6.0 * 2.0 * math.sqrt(1 / 6 + 1 / 20)) for row in draws]
    assert np.mean(shifted) < 0.05


def test_a_band_for_a_cost_has_no_lower_end() -> None:
    band = cost_band([0.9, 1.0, 0.8], margin=1.15)
    assert band == Band(0.0, 1.15)
    assert band.holds(0.1)
    assert not band.holds(1.2)
    assert not band.holds(math.nan)


def test_recording_speed_keeps_the_last_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gate_parts, "speed_ratios", lambda: {"ratio": 0.5, "new": 2.0})
    new = {"ratio": [0.5] * gate_parts.RECORDED_ROUNDS, "new": [2.0] * gate_parts.RECORDED_ROUNDS}
    assert record_speed(None) == new
    # What is no longer measured goes
    assert record_speed({"ratio": [9.0], "old": [1.0]}) == new | {"ratio": [9.0, *new["ratio"]]}
    monkeypatch.setattr(gate_parts, "KEPT_ROUNDS", gate_parts.RECORDED_ROUNDS)
    assert record_speed({"ratio": [9.0]}) == new


def test_arithmetic_of_products_and_calls_of_operators_are_counted() -> None:
    first, second = th.ones(3, 4), th.ones(4, 5)
    assert counted(lambda: th.tanh(first @ second)) == (2 * 3 * 4 * 5, 2)
    assert counted(lambda: None) == (0, 0)


def test_calls_of_functions_are_counted_and_the_former_profile_is_put_back() -> None:
    former = sys.getprofile()

    def own() -> None:
        [len(()), abs(1)]

    def fails() -> None:
        raise KeyError

    assert calls(own) == 3
    assert calls(lambda: [own(), own()]) == 7
    with pytest.raises(KeyError):
        calls(fails)
    assert sys.getprofile() is former


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: learning_band([1.0], 2), "at least two scores, got 1"),
        (lambda: cost_band([], 1.0), "at least one cost"),
        (lambda: verdicts({"new": 1.0}, {}), "Nothing is recorded of new"),
    ],
)
def test_too_little_is_refused(call: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        call()  # type: ignore[operator]


def test_a_plant_does_the_work_two_times_and_goes_away() -> None:
    calls = []
    assert twice(lambda number: calls.append(number) or number)(3) == 3
    assert calls == [3, 3]
    for plant in PLANTS.values():
        with plant.fault() as patched:
            assert patched is not None


def test_a_fault_is_noticed_by_its_own_numbers_and_where_nothing_else_is_red(monkeypatch: pytest.MonkeyPatch) -> None:
    measured: list[dict[str, float]] = []

    def prove_with(*rounds: dict[str, float]) -> bool:
        measured[:] = rounds
        return gate.prove(["planted"])

    band = Band(0.0, 1.5)
    part = Part(lambda: measured.pop(0), lambda before: before, lambda recorded: {"one": band, "other": band}, "ratio")
    monkeypatch.setitem(PARTS, "part", part)
    monkeypatch.setattr(gate, "read_records", lambda: {"part": None})
    monkeypatch.setitem(PLANTS, "planted", Plant(contextlib.nullcontext, "part", ("one",)))
    good, red, other_red = {"one": 1.0, "other": 1.0}, {"one": 2.0, "other": 1.0}, {"one": 1.0, "other": 2.0}
    assert prove_with(good, red)
    assert not prove_with(good, good)
    assert not prove_with(good, other_red)
    assert not prove_with(red, red)


def test_a_time_counts_against_the_code_only_where_each_try_is_outside_its_band(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    band, measured = Band(0.0, 1.5), iter([])
    limits = {"one": band, "other": band}
    part = Part(lambda: next(measured), lambda before: before, lambda recorded: limits, "ratio", tries=3)
    monkeypatch.setitem(PARTS, "part", part)

    def measured_of(*rounds: tuple[float, float]) -> dict[str, float]:
        nonlocal measured
        measured = iter([{"one": one, "other": other} for one, other in rounds])
        least = gate.measure("part", limits)
        assert not list(measured), "fewer tries than are allowed"
        return least

    assert measured_of((1.0, 1.2)) == {"one": 1.0, "other": 1.2}
    # What was good is not measured worse by a try for another number
    assert measured_of((1.0, 2.0), (3.0, 1.4)) == {"one": 1.0, "other": 1.4}
    assert "again (2 left): other" in capsys.readouterr().out
    assert measured_of((1.0, 2.0), (1.0, 1.9), (1.0, 2.1)) == {"one": 1.0, "other": 1.9}
    assert not gate.verdicts({"one": 1.0, "other": 1.9}, limits)["other"]


def test_every_fault_has_numbers_that_are_recorded() -> None:
    records = read_records()
    for plant in PLANTS.values():
        assert plant.numbers and set(plant.numbers) <= set(PARTS[plant.part].bands(records[plant.part]))


def test_without_a_record_the_gate_says_what_to_do(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("benchmarks.gate.records.RECORDS", tmp_path / "gate.json")
    with pytest.raises(SystemExit, match=r"python -m benchmarks\.gate record"):
        read_records()


def test_the_records_cover_what_is_measured_with_seeds_of_their_own() -> None:
    records = read_records()
    assert set(records["learning"]) == set(RUNS) and set(records["work"]) == set(COUNTS)
    for name, scores in (records["learning"] | records["work"]).items():
        assert len(scores) >= 20, name
        assert not {int(seed) for seed in scores} & {*SEEDS, SEED}, name
    assert {f"rollout / steps, {task}" for task in ROLLOUT_TASKS} < set(records["speed"])
    assert all(len(runs) >= 10 for runs in records["speed"].values())
    for name, part in PARTS.items():
        assert all(band.low < band.high for band in part.bands(records[name]).values())
