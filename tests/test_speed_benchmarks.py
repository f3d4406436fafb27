"""The arithmetic of the speed benchmarks; to time things is left to `python -m benchmarks.speed`."""

import copy
import math
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch as th
from torch.utils.flop_counter import FlopCounterMode

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.peers.errors import PeersError
from benchmarks.peers.page import filled
from benchmarks.speed import operations as ops
from benchmarks.speed import report, results, tables
from benchmarks.speed import targets as speed_targets
from benchmarks.speed.case import DOUBLE_BACKWARD, LIMIT, OURS, PEER, Case, Prepared
from benchmarks.speed.cli import main
from benchmarks.speed.growth import exponent
from benchmarks.speed.matrix_products import matrix_products
from benchmarks.speed.plan import plan, rounds
from benchmarks.speed.stopwatch import Section, Stopwatch
from benchmarks.speed.table import groups_of
from benchmarks.update_speed import N_ACTIONS, N_STATES, Update, ours
from sb3_gae import TRPOGAE
from sb3_gae.networks.dense_network import DenseNetwork
from sb3_gae.networks.parameters import flatten
from sb3_gae.rollout.evaluation import training_batch
from sb3_gae.update.conjugate_gradient import CGStatus
from sb3_gae.update.curvature import hessian_product

BATCH = 640
HIDDEN = (100, 50, 25)
LAYERS = ops.layers_of(N_STATES, HIDDEN, N_ACTIONS)
VALUE_LAYERS = ops.layers_of(N_STATES, HIDDEN, 1)


def counted(computation: Callable[[], object]) -> int:
    """:return: operations of matrix products as torch counts them"""

    def in_place(into: tuple, left: tuple, right: tuple, **_: object) -> int:
        return 2 * left[0] * left[1] * right[1]

    # torch does not know this one by itself
    with FlopCounterMode(display=False, custom_mapping={th.ops.aten.addmm_: in_place}) as counter:
        computation()
    return counter.get_total_flops()


@pytest.fixture
def network() -> DenseNetwork:
    return network_of_layers()


def network_of_layers() -> DenseNetwork:
    modules: list[th.nn.Module] = []
    for layer in LAYERS:
        modules += [th.nn.Linear(*layer), th.nn.Tanh()]
    made = DenseNetwork(modules[:-1], th.randn(BATCH, N_STATES))
    made.forward()
    return made


@pytest.fixture(scope="module")
def model() -> TRPOGAE:
    return ours(BATCH)


def test_passes_of_a_network_are_what_torch_counts(network: DenseNetwork) -> None:
    vector, outputs = th.randn(network.n_parameters), th.randn(BATCH, N_ACTIONS)
    passes = {
        ops.operations(ops.forward(LAYERS, BATCH)): network.forward,
        ops.operations(ops.backward(LAYERS, BATCH)): lambda: network.vjp(outputs),
        ops.operations(ops.curvature_product(LAYERS, BATCH)): lambda: network.gauss_newton_product(vector, lambda x, _: x),
    }
    assert {expected: counted(computation) for expected, computation in passes.items()} == {each: each for each in passes}
    assert network.n_parameters == ops.n_parameters(LAYERS)


def test_second_moments_of_the_inputs_are_computed_once() -> None:
    fresh = network_of_layers()
    counts = [counted(lambda: fresh.kronecker_factors(th.ones(BATCH, N_ACTIONS))) for _ in range(2)]
    assert counts == [ops.operations(ops.kronecker_factors(LAYERS, BATCH, again)) for again in (False, True)]


def test_double_backward_is_what_torch_counts(network: DenseNetwork) -> None:
    layers = th.nn.Sequential(*(module for pair in network.layers for module in pair if module is not None))
    outputs = layers(th.randn(BATCH, N_STATES))
    product = hessian_product(0.5 * (outputs - outputs.detach()).square().mean(), network.parameters)
    vector = flatten(network.parameters)
    assert counted(lambda: product(vector)) == ops.operations(ops.double_backward(LAYERS, BATCH))


@pytest.mark.parametrize("curvature_samples", [None, 200])
def test_an_update_is_what_torch_counts(model: TRPOGAE, curvature_samples: int | None) -> None:
    model = copy.copy(model)
    model.curvature_samples = curvature_samples
    update, batch = Update(model), training_batch(model.rollout_buffer, model.action_space)
    parameters, records = model._parameter_groups(batch), {}
    n_curvature = curvature_samples or BATCH

    def step() -> None:
        records["policy"] = model._step_policy(batch, parameters)

    def fit() -> None:
        records["value"] = model._fit_value(batch, parameters)

    found = [counted(step), counted(fit)]
    update.rewind()
    policy, *steps = (
        ops.solved(record.cg_status, record.cg_steps, record.trials) for record in (records["policy"], *records["value"].steps)
    )
    assert len(steps) > 1
    assert found == [
        ops.operations(ops.policy_step(LAYERS, BATCH, n_curvature, policy)),
        ops.operations(ops.value_fit(VALUE_LAYERS, BATCH, n_curvature, steps)),
    ]


