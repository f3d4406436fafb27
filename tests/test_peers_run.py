"""Runs of the benchmark against peers: what is recorded, what is run again, and from where a run goes on."""

import json
import os
import shutil
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.peers import worker
from benchmarks.peers.algorithms import OURS, TRPO
from benchmarks.peers.checkpoint import Checkpoint
from benchmarks.peers.cli import main
from benchmarks.peers.clock import TrainingClock
from benchmarks.peers.errors import PeersError
from benchmarks.peers.evaluation import Evaluator
from benchmarks.peers.journal import BusyError, Journal, Record, State, journal_path, read_record
from benchmarks.peers.plan import PRESETS, Cell
from benchmarks.peers.pool import Options, Pool, check_libraries, cores_for
from benchmarks.peers.progress import Bar, left_of, standings, summary
from benchmarks.peers.recorder import Recorder
from benchmarks.peers.settings import described, settings_of
from benchmarks.peers.table import read_results

CELL = Cell("CartPole-v1", OURS, "", 0, 4_000)
SETTINGS = described(OURS, settings_of(CELL))
START: dict[str, Any] = {"cell": list(CELL), "settings": settings_of(CELL), "origin": {"commit": "first", "torch": "2"}}
FORMER = START | {"settings": settings_of(CELL) | {"gamma": 0.5}}
OTHER_COMMIT = START | {"origin": {"commit": "second", "torch": "2"}}


@pytest.fixture(autouse=True)
def in_the_checkout(monkeypatch: pytest.MonkeyPatch) -> None:
    # Where processes of their own find the package
    monkeypatch.chdir(Path(__file__).parents[1])


def test_a_clock_that_stands_counts_nothing() -> None:
    clock = TrainingClock()
    assert clock.read() == (0, 0)
    clock.set(5, 2)
    clock.start()
    clock.start()
    while clock.read()[1] <= 2:
        pass
    clock.stop()
    wall, cpu = clock.read()
    assert wall > 5
    time.sleep(0.01)
    clock.stop()
    assert clock.read() == (wall, cpu)


def test_evaluations_are_the_same_episodes_each_time() -> None:
    evaluator = Evaluator("CartPole-v1", episodes=3)
    first, again = (evaluator.play(lambda seen: (seen[:, 2] > 0).astype(int)) for _ in range(2))
    evaluator.close()
    np.testing.assert_array_equal(first.returns, again.returns)
    np.testing.assert_array_equal(first.returns, first.lengths)
    assert len(set(first.returns)) > 1


def test_an_evaluation_is_due_at_multiples_of_the_interval() -> None:
    recorder = Recorder(Evaluator("CartPole-v1", 1), TrainingClock(), 100, lambda line: None)
    assert [recorder.next_after(steps) for steps in (0, 99, 100, 250)] == [100, 100, 200, 300]


def test_states_of_a_run(tmp_path: Path) -> None:
    path = journal_path(tmp_path, CELL)
    assert read_record(path).state(SETTINGS) == State.NEW
    journal = Journal(path)
    with pytest.raises(BusyError, match="another process"):
        Journal(path)
    journal.begin(START)
    journal.evaluated({"steps": 100})
    assert (read_record(path).state(SETTINGS), read_record(path).steps) == (State.UNFINISHED, 100)
    journal.end(State.FAILED, "why")
    assert read_record(path).state(SETTINGS) == State.FAILED
    journal.begin(START, [{"kind": "evaluation", "steps": 100}])
    assert read_record(path).evaluations == [{"kind": "evaluation", "steps": 100}]
    journal.end(State.DONE)
    journal.close()
    assert read_record(path).state(SETTINGS) == State.DONE
    assert read_record(path).state(described(OURS, FORMER["settings"])) == State.STALE


def test_to_spell_out_a_default_changes_no_settings() -> None:
    settings = settings_of(CELL)
    assert "normalize_value" not in settings
    assert described(OURS, settings | {"normalize_value": True}) == described(OURS, settings)
    assert described(OURS, settings | {"normalize_value": False}) != described(OURS, settings)


def test_a_line_that_was_cut_off_does_not_count(tmp_path: Path) -> None:
    path = tmp_path / "run.jsonl"
    path.write_text(json.dumps({"kind": "start", **START}) + '\n{"kind": "evaluation", "ste')
    assert read_record(path) == Record({"kind": "start", **START}, [], None)
    # Nor does it spoil the line that comes after it
    journal = Journal(path)
    journal.end(State.FAILED, "disk full")
    journal.close()
    assert read_record(path).end == {"kind": "end", "status": "failed", "reason": "disk full"}


