"""What is made of the results of the benchmark against peers."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from matplotlib import rc_context
from peers_data import A_PROCESSOR, ENDS, SEEDS, TASKS, a_run, results
from rliable import metrics

from benchmarks.peers import aggregates, over_tasks, report, tables, targets
from benchmarks.peers.aggregates import improvement, interquartile_means, normalized, probability_of_improvement, ratio
from benchmarks.peers.algorithms import A2C, ALGORITHMS, OURS, PPO, TRPO
from benchmarks.peers.comparison import final_scores, is_learned, mujoco_runs, on_one_processor, scores_after, times_to_reach
from benchmarks.peers.curves import Run, against_seconds, against_steps, first_reach, runs_of, scores_of
from benchmarks.peers.errors import PeersError
from benchmarks.peers.figures import draw_all
from benchmarks.peers.former import marked, notes_on_former
from benchmarks.peers.journal import Journal, State, journal_path
from benchmarks.peers.page import filled
from benchmarks.peers.plan import Cell
from benchmarks.peers.protocol import EVALUATIONS, MUJOCO_STEPS, MUJOCO_TASKS
from benchmarks.peers.settings import our_defaults, settings_of
from benchmarks.peers.table import export, gather, read_results
from benchmarks.peers.texts import number
from benchmarks.peers.variants import CANDIDATES, SHIPPED
from sb3_gae.sweep.figures.style import STYLE
from sb3_gae.sweep.statistics import estimate

TABLE = results()


@pytest.fixture(autouse=True, scope="module")
def few_resamples() -> Iterator[None]:
    """What the numbers mean is not at stake here, and they take their time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(aggregates, "RESAMPLES", 100)
        patch.setattr(estimate, "__defaults__", (100,))
        yield


@pytest.fixture(scope="module")
def sections() -> dict[str, str]:
    return report.sections_of(TABLE)


def rows_of(section: str) -> list[list[str]]:
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in section.splitlines()[2:]]


def test_runs_are_in_order() -> None:
    runs = runs_of(TABLE.sample(frac=1, random_state=0), "Hopper-v5", TRPO, MUJOCO_STEPS)
    assert [run.seed for run in runs] == list(range(SEEDS))
    assert all((np.diff(run.steps) > 0).all() for run in runs)
    np.testing.assert_allclose(scores_of(runs), ENDS[TRPO][0] + np.arange(SEEDS))
    assert runs_of(TABLE, "Hopper-v5", TRPO, 5) == []


def test_a_score_is_the_mean_of_the_last_tenth() -> None:
    returns = np.zeros(EVALUATIONS + 1)
    returns[-4:] = [1, 2, 3, 6]
    returns[3] = 100
    assert Run(0, np.arange(EVALUATIONS + 1), np.zeros(EVALUATIONS + 1), returns, A_PROCESSOR).score == 3


def test_curves_are_on_a_common_grid() -> None:
    late = Run(0, np.array([0.0, 60, 110]), np.array([0.0, 6, 11]), np.array([0.0, 60, 110]), A_PROCESSOR)
    early = Run(1, np.array([0.0, 50, 100]), np.array([0.0, 10, 20]), np.array([0.0, 0, 100]), A_PROCESSOR)
    grid, returns = against_steps([late, early], 100)
    assert (grid[0], grid[-1], returns.shape) == (0, 100, (2, EVALUATIONS + 1))
    np.testing.assert_allclose(returns[0], grid)
    seconds, returns = against_seconds([late, early])
    assert seconds[-1] == 11
    np.testing.assert_allclose(returns[:, -1], [110, 10])


def test_first_reach() -> None:
    run = Run(0, np.array([0.0, 10, 20]), np.array([0.0, 1, 2]), np.array([0.0, 5, 4]), A_PROCESSOR)
    assert first_reach(run, 4.5) == (10, 1)
    assert first_reach(run, 6) == (np.inf, np.inf)


def test_time_to_reach_is_part_of_the_peers_training() -> None:
    reach = times_to_reach(mujoco_runs(TABLE))["Hopper-v5"]
    assert reach.target == pytest.approx(2001)
    # Ours climbs to 3 000 within 50 s, and is evaluated every 2.5 s; TRPO is there after half of its 400 s
    assert reach.seconds == pytest.approx(35)
    assert reach.peer_seconds == pytest.approx(200)
    assert (reach.steps, reach.peer_steps) == pytest.approx((350_000, 500_000))
    assert reach.part == pytest.approx(35 / 400)