def test_the_limit_multiplies_what_it_is_told_to() -> None:
    products = ops.curvature_product(LAYERS, 10_000)
    assert counted(matrix_products(products)) == ops.operations(products)
    assert ops.operations(ops.times(products, 3)) == 3 * ops.operations(products)


@pytest.mark.parametrize("power", [0.0, 0.5, 1.0, 2.0])
def test_the_exponent_of_a_power_is_found(power: float) -> None:
    sizes = [100, 400, 1600]
    assert exponent(sizes, [3.0 * size**power for size in sizes]) == pytest.approx(power, abs=1e-9)
    assert math.isnan(exponent([100], [1.0]))


def test_noise_of_the_smallest_size_does_not_turn_the_exponent() -> None:
    assert exponent([1, 10, 100], np.array([1.1, 10.0, 100.0])) == pytest.approx(1.0, abs=0.03)


@pytest.mark.parametrize(
    ("status", "expected"),
    [
        (CGStatus.CONVERGED, ops.Solved(3, 3, 1)),
        (CGStatus.MAX_STEPS, ops.Solved(3, 4, 1)),
        (CGStatus.NON_POSITIVE_CURVATURE, ops.Solved(4, 4, 1)),
        (CGStatus.ZERO_GRADIENT, ops.Solved(0, 0, 1)),
    ],
)
def test_what_a_solve_took_depends_on_how_it_ended(status: CGStatus, expected: ops.Solved) -> None:
    assert ops.solved(status, 3, 1) == expected


def test_rounds_are_as_many_as_there_is_time_for() -> None:
    full = plan(quick=False, threads=1)
    assert [rounds(full, seconds) for seconds in (10.0, 0.1, 1e-4)] == [full.least_rounds, 10, full.most_rounds]


def test_a_stopwatch_gives_time_to_the_innermost_call() -> None:
    now = [0.0]

    class Work:
        def outer(self) -> str:
            now[0] += 1.0
            self.inner()
            now[0] += 2.0
            return "done"

        def inner(self) -> None:
            now[0] += 10.0

    stopwatch, work = Stopwatch(lambda: now[0]), Work()
    stopwatch.watch(Section("phase", "own"), Work, "outer")
    stopwatch.watch(Section("", "called"), work, "inner")
    assert work.outer() == "done"
    now[0] += 100.0
    work.inner()
    assert stopwatch.seconds == {
        Section("phase", "own"): 3.0,
        Section("phase", "called"): 10.0,
        Section("", "called"): 10.0,
    }
    stopwatch.release()
    work.outer()
    assert sum(stopwatch.seconds.values()) == 23.0


def made_up_rows() -> list[dict]:
    """:return: an update whose cost grows with the batch, with a peer at three times the cost and a limit at half of it"""
    factors = {OURS: 1.0, DOUBLE_BACKWARD: 2.0, PEER: 3.0, LIMIT: 0.5}
    return [
        {
            "part": part, "varied": "batch", "size": size, "contender": who, "median": factor * size * 1e-5, "iqr": 1e-6,
            "rounds": 5, "operations": 10**6 * size, "cg_steps": 12, "trials": 6,
        }
        for part in ("update", "rollout, GaeBiped-v0")
        for size in (1000, 4000)
        for who, factor in factors.items()
    ]  # fmt: skip


def test_tables_say_ratios_exponents_and_rates() -> None:
    rows = made_up_rows()
    (update, _) = groups_of(rows)
    assert (update.sizes, update.ratio(PEER, OURS, 1000)) == ([1000, 4000], pytest.approx(3.0))
    assert update.ratio(PEER, "nobody", 1000) is None
    assert "| update | batch 1 000 | 10.0 ms | 1.00 µs | 20.0 ms | 30.0 ms | 5.00 ms | 3.00 | 2.00 |" in tables.parts_table(
        rows
    )
    assert "| update | batch 1 000 to 4 000 | 1.00 | 1.00 | 1.00 | 1.00 |" in tables.growth_table(rows)
    assert "| update | batch 4 000 | 4 | 100.0 | 12 | 6 |" in tables.arithmetic_table(rows)