def test_a_run_goes_on_from_its_checkpoint() -> None:
    lines = [{"steps": 100}, {"steps": 200}, {"steps": 300}]
    start, known = worker.continued(Record(START, lines, None), OTHER_COMMIT, Checkpoint(Path("a.zip"), 200))
    assert known == lines[:2]
    assert start["origin"]["commit"] == "first, then second"
    again, _ = worker.continued(Record(start, lines, None), OTHER_COMMIT, Checkpoint(Path("a.zip"), 200))
    assert again == start


@pytest.mark.parametrize(
    ("before", "checkpoint"),
    [
        (None, Checkpoint(Path("a.zip"), 200)),
        (START, None),
        (FORMER, Checkpoint(Path("a.zip"), 200)),
        (START | {"origin": {"commit": "first", "torch": "3"}}, Checkpoint(Path("a.zip"), 200)),
    ],
)
def test_a_run_begins_anew(before: dict[str, Any] | None, checkpoint: Checkpoint | None) -> None:
    assert worker.continued(Record(before, [{"steps": 100}], None), START, checkpoint) == (START, None)


def test_what_is_left_to_run(tmp_path: Path) -> None:
    cells = [CELL._replace(seed=seed) for seed in range(7)]
    for cell, status, start in [
        (cells[1], State.DONE, START),
        (cells[2], State.FAILED, START),
        (cells[3], State.DONE, FORMER),
    ]:
        journal = Journal(journal_path(tmp_path, cell))
        journal.begin(start)
        journal.end(status, "a reason")
        journal.close()
    journal = Journal(journal_path(tmp_path, cells[4]))
    journal.begin(START)
    journal.close()
    committed = {cells[4]: SETTINGS, cells[5]: SETTINGS, cells[6]: described(OURS, FORMER["settings"])}
    table = standings(cells, tmp_path, committed)
    assert left_of(table) == [cells[0], cells[4], cells[6]]
    assert left_of(table, [State.FAILED, State.STALE]) == [cells[0], *cells[2:5], cells[6]]
    assert left_of(table, [State.COMMITTED]) == [cells[0], *cells[4:]]
    speeds = {("CartPole-v1", OURS): 1.0, ("CartPole-v1", "evaluation"): 1e9}
    text = summary(table, left_of(table), speeds, jobs=2)
    assert "7 runs: 2 new, 1 unfinished, 1 done, 1 failed, 1 stale, 1 committed" in text
    assert f"failed: {cells[2].name}: a reason" in text
    assert "3 runs left, about 3.3 core-hours, 1.7 hours with 2 side by side" in text


def test_the_bar_counts_what_has_ended_before_only_when_it_is_run_again(tmp_path: Path) -> None:
    path = journal_path(tmp_path, CELL)
    journal = Journal(path)
    journal.begin(START)
    journal.evaluated({"steps": CELL.steps})
    journal.end(State.FAILED, "why")
    bar = Bar([CELL], tmp_path)
    assert bar._count() == (0, 0)
    journal.begin(START)
    journal.evaluated({"steps": 10})
    assert bar._count() == (10, 0)
    journal.end(State.DONE)
    assert bar._count() == (CELL.steps, 1)
    journal.close()
    bar.close()


def test_a_run_that_is_killed_is_recorded_and_the_rest_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cells = [CELL, CELL._replace(seed=1)]

    ending = json.dumps({"kind": "end", "status": "done", "reason": ""})

    def command(cell: Cell, logs: Path, core: int | None, python: str) -> list[str]:
        if cell == CELL:
            return ["sh", "-c", "kill -9 $$"]
        return ["sh", "-c", f"echo '{ending}' > {journal_path(logs, cell)}"]

    monkeypatch.setattr("benchmarks.peers.pool.command_of", command)
    problems = Pool(cells, Options(tmp_path, 1, False, {}), lambda: None).run()
    assert problems == [f"{CELL.name}: killed by SIGKILL"]
    assert read_record(journal_path(tmp_path, CELL)).end == {
        "kind": "end",
        "status": "failed",
        "reason": f"killed by SIGKILL, see {CELL.name}.txt",
    }


def test_a_rerun_that_is_killed_at_once_is_said_and_leaves_the_run_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    journal = Journal(journal_path(tmp_path, CELL))
    journal.begin(FORMER)
    journal.end(State.DONE)
    journal.close()
    before = read_record(journal_path(tmp_path, CELL))
    monkeypatch.setattr("benchmarks.peers.pool.command_of", lambda *args: ["sh", "-c", "kill -9 $$"])
    assert Pool([CELL], Options(tmp_path, 1, False, {}), lambda: None).run() == [f"{CELL.name}: killed by SIGKILL"]
    assert read_record(journal_path(tmp_path, CELL)) == before