def test_seconds_of_one_processor_only_are_compared() -> None:
    table = TABLE[TABLE["algorithm"].isin([OURS, TRPO])].copy()
    elsewhere = (table["algorithm"] == TRPO) & (table["seed"] == 2)
    table.loc[elsewhere, "processor"] = "another processor"
    table.loc[elsewhere, "cpu_seconds"] *= 100
    runs = mujoco_runs(table)
    assert [run.seed for run in on_one_processor(runs)["Hopper-v5"][TRPO]] == [0, 1]
    reach = times_to_reach(runs)["Hopper-v5"]
    assert reach.target == pytest.approx(2001), "all runs say what is to be reached"
    assert reach.peer_training == pytest.approx(400)
    assert scores_after(runs, 0.05)[TRPO].shape == (2, len(TASKS))
    assert scores_after(runs, 0.05)[OURS].shape == (SEEDS, len(TASKS))
    assert [row[-2] for row in rows_of(targets.targets_table(table))[:3]] == ["3", "3", "2"]


def test_without_a_processor_in_common_times_are_not_compared() -> None:
    table = TABLE.copy()
    table.loc[(table["algorithm"] == TRPO) & (table["task"] == "Hopper-v5"), "processor"] = "another processor"
    assert list(times_to_reach(mujoco_runs(table))) == ["HalfCheetah-v5"]
    table.loc[table["algorithm"] == TRPO, "processor"] = "another processor"
    sections = report.sections_of(table)
    assert (sections["reach"], sections["clock"]) == ("", "")
    assert "a fifth of its time" not in sections["targets"]
    assert sections["scores"] == tables.scores_table(TABLE)
    assert draw_all(table) == {}
    assert sections["figure steps"] == "", "no picture that is not there"


def test_scores_are_in_units_of_the_peers() -> None:
    runs = mujoco_runs(TABLE)
    assert list(runs) == list(TASKS)
    scores = final_scores(runs)
    assert list(scores) == [OURS, TRPO, PPO]
    assert scores[OURS].shape == (SEEDS, len(TASKS))
    means = interquartile_means(scores)
    assert means[TRPO].point == pytest.approx(1, abs=1e-3)
    assert means[OURS].point == pytest.approx(1.5, abs=1e-3)
    assert ratio(scores[OURS], scores[PPO], scores[TRPO]).point == pytest.approx(2, abs=1e-3)
    # After a twentieth of TRPO's time ours has climbed a fifth of the way and more
    assert interquartile_means(scores_after(runs, 0.05))[OURS].point == pytest.approx(0.4 * 1.5, rel=1e-2)


def test_chance_in_the_units_widens_the_interval_of_a_ratio_but_to_the_units_themselves_once() -> None:
    rng = np.random.default_rng(0)
    ours, peer = (mean + rng.normal(size=(8, 4)) for mean in (15.0, 10.0))
    exact, uncertain = np.ones((8, 4)), np.array([[0.5], [1.5]] * 4) * np.array([1.0, 0.5, 2.0, 1.0])
    narrow, wide = ratio(ours, peer, exact), ratio(ours, peer, uncertain / uncertain.mean(axis=0))
    assert narrow.point == pytest.approx(wide.point)
    assert wide.high - wide.low > narrow.high - narrow.low
    # In units of its own the peer is 1 in each resample, so the ratio is that of the parts
    assert ratio(2.0 * peer, peer, peer).point == pytest.approx(2.0)


def test_a_unit_must_be_positive() -> None:
    with pytest.raises(PeersError, match="`reference` must be positive"):
        normalized([np.array([1.0])], [np.array([-1.0])])


def test_probability_of_improvement_is_rliables() -> None:
    rng = np.random.default_rng(0)
    first, second = rng.integers(0, 4, (5, 3)).astype(float), rng.integers(0, 4, (4, 3)).astype(float)
    expected = metrics.probability_of_improvement(first, second)
    assert probability_of_improvement(first, second) == pytest.approx(expected)
    interval = improvement(first, second)
    assert interval.point == pytest.approx(expected)
    assert interval.low < interval.point < interval.high