def test_ours_and_its_limit_take_turns_at_the_largest_size(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(speed_targets, "PAUSE", 0.0)
    calls: list[str] = []

    def case(size: int, who: str, part: str = "update") -> Case:
        name = f"{who} {size}"
        return Case(part, "batch", size, who, lambda: Prepared(lambda: calls.append(name), lambda: calls.append("before")))

    cases = [case(size, who) for size in (10, 20) for who in (OURS, PEER, LIMIT)] + [case(20, OURS, "policy step")]
    (row,) = speed_targets._rows(cases, plan(quick=True, threads=1))
    assert calls == ["before", "ours 20", "before", "limit 20"] * (speed_targets.QUICK_ROUNDS + 1)
    assert (row["part"], row["varied"], row["size"], row["rounds"]) == ("update", "batch", 20, speed_targets.QUICK_ROUNDS)
    assert 0.0 < row["low"] <= row["ratio"] <= row["high"]


def test_targets_are_met_or_not() -> None:
    row = {"varied": "batch", "size": 4000, "rounds": 15, "ratio": 2.0, "low": 1.9, "high": 2.2}
    table = tables.targets_table([row | {"part": part} for part in ("update", "rollout, GaeBiped-v0")])
    update, rollout = table.splitlines()[2:]
    assert update.endswith("| batch 4 000 | 2.00 (1.90 to 2.20) | 0.50 | yes |")
    assert rollout.endswith("| batch 4 000 | 2.00 (1.90 to 2.20) | 0.50 | **no** |")
    assert tables.targets_table([]) == ""


def test_a_part_without_peer_and_limit_has_empty_cells() -> None:
    rows = [row for row in made_up_rows() if row["contender"] == OURS]
    assert "| update | batch 1 000 | 10.0 ms | 1.00 µs |  |  |  |  |  |" in tables.parts_table(rows)


@pytest.mark.parametrize(
    ("seconds", "expected"), [(12.345, "12.3 s"), (0.5, "500 ms"), (2.5e-4, "250 µs"), (3e-8, "0.0300 µs"), (0.0, "0 µs")]
)
def test_durations_have_three_digits(seconds: float, expected: str) -> None:
    assert tables.duration(seconds) == expected


def test_what_pytest_benchmark_wrote_becomes_rows_for_one_of_what_was_repeated() -> None:
    about = {"part": "stepping", "varied": "environments", "size": 4, "contender": OURS, "repeats": 10, "facts": {"trials": 2}}
    raw = {"benchmarks": [{"extra_info": about, "stats": {"median": 0.5, "iqr": 0.1, "rounds": 7, "data": [0.5] * 7}}]}
    case = {"part": "stepping", "varied": "environments", "size": 4, "contender": OURS}
    assert results.rows_of(raw) == [case | {"median": 0.05, "iqr": 0.01, "rounds": 7, "trials": 2}]


def test_page_and_figures_come_from_the_files_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    results.write(tmp_path / results.SPEED.name, made_up_rows(), quick=False, threads=2)
    section = {"task": "GaeBiped-v0", "batch": 50_176, "rounds": 3}
    parts = [("rollout", "physics"), ("policy step", "gradient"), ("value fit", "line search"), ("update", "other")]
    seconds = [section | {"phase": phase, "part": part, "seconds": 0.1} for phase, part in parts]
    results.write(tmp_path / results.SECONDS.name, seconds, quick=False, threads=2)
    times = dict.fromkeys(("rollout", "update", "iteration", "processor"), 0.5)
    combination = section | {"nothing_set": True, "torch_threads": 2, "physics_threads": 2} | times
    results.write(tmp_path / results.THREADS.name, [combination], quick=True)
    page = tmp_path / "page.md"
    page.write_text(report.PAGE.read_text())
    assert main(["report", f"--results={tmp_path}", f"--page={page}", f"--images={tmp_path / 'images'}"]) == 0
    text = page.read_text()
    for expected in ("| 25 % |", "nothing set", "threads of torch and of the physics: 2", "](images/speed_growth.svg)"):
        assert expected in text
    assert {path.name for path in (tmp_path / "images").iterdir()} == {"speed_growth.svg", "iteration_seconds.svg"}
    assert capsys.readouterr().out.count("wrote") == 3


def test_without_results_and_with_broken_ones_the_report_says_what_to_do(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["report", f"--results={tmp_path}"]) == 2
    assert "python -m benchmarks.speed run" in capsys.readouterr().err
    for text in ("{", "[]", '{"rows": []}'):
        (tmp_path / "speed.json").write_text(text)
        with pytest.raises(PeersError, match="measure anew"):
            results.read(tmp_path / "speed.json")


def test_the_page_says_what_the_committed_results_say() -> None:
    page = report.PAGE.read_text()
    assert page == filled(page, report.sections_of(results.RESULTS)), "run: python -m benchmarks.speed report"