def test_a_run_that_was_stopped_together_with_the_command_has_not_failed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As a scheduler stops a whole job."""
    stop_both = f"kill -TERM {os.getpid()} && kill -TERM $$"
    monkeypatch.setattr("benchmarks.peers.pool.command_of", lambda *args: ["sh", "-c", stop_both])
    problems = Pool([CELL], Options(tmp_path, 1, False, {}), lambda: None).run()
    assert problems == ["stopped by SIGTERM; the same command goes on from here"]
    assert read_record(journal_path(tmp_path, CELL)).end is None


def test_wrong_options_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = Options(tmp_path, 1, True, {})
    with pytest.raises(PeersError, match=r"`jobs` must be at most \d+, the number of cores, got 10000"):
        cores_for(options._replace(jobs=10_000))
    with pytest.raises(PeersError, match=r"is not installed for .*--algorithms trpo"):
        without = CELL._replace(algorithm="tianshou_npg")
        check_libraries([without, CELL._replace(algorithm=TRPO)], options._replace(pythons={"tianshou": "false"}))
    assert main(["status", "--preset", "smoke", "--seeds", "7"]) == 2
    assert "`seeds`: the preset has no 7; it has 0." in capsys.readouterr().err
    assert main(["status", "--preset", "smoke", "--jobs", "0"]) == 2
    assert "`jobs` must be at least 1, got 0" in capsys.readouterr().err


def test_a_run_of_ours_that_fails_goes_on_as_if_it_had_not(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def run(logs: Path) -> tuple[int, Record]:
        status = worker.main(["--cell", json.dumps(list(CELL)), "--logs", str(logs)])
        return status, read_record(journal_path(logs, CELL))

    def fail(self: Recorder, steps: int, act: Any) -> None:
        if steps > 3000:
            raise RuntimeError("a fault")
        evaluate(self, steps, act)

    evaluate = Recorder.evaluate
    status, whole = run(tmp_path / "whole")
    assert (status, whole.steps) == (0, 4096)
    with monkeypatch.context() as patch:
        patch.setattr(Recorder, "evaluate", fail)
        status, failed = run(tmp_path / "twice")
    assert status == 1
    assert failed.steps == 2048
    assert failed.end is not None and failed.end["reason"].startswith("RuntimeError: a fault [test_peers_run.py:")
    status, second = run(tmp_path / "twice")
    assert status == 0
    assert not (tmp_path / "twice" / CELL.name).exists()
    for name in ("steps", "mean_return", "mean_length"):
        assert [line[name] for line in second.evaluations] == [line[name] for line in whole.evaluations]
    # Not run again
    assert second.evaluations[1]["wall_seconds"] == failed.evaluations[1]["wall_seconds"]
    seconds = [line["wall_seconds"] for line in second.evaluations]
    assert seconds == sorted(seconds) and seconds[0] < seconds[1]


def test_the_command_runs_exports_and_has_nothing_left(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    places = ["--logs", str(tmp_path / "logs"), "--results", str(tmp_path / "results")]
    command = ["run", "--preset", "smoke", *places, "--jobs", "2", "--no-pin"]
    assert main([*command, "--dry-run"]) == 0
    assert "2 runs left" in capsys.readouterr().out
    assert not (tmp_path / "logs").exists()
    assert main(command) == 0
    records = [read_record(journal_path(tmp_path / "logs", cell)) for cell in PRESETS["smoke"]]
    today = [described(cell.algorithm, settings_of(cell)) for cell in PRESETS["smoke"]]
    assert [record.state(settings) for record, settings in zip(records, today, strict=True)] == [State.DONE, State.DONE]
    assert all([line["steps"] for line in record.evaluations] == [0, 1024, 2048] for record in records)
    capsys.readouterr()
    assert main(command) == 0
    assert "2 runs: 2 done" in capsys.readouterr().out

    assert main(["export", *places]) == 0
    shutil.rmtree(tmp_path / "logs")
    capsys.readouterr()
    assert main(command) == 0
    assert "2 runs: 2 committed" in capsys.readouterr().out
    table = read_results(tmp_path / "results")
    assert len(table) == 6
    assert set(table["algorithm"]) == {OURS, TRPO}
    assert (table["cores"] == os.cpu_count()).all() and (table["python"] == sys.version.split()[0]).all()