def test_tables_say_what_the_results_say(sections: dict[str, str]) -> None:
    assert rows_of(sections["scores"])[1] == [
        "Hopper-v5",
        "3 001 [3 000, 3 002] (3)",
        "2 001 [2 000, 2 002] (3)",
        "1 501 [1 500, 1 502] (3)",
        "",
    ]
    assert [row[:2] for row in rows_of(sections["over tasks"])] == [
        ["TRPOGAE (ours)", "3 × 2"],
        ["TRPO, sb3-contrib", "3 × 2"],
        ["PPO, SB3", "3 × 2"],
    ]
    assert rows_of(sections["over tasks"])[1][3] == "1.00 [1.00, 1.00]"
    assert rows_of(sections["classic"])[0][0::5] == ["CartPole-v1", "no"]
    assert rows_of(sections["classic"])[0][4].startswith("0.00 ")
    assert rows_of(sections["three million"])[0][0::3] == ["Ant-v5", "4 079"]
    assert rows_of(sections["ablation"])[1][0] == "Monte-Carlo targets, not λ-returns"
    assert rows_of(sections["ablation"])[1][-1].startswith("0.50 ")
    assert rows_of(sections["reach"])[1] == [
        *["Hopper-v5", "2 001", "350 000", "500 000", "35 s", "200 s", "400 s"],
        *["0.17", "0.09"],
    ]
    assert rows_of(sections["clock"])[0][1:4:2] == ["3 × 2", ""]
    assert "- processor: a processor" in sections["origin"]
    assert "each of the processor, median over runs: SB3's A2C 1.50, at most 1.50; " in sections["origin"]


def test_the_summary_names_the_best_peer_first_and_how_many_runs_there_are(sections: dict[str, str]) -> None:
    assert sections["summary"] == (
        "Over 2 tasks the interquartile mean of TRPOGAE is 1.50 [1.50, 1.50] times that of sb3-contrib's TRPO, 2.00 "
        "[2.00, 2.00] times that of SB3's PPO. Runs that count on each task: TRPOGAE 3, sb3-contrib's TRPO 3, SB3's PPO 3."
    )
    assert over_tasks.summary(TABLE[TABLE["seed"] < 2]).endswith("**Few runs, so little is said of chance.**")


def test_targets_are_met_or_not(sections: dict[str, str]) -> None:
    found = [row[-3:] for row in rows_of(sections["targets"])]
    assert found[:3] == [["2 of 6", "3", "so far yes"]] * 3
    assert found[3:] == [["1 of 5", "3", "so far **no**"], ["1 of 3", "3", "so far yes"]]
    assert "without A2C, SB3 and TRPO, tianshou and NPG, tianshou" in rows_of(sections["targets"])[0][1]


def test_a_target_is_met_once_all_that_it_is_about_has_been_run() -> None:
    def first(table: pd.DataFrame) -> list[str]:
        return rows_of(targets.targets_table(table))[0][-3:]

    whole = pd.concat(
        [
            a_run(task, name, seed, MUJOCO_STEPS, end=2000.0 if name == OURS else 1000.0)
            for task in MUJOCO_TASKS
            for name in ALGORITHMS
            for seed in range(SEEDS)
        ],
        ignore_index=True,
    )
    assert first(whole) == ["6 of 6", "3", "yes"]
    assert first(whole[whole["seed"] < 2]) == ["6 of 6", "2", "so far yes"]
    assert first(whole[whole["algorithm"] != A2C]) == ["6 of 6", "3", "so far yes"]
    assert first(whole[whole["task"] != "Ant-v5"]) == ["5 of 6", "3", "so far yes"]
    assert first(whole.assign(former=whole["task"] == "Ant-v5")) == ["6 of 6", "3", "so far yes"]


def test_a_target_that_is_met_by_what_trpo_does_not_learn_alone_says_so() -> None:
    def end(task: str, name: str) -> float:
        if name == TRPO:
            return 100.0 if task == "Ant-v5" else 1000.0
        return 1700.0 if task in ("HalfCheetah-v5", "Hopper-v5") else 1000.0

    whole = pd.concat(
        [
            a_run(task, name, seed, MUJOCO_STEPS, end=end(task, name))
            for task in MUJOCO_TASKS
            for name in (OURS, TRPO)
            for seed in range(SEEDS)
        ],
        ignore_index=True,
    )
    begins = (whole["task"] == "Ant-v5") & (whole["step"] == 0)
    whole.loc[begins, "mean_return"] = 900.0
    assert rows_of(targets.targets_table(whole))[0][-1] == "so far only with Ant-v5"
    elsewhere = whole["task"] != "Ant-v5"
    assert rows_of(targets.targets_table(whole[elsewhere]))[0][-1] == "so far **no**"


