"""The gate's arithmetic; what it measures is left to `python -m benchmarks.gate`, since tests do not time things."""

import contextlib
import cProfile
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
from benchmarks.gate.parts import PARTS, Part, record_speed, speed_bands
from benchmarks.gate.plants import PLANTS, Plant, twice
from benchmarks.gate.records import read_records
from benchmarks.gate.speed import ROLLOUT_TASKS, Times, speed_ratios
from benchmarks.gate.work import COUNTS, SEED, CallsByStep, counted
from sb3_gae import TRPOGAE, GAERolloutBuffer
from sb3_gae.rollout.collection import ActionSampler
from sb3_gae.update import trust_region


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


def test_a_ratio_is_of_the_least_times_and_not_the_least_ratio(monkeypatch: pytest.MonkeyPatch) -> None:
    sweeps = iter([Times(4.0, 2.0), Times(3.0, 6.0), Times(5.0, 4.0)])
    monkeypatch.setattr("benchmarks.gate.speed.speed_times", lambda: {"ratio": next(sweeps)})
    monkeypatch.setattr("benchmarks.gate.speed.th.set_num_threads", lambda number: None)
    assert speed_ratios() == {"ratio": 1.5}
    assert not list(sweeps)


def test_recording_speed_keeps_the_last_recordings(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gate_parts, "speed_ratios", lambda: {"ratio": 0.5})
    (first,) = record_speed(None)
    assert first["ratios"] == {"ratio": [0.5] * gate_parts.RECORDED_RUNS}
    assert first["date"] and first["processor"] and "commit" in first
    former = [{"ratios": {"ratio": [float(number)]}} for number in range(gate_parts.KEPT_RECORDINGS)]
    assert record_speed(former[:1]) == [former[0], first]
    assert record_speed(former) == [*former[1:], first]


def test_a_band_of_speed_is_about_what_is_usual_and_about_what_is_still_measured() -> None:
    recorded = [{"ratios": {"ratio": [1.0, 9.0], "old": [1.0]}}, {"ratios": {"ratio": [2.0], "new": [4.0]}}]
    assert speed_bands(recorded) == {"ratio": Band(0.0, 3.0), "new": Band(0.0, 6.0)}


def test_arithmetic_of_products_and_calls_of_operators_are_counted() -> None:
    first, second = th.ones(3, 4), th.ones(4, 5)
    assert counted(lambda: th.tanh(first @ second)) == (2 * 3 * 4 * 5, 2)
    assert counted(lambda: None) == (0, 0)


def test_calls_of_functions_are_counted_by_step_and_the_former_profile_is_put_back() -> None:
    former = sys.getprofile()

    def own() -> None:
        [len(()), abs(1)]

    steps = CallsByStep()
    with steps:
        for times in (5, 1, 2, 4):
            for _ in range(times):
                own()
            steps._on_step()
    counts = np.diff(steps.calls_at_steps)
    assert list(np.diff(counts)) == [3 * 1, 3 * 2]
    with pytest.raises(KeyError), CallsByStep():
        raise KeyError
    assert sys.getprofile() is former


def test_calls_are_counted_under_a_profiler() -> None:
    with cProfile.Profile(), CallsByStep() as steps:
        len(())
    assert steps.calls > 0


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
    places = [
        (trust_region, "conjugate_gradient"),
        (ActionSampler, "__call__"),
        (GAERolloutBuffer, "compute_returns_and_advantage"),
        *((TRPOGAE, name) for name in ("train", "_step_policy", "_fit_value")),
    ]

    def in_place() -> list[object]:
        return [getattr(owner, name) for owner, name in places]

    before = in_place()
    for plant in PLANTS.values():
        with plant.fault():
            assert in_place() != before
        assert in_place() == before


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
    for recording in records["speed"]:
        assert {f"rollout / steps, {task}" for task in ROLLOUT_TASKS} < set(recording["ratios"])
        assert all(len(runs) == gate_parts.RECORDED_RUNS for runs in recording["ratios"].values())
    for name, part in PARTS.items():
        assert all(band.low < band.high for band in part.bands(records[name]).values())