def test_what_trpo_does_not_learn_is_no_target() -> None:
    table = TABLE.copy()
    falls = (table["task"] == "Hopper-v5") & (table["algorithm"] == TRPO)
    table.loc[falls, "mean_return"] = 3000.0 - table.loc[falls, "mean_return"]
    runs = mujoco_runs(table)
    assert not is_learned(runs["Hopper-v5"])
    # Reached at once, and yet not what the target asks for
    assert list(times_to_reach(runs)) == ["HalfCheetah-v5"]
    over_all, _, reach = rows_of(targets.targets_table(table))[:3]
    assert "on all 1 that it learns" in reach[1] and reach[2] == "1 of 5"
    assert "; without Hopper-v5 1.5" in over_all[1]
    assert "Without Hopper-v5, which sb3-contrib's TRPO does not learn, it is 1.5" in over_tasks.summary(table)
    assert over_tasks.aggregate_table(table).splitlines()[0].endswith("| the same without Hopper-v5 |")
    falls = table["algorithm"] == TRPO
    table.loc[falls, "mean_return"] = 3000.0 - TABLE.loc[falls, "mean_return"]
    assert rows_of(targets.targets_table(table))[2][1::3] == ["it learns none", "so far **no**"]


def test_one_or_two_runs_have_no_interval() -> None:
    two = TABLE[TABLE["seed"] < 2]
    assert rows_of(over_tasks.aggregate_table(two))[0][2] == "1.50"
    assert rows_of(over_tasks.aggregate_table(two))[1][3:] == ["1.00", "1.50"]
    assert rows_of(tables.scores_table(two))[1][1] == "3 000 (2 runs)"


def test_nothing_is_shown_where_there_are_no_results() -> None:
    sections = report.sections_of(read_results(Path("nowhere")))
    named = [name for name in sections if name in ("classic", "three million", "ablation") or name.startswith("tuning")]
    chapters = {name: sections.pop(name) for name in named}
    assert "| Swimmer-v5 | 2 × 1 024 | 0.9999 | 0.98 | 0.01 | 0 | 3 | auto |" in sections.pop("shipped")
    assert set(sections.values()) == {""}
    assert all(text.startswith("Not run yet: `python -m benchmarks.peers run --preset ") for text in chapters.values())


def test_figures() -> None:
    with rc_context(STYLE):
        figures = draw_all(TABLE)
        for figure in figures.values():
            figure.canvas.draw()
    assert list(figures) == ["peers_steps", "peers_seconds", "peers_over_tasks"]
    assert len(figures["peers_steps"].axes) == len(TASKS)
    assert draw_all(TABLE.iloc[:0]) == {}


def test_numbers() -> None:
    assert [number(value) for value in (6053.4, -12.5, 9.876, 1234567)] == ["6 053", "-12", "9.88", "1 234 567"]


def test_the_page_keeps_what_is_not_between_markers() -> None:
    page = "a\n<!-- results: one -->\nold\n<!-- end -->\nb\n<!-- results: two -->\n<!-- end -->\nc\n"
    new = filled(page, {"one": "| new |", "two": ""})
    assert new == "a\n<!-- results: one -->\n\n| new |\n\n<!-- end -->\nb\n<!-- results: two -->\n<!-- end -->\nc\n"
    assert filled(new, {"one": ""}).startswith("a\n<!-- results: one -->\n<!-- end -->\nb")
    with pytest.raises(PeersError, match="`page` must have the markers of 'three' once"):
        filled(page, {"three": ""})
    # Else all up to the end of the next section would go
    with pytest.raises(PeersError, match="markers of 'one' once"):
        filled(page.replace("<!-- end -->", "", 1), {"one": ""})


def test_export_keeps_runs_that_are_not_here(tmp_path: Path) -> None:
    def run(cell: Cell, value: float, status: State = State.DONE, begun: int = 0) -> None:
        journal = Journal(journal_path(tmp_path / "logs", cell))
        start = {"cell": list(cell), "settings": {"gamma": 1}, "origin": {"torch": "2"}, "time": begun}
        journal.begin(start)
        journal.evaluated({"steps": 0, "mean_return": value, "wall_seconds": 0.0})
        journal.evaluated({"steps": 1000, "mean_return": value, "wall_seconds": 1.0})
        journal.end(status, "a reason")
        journal.close()

    cell = Cell("Hopper-v5", OURS, "", 0, 1000)
    run(cell, 1.0)
    run(cell._replace(seed=1), 2.0)
    run(cell._replace(seed=2), 3.0, State.FAILED)
    table, failures = gather(tmp_path / "logs")
    assert failures == [f"{cell._replace(seed=2).name}: a reason"]
    exported = export(table, tmp_path)
    assert [path.name for path in exported.paths] == ["Hopper-v5.parquet"] and exported.notes == []
    journal_path(tmp_path / "logs", cell).unlink()
    run(cell._replace(seed=1), 5.0, begun=1)
    assert export(gather(tmp_path / "logs")[0], tmp_path).notes == [
        "replaced by a run that was begun later: Hopper-v5_trpo_gae_1000_seed1"
    ]
    run(cell._replace(seed=1), 6.0)
    assert export(gather(tmp_path / "logs")[0], tmp_path).notes == [
        "not exported, since the file has a run that was begun later: Hopper-v5_trpo_gae_1000_seed1"
    ]
    stored = read_results(tmp_path)
    assert list(stored["seed"]) == [0, 0, 1, 1]
    assert list(stored["mean_return"]) == [1.0, 1.0, 5.0, 5.0]
    assert list(stored["step"]) == [0, 1000, 0, 1000]
    with pytest.raises(PeersError, match="nothing to export"):
        export(pd.DataFrame(), tmp_path)


def test_a_report_without_results_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(report, "read_results", lambda: read_results(tmp_path))
    with pytest.raises(PeersError, match="no results yet"):
        report.write_report(tmp_path)


def test_a_report_is_a_page_and_figures(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    few = pd.concat([a_run("Hopper-v5", name, seed, MUJOCO_STEPS) for name in (OURS, TRPO) for seed in (0, 1)])
    few["settings"] = json.dumps(settings_of(Cell("Hopper-v5", OURS, "", 0, MUJOCO_STEPS)) | {"gamma": 0.5})
    monkeypatch.setattr(report, "read_results", lambda: few)
    (tmp_path / "docs").mkdir()
    for path in report.PAGES:
        (tmp_path / path).write_text((report.ROOT / path).read_text())
    written = report.write_report(tmp_path)
    page = (tmp_path / "docs" / "benchmarks.md").read_text()
    assert "![Return against steps on each task](images/peers_steps.svg)" in page
    assert {path.name for path in written.paths} >= {"benchmarks.md", "tuning.md", "README.md", "peers_steps.svg"}
    assert all(path.stat().st_size > 0 for path in written.paths)
    assert written.notes == ["Hopper-v5_trpo_gae_1000000: 2 of 2 runs are of settings that are no longer shipped; marked"]
    assert "| 3 000 (2 runs) † |" in page and "† Of settings that are no longer shipped." in page
    assert "Ours on Hopper-v5 are of settings that are no longer shipped." in page


def test_runs_of_former_settings_do_not_mix_with_those_of_today() -> None:
    def runs(algorithm: str, seeds: range, variant: str, **changes: Any) -> pd.DataFrame:
        table = pd.concat([a_run("Hopper-v5", algorithm, seed, MUJOCO_STEPS, variant) for seed in seeds])
        settings = settings_of(Cell("Hopper-v5", algorithm, variant, 0, MUJOCO_STEPS)) | changes
        return table.drop(columns="former").assign(settings=json.dumps(settings))

    table = pd.concat(
        [
            runs(OURS, range(2), SHIPPED, normalize_value=our_defaults()["normalize_value"]),
            runs(OURS, range(2, 5), SHIPPED, gamma=0.5),
            runs(OURS, range(1), "adam", gamma=0.5),
            runs(OURS, range(1), next(iter(CANDIDATES)), gamma=0.5),
            runs(TRPO, range(1), SHIPPED, gamma=0.5),
        ]
    )
    found = marked(table).groupby(["algorithm", "variant", "seed"])["former"].first()
    assert found.to_dict() == {
        (OURS, SHIPPED, 0): False,
        (OURS, SHIPPED, 1): False,
        (OURS, "adam", 0): True,
        (OURS, next(iter(CANDIDATES)), 0): False,
        (TRPO, SHIPPED, 0): False,
    }
    assert notes_on_former(table) == [
        "Hopper-v5_trpo_gae_1000000: 3 of 5 runs are of settings that are no longer shipped; left out",
        "Hopper-v5_trpo_gae.adam_1000000: 1 of 1 runs are of settings that are no longer shipped; marked",
    ]


def test_of_two_processors_with_as_many_pairs_that_with_more_runs_is_compared() -> None:
    table = TABLE[TABLE["algorithm"].isin([OURS, TRPO]) & (TABLE["steps"] == MUJOCO_STEPS)].copy()
    elsewhere = ((table["seed"] == 0) & (table["algorithm"] == TRPO)) | (table["seed"] < 2) & (table["algorithm"] == OURS)
    table.loc[elsewhere, "processor"] = "z"
    table = table[~((table["seed"] == 2) & (table["algorithm"] == TRPO))]
    timed = on_one_processor(mujoco_runs(table))["Hopper-v5"]
    assert {name: [run.seed for run in runs] for name, runs in timed.items()} == {OURS: [0, 1], TRPO: [0]}
