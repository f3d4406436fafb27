"""Results of a sweep: export, statistics, selections and figures."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure
from rliable import metrics

from sb3_gae.sweep import Cell, Curve, SweepError, SweepStudy, draw, export, read_results, results_of, select
from sb3_gae.sweep.cli import main
from sb3_gae.sweep.export import SUFFIXES
from sb3_gae.sweep.figures.curves import curves_figure
from sb3_gae.sweep.figures.heatmap import heatmap_figure
from sb3_gae.sweep.figures.lambda_curve import lambda_figure
from sb3_gae.sweep.grid import cells_of, product
from sb3_gae.sweep.ledger import Outcome, Status
from sb3_gae.sweep.provenance import provenance
from sb3_gae.sweep.recorder import COLUMNS
from sb3_gae.sweep.results import COLUMNS as COLUMNS_OF_TABLE
from sb3_gae.sweep.results import rows_of_cells
from sb3_gae.sweep.series import series_of
from sb3_gae.sweep.statistics import estimate, estimate_each, interquartile_mean
from sb3_gae.sweep.take_in import take_in

CURVES = [Curve(0.9, None, "no_vf"), *product(["trust_region"], [0.9, 1.0], [0.0, 0.5, 1.0])]
CELLS = cells_of(["CartPole-v1"], CURVES, range(5), 4, {"vf_steps": 2})


def mean_return(cell: Cell, iteration: int) -> float:
    """Best at γ = 1, λ = 0.5."""
    of_lambda = 0.8 if cell.gae_lambda is None else (cell.gae_lambda - 0.5) ** 2
    return 100.0 + iteration * (10.0 * cell.gamma - of_lambda) + np.sin(cell.seed + iteration)


def fill(study: SweepStudy, cells: list[Cell]) -> None:
    """As if they had been run: the curve in two pieces, the middle of it without an episode that ended."""
    study.enqueue(cells)
    while (claim := study.claim(cells)) is not None:
        rows = [dict.fromkeys(COLUMNS, float("nan")) for _ in range(claim.cell.iterations)]
        for iteration, row in enumerate(rows, 1):
            row |= {"iteration": iteration, "timesteps": 10 * iteration, "episodes": 3, "seconds": 0.1 + 0.2}
            row["mean_return"] = float("nan") if iteration == 2 else mean_return(claim.cell, iteration)
        claim.describe(
            settings={"policy": "MlpPolicy"}, provenance=provenance() | {"commit": "12345678e90"}, setup_seconds=0.5
        )
        claim.append(rows[:1])
        claim.append(rows[1:])
        claim.complete(rows[-1]["mean_return"])


@pytest.fixture(scope="module")
def table(tmp_path_factory: pytest.TempPathFactory) -> pd.DataFrame:
    study = SweepStudy("s", str(tmp_path_factory.mktemp("sweep") / "s.journal"))
    fill(study, CELLS)
    return results_of(study)


def test_there_is_a_row_for_each_seed_and_iteration(table: pd.DataFrame) -> None:
    assert len(table) == len(CELLS) * 4
    row = table[(table["gamma"] == 1.0) & (table["gae_lambda"] == 0.5) & (table["seed"] == 3)].iloc[2]
    assert row["mean_return"] == mean_return(Cell("CartPole-v1", "trust_region", 1.0, 0.5, 3, 4), 3)
    assert (row["iteration"], row["timesteps"], row["overrides"]) == (3, 30, '{"vf_steps": 2}')
    assert (row["commit"], row["settings"], row["setup_seconds"]) == ("12345678e90", '{"policy": "MlpPolicy"}', 0.5)
    assert row["numpy"] == np.__version__


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_exported_files_come_back_as_they_were(table: pd.DataFrame, suffix: str, tmp_path: Path) -> None:
    if suffix == ".parquet":
        pytest.importorskip("pyarrow")
    path = export(table, tmp_path / "folder" / f"results{suffix}")
    pd.testing.assert_frame_equal(read_results(path), table)
    export(table, path)
    assert [found.name for found in path.parent.iterdir()] == [path.name], "nothing else is left there"


def test_a_file_that_holds_more_or_something_else_is_not_replaced(table: pd.DataFrame, tmp_path: Path) -> None:
    path = export(table, tmp_path / "results.csv")
    before = path.read_bytes()
    with pytest.raises(SweepError, match="holds 4 rows that are not in the storage; name another file"):
        export(table[table["trial"] > 0], path)
    with pytest.raises(SweepError, match="holds the sweep 's'; name another file"):
        export(table.assign(sweep="other"), path)
    assert path.read_bytes() == before
    (tmp_path / "letter.csv").write_text("Dear Sir,\n")
    with pytest.raises(SweepError, match="exists and is not replaced"):
        export(table, tmp_path / "letter.csv")
    assert (tmp_path / "letter.csv").read_text() == "Dear Sir,\n"


def test_more_results_replace_fewer(table: pd.DataFrame, tmp_path: Path) -> None:
    path = export(table[table["seed"] < 2], tmp_path / "results.csv")
    export(table, path)
    pd.testing.assert_frame_equal(read_results(path), table)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "There is no results file"),
        ("a,b\n1,2\n", "is not a results file of a sweep"),
        ("", "cannot be read as a results file"),
        ("format,sweep\n7,s\n", "is of format 7, and this sb3-gae knows 1; export it anew"),
        ("format,sweep\n1,s\n", "lacks the columns task, condition"),
    ],
)
def test_other_files_are_refused(content: str | None, message: str, tmp_path: Path) -> None:
    if content is not None:
        (tmp_path / "results.csv").write_text(content)
    with pytest.raises(SweepError) as error:
        read_results(tmp_path / "results.csv")
    assert message in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize("suffix", [".csv", ".csv.gz"])
def test_a_file_that_was_cut_off_is_told_in_one_line(table: pd.DataFrame, suffix: str, tmp_path: Path) -> None:
    path = export(table, tmp_path / f"results{suffix}")
    content = path.read_bytes()
    end = content.index(b"trust_region", len(content) // 2) if suffix == ".csv" else len(content) // 2
    path.write_bytes(content[:end])
    with pytest.raises(SweepError, match=r"results\S+ cannot be read as a results file \(.+\)\.$"):
        read_results(path)


def test_what_cannot_be_exported(table: pd.DataFrame, tmp_path: Path) -> None:
    with pytest.raises(SweepError, match=r"must end in \.csv, \.csv\.gz, \.parquet"):
        export(table, tmp_path / "results.xlsx")
    with pytest.raises(SweepError, match="nothing to export"):
        export(table[:0], tmp_path / "results.csv")
    (tmp_path / "file").touch()
    with pytest.raises(SweepError, match="cannot be written"):
        export(table, tmp_path / "file" / "results.csv")


def test_interquartile_mean_is_that_of_rliable_and_of_its_definition() -> None:
    values = np.random.default_rng(0).normal(size=(21, 6)) ** 3
    direct = np.sort(values, axis=0)[5:16].mean(axis=0)
    np.testing.assert_allclose(interquartile_mean(values), direct)
    np.testing.assert_allclose(interquartile_mean(values), [metrics.aggregate_iqm(column[:, None]) for column in values.T])
    np.testing.assert_allclose(estimate(values).iqm, direct)


def test_intervals_are_those_of_a_bootstrap_over_seeds() -> None:
    values = np.random.default_rng(1).normal(size=(12, 1))
    result = estimate(values, resamples=4_000)
    draws = np.random.default_rng(2).integers(0, 12, (4_000, 12))
    direct = np.percentile(interquartile_mean(values[draws, 0].T), [2.5, 97.5])
    np.testing.assert_allclose([result.low[0], result.high[0]], direct, atol=0.05)
    state = np.random.get_state()[1].copy()  # type: ignore[union-attr]
    again = estimate(values, resamples=4_000)
    assert again == result, "the same numbers at each call"
    np.testing.assert_array_equal(np.random.get_state()[1], state)
    single = estimate(values[:1], resamples=10)
    assert single.low == single.iqm == single.high == values[0]


def test_estimates_of_several_sizes_keep_their_places() -> None:
    samples = [np.full(4, 1.0), np.full(2, 2.0), np.full(4, 3.0)]
    results = estimate_each(samples)
    assert [float(result.iqm[0]) for result in results] == [1.0, 2.0, 3.0]
    assert [result.low.shape for result in results] == [(1,)] * 3


def test_series_are_in_order_and_bridge_iterations_without_an_episode(table: pd.DataFrame) -> None:
    series = series_of(table)
    assert [one.curve for one in series[:3]] == [Curve(0.9, None, "no_vf"), Curve(0.9, 1.0), Curve(0.9, 0.5)]
    assert series[0].returns.shape == (5, 4)
    np.testing.assert_array_equal(series[0].returns[:, 1], series[0].returns[:, 0])


def texts(figure: Figure) -> str:
    return "\n".join(found.get_text() for found in figure.findobj(lambda artist: hasattr(artist, "get_text")))  # type: ignore[attr-defined]


def test_curves_have_a_band_and_a_legend(table: pd.DataFrame) -> None:
    figure = curves_figure(table)
    (axes,) = figure.axes
    assert len(axes.lines) == len(axes.collections) == len(CURVES)
    wanted = series_of(table)[2].returns
    np.testing.assert_allclose(axes.lines[2].get_ydata(), estimate(wanted).iqm)
    shown = texts(figure)
    assert all(text in shown for text in ("γ = 0.9, λ = 0.5", "no value function", "5 seeds", "iteration (batch)"))


def test_few_runs_have_a_mean(table: pd.DataFrame) -> None:
    chosen = select(table, gammas=[0.9])
    for count, shown in ((4, "IQM over 4 seeds"), (3, "mean over 3 seeds"), (1, "mean over 1 seed,")):
        some = chosen[chosen["seed"] < count]
        assert shown in texts(curves_figure(some)) and shown in texts(lambda_figure(some))
    assert "(mean)" in texts(heatmap_figure(chosen[chosen["seed"] < 3])) and "(IQM)" in texts(heatmap_figure(chosen))
    mixed = chosen[(chosen["seed"] < 3) | (chosen["gae_lambda"] == 0.5)]
    assert "IQM over 3 to 5 seeds (of fewer than 4 the mean)" in texts(curves_figure(mixed))


def test_curves_say_where_episodes_ended_if_that_is_rare(table: pd.DataFrame) -> None:
    chosen = select(table, gammas=[0.9], lambdas=[0.5], conditions=["trust_region"])
    figure = curves_figure(chosen)  # in three iterations of four
    assert figure.axes[0].lines[0].get_marker() == "None" and "dots" not in texts(figure)
    rare = chosen.assign(mean_return=chosen["mean_return"].where(chosen["iteration"] == 3))
    figure = curves_figure(rare)
    (line,) = figure.axes[0].lines
    assert line.get_marker() == "o" and "dots: episodes ended" in texts(figure)
    marked = np.asarray(line.get_xdata())[line.get_markevery()]  # type: ignore[index]
    assert marked.tolist() == [3]


def test_heatmap_frames_the_best_cell(table: pd.DataFrame) -> None:
    figure = heatmap_figure(select(table, conditions=["trust_region"]))
    axes = figure.axes[0]
    (frame,) = axes.patches
    assert (frame.get_x(), frame.get_y()) == (1, 1)  # type: ignore[attr-defined]
    shown = texts(figure)
    assert "best (framed): γ = 1, λ = 0.5: " in shown
    assert shown.count("n = 5") == 6
    values = axes.collections[0].get_array()
    expected = [series.returns[:, 3] for series in series_of(table) if series.curve == Curve(0.9, 0.0)]
    assert values is not None and np.ravel(values)[0] == pytest.approx(float(interquartile_mean(expected[0])))
    assert texts(heatmap_figure(table, iteration=1)).count("iteration 1 ") == 1


def test_lambda_curve_is_a_u(table: pd.DataFrame) -> None:
    figure = lambda_figure(select(table, gammas=[0.9]))
    lost = np.asarray(figure.axes[0].lines[0].get_ydata())
    assert lost[1] == 0.0 and lost[0] > 0.0 < lost[2]
    assert "no value function" in texts(figure)


@pytest.mark.parametrize("kind", ["curves", "heatmap", "lambda"])
def test_figures_are_the_same_bit_for_bit(kind: str, table: pd.DataFrame, tmp_path: Path) -> None:
    chosen = table[table["gamma"] == 0.9]
    first, second = (draw(kind, chosen, tmp_path / name) for name in ("a.b", "c"))
    assert [path.name for path in first] == ["a.b.png", "a.b.svg"]
    for one, other in zip(first, second, strict=True):
        assert one.read_bytes() == other.read_bytes()
    assert first[0].read_bytes().startswith(b"\x89PNG")
    assert [path.name for path in draw(kind, chosen, tmp_path / "only.svg")] == ["only.svg"]


@pytest.mark.parametrize(
    ("kind", "arguments", "message"),
    [
        ("curves", {"gammas": [0.5]}, "no finished cell has gamma 0.5; there are 0.9, 1"),
        ("curves", {"tasks": ["Acrobot-v1"]}, "no finished cell has task Acrobot-v1; there are CartPole-v1"),
        ("curves", {"iterations": 9}, "no finished cell has iterations 9; there are 4"),
        ("heatmap", {"conditions": ["no_vf"]}, "one condition that has a λ, and the selection has none"),
        ("heatmap", {"iteration": 5}, "`iteration` must be from 1 to 4"),
        ("lambda", {}, "at one γ, and the selection has 0.9, 1"),
        ("lambda", {"gammas": [0.9], "lambdas": [0.5]}, "needs at least two λ"),
        ("curves", {"output": "out.pdf"}, "`output` must end in .png or .svg, or have no ending for both, got 'out.pdf'"),
        ("curves", {"output": "out.SVG"}, "`output` must end in .png or .svg"),
        ("pie", {}, "`figure` knows curves, heatmap, lambda"),
    ],
)
def test_empty_and_mixed_selections(
    kind: str, arguments: dict[str, Any], message: str, table: pd.DataFrame, tmp_path: Path
) -> None:
    with pytest.raises(SweepError) as error:
        draw(kind, table, tmp_path / arguments.pop("output", "figure"), **arguments)
    assert message in str(error.value) and "\n" not in str(error.value)
    assert not list(tmp_path.iterdir())


def test_a_lambda_that_no_cell_has_is_said_though_there_are_cells_without_one(table: pd.DataFrame) -> None:
    with pytest.raises(SweepError, match=r"no finished cell has gae_lambda 0\.25, 0\.75; there are 0, 0\.5, 1\.$"):
        select(table, lambdas=(value for value in (0.25, 0.75)))
    with pytest.raises(SweepError, match=r"no finished cell has gae_lambda 0\.5; there is none\.$"):
        select(table, conditions=["no_vf"], lambdas=[0.5])
    chosen = select(table, lambdas=iter([0.5]))
    assert set(chosen["condition"]) == {"trust_region", "no_vf"}
    assert set(chosen["gae_lambda"].dropna()) == {0.5}


def test_runs_of_different_lengths_are_not_mixed(table: pd.DataFrame, tmp_path: Path) -> None:
    both = pd.concat([table, table[table["iteration"] <= 2].assign(iterations=2)])
    with pytest.raises(SweepError, match=r"iterations differ \(2, 4\); choose one with --of-iterations"):
        draw("curves", both, tmp_path / "figure")
    assert len(select(both, iterations=4)) == len(table)
    with pytest.raises(SweepError, match="No cell has finished yet"):
        draw("curves", table[:0], tmp_path / "figure")


def test_rows_of_some_cells(table: pd.DataFrame) -> None:
    assert sorted(rows_of_cells(table, CELLS[:2])["trial"].unique()) == [0, 1]


# --- What is not finished ---


@pytest.fixture
def unfinished(tmp_path: Path) -> SweepStudy:
    """Cells that are done, failed, stopped and begun anew, lost, running and waiting."""
    study = SweepStudy("s", str(tmp_path / "s.journal"))
    cells = CELLS[:6]
    fill(study, cells[:1])
    study.enqueue(cells)
    for cell, outcome in zip(cells[1:4], (Outcome.FAILED, Outcome.STOPPED, Outcome.LOST), strict=True):
        claim = study.claim([cell])
        assert claim is not None
        claim.append([dict.fromkeys(COLUMNS, 1.0) | {"iteration": number} for number in (1.0, 2.0)])
        claim.give_up(outcome, "")
    study.enqueue(cells[2:3])
    claim = study.claim(cells[4:5])
    assert claim is not None
    claim.append([dict.fromkeys(COLUMNS, 1.0)])
    return study


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_what_is_not_finished_is_exported_if_asked_for(
    suffix: str, unfinished: SweepStudy, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    if suffix == ".parquet":
        pytest.importorskip("pyarrow")
    path = tmp_path / f"partial{suffix}"
    export_command = ["export", "--name", "s", "--storage", unfinished.location, "-o", str(path)]
    assert main([*export_command, "--partial"]) == 0
    assert "11 rows, 5 runs" in capsys.readouterr().out
    table = read_results(path, partial=True)
    pd.testing.assert_frame_equal(table, results_of(unfinished, partial=True))
    counts = {"done": 4, "failed": 2, "stopped": 2, "lost": 2, "running": 1}
    assert table["state"].value_counts().to_dict() == counts
    # All else takes the finished cell alone
    finished = results_of(unfinished)
    assert "state" not in finished and len(finished) == 4
    pd.testing.assert_frame_equal(read_results(path), finished)
    pd.testing.assert_frame_equal(select(table), finished)
    assert take_in(SweepStudy("other", str(tmp_path / "other.journal")), table) == 1
    # Nor is it lost
    said = refusal(*export_command, capsys=capsys)
    assert "has runs that are not finished, too; pass --partial, or name another file" in said
    assert main([*export_command, "--partial"]) == 0


# --- What does not go together ---


def write_runs(table: pd.DataFrame, path: Path) -> Path:
    """As an export, unless something is wrong with the table."""
    table.to_csv(path, index=False)
    return path


@pytest.fixture
def runs(table: pd.DataFrame) -> pd.DataFrame:
    """Three seeds of one curve."""
    return table[(table["gamma"] == 1.0) & (table["gae_lambda"] == 0.5) & (table["seed"] < 3)].reset_index(drop=True)


def refusal(*arguments: str, capsys: pytest.CaptureFixture[str]) -> str:
    assert main(arguments) == 2
    said = capsys.readouterr()
    assert said.out == "" and said.err.startswith("sb3_gae.sweep: ") and said.err.count("\n") == 1
    return said.err


@pytest.mark.parametrize("rows", [[0, 1, 2], [0, 1, 3], [1, 2, 3], [0, 1, 2, 2], [0, 1, 2, 3, 3]])
@pytest.mark.parametrize("command", ["rank --from {}", "figure curves --from {}", "import {} --name other"])
def test_runs_that_are_not_whole_are_refused(
    command: str,
    rows: list[int],
    runs: pd.DataFrame,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    places = [*range(4), *(4 + row for row in rows), *range(8, 12)]
    path = write_runs(runs.iloc[places], tmp_path / "cut.csv")
    said = refusal(*command.format(path).split(), capsys=capsys)
    assert "cut.csv does not have each iteration from 1 to 4 once of CartPole-v1, trust_region" in said
    assert "γ = 1, λ = 0.5, seed 1," in said
    assert not (tmp_path / "logs").exists()


def test_what_is_not_there_is_no_iteration_without_an_episode(runs: pd.DataFrame, tmp_path: Path) -> None:
    for wrong in (runs[:-1], pd.concat([runs, runs[:1]]), runs[runs["iteration"] != 2]):
        with pytest.raises(SweepError, match=r"Runs of trust_region, γ = 1, λ = 0.5 are not whole, or there twice"):
            series_of(wrong)
        with pytest.raises(SweepError, match="The table does not have each iteration"):
            take_in(SweepStudy("s", str(tmp_path / "s.journal")), wrong)
    assert series_of(runs[runs["iteration"] < 3])[0].returns.shape == (3, 2), "shorter runs are whole, too"


def test_unknown_conditions_are_refused(runs: pd.DataFrame, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = str(write_runs(runs.assign(condition="trust_regoin"), tmp_path / "other.csv"))
    for command in (["rank"], ["figure", "curves"]):
        said = refusal(*command, "--from", path, capsys=capsys)
        assert "other.csv has the condition 'trust_regoin'" in said and said.endswith("; did you mean 'trust_region'?\n")
    with pytest.raises(SweepError, match="`conditions` knows"):
        series_of(runs.assign(condition="trust_regoin"))


def test_a_run_that_is_in_several_files_counts_once(
    runs: pd.DataFrame, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files = [str(export(runs, tmp_path / f"s{suffix}")) for suffix in (".csv", ".csv.gz")]
    # The first seed was run again elsewhere, with the same results, beside others of its own
    again = runs[runs["seed"] == 0].assign(seconds=7.0, sweep="there", trial=0)
    own = runs[runs["seed"] > 0].assign(sweep="there", trial=runs["trial"] - 1)
    own["seed"] += 10
    files.append(str(export(pd.concat([again, own]), tmp_path / "there.csv")))
    assert main(["rank", "--from", files[0]]) == 0
    alone = capsys.readouterr().out
    assert main(["rank", "--from", files[0], files[0], files[1]]) == 0
    assert capsys.readouterr().out == alone
    assert main(["rank", "--from", *files]) == 0
    assert "| 1 | 0.5 | 5 |" in capsys.readouterr().out


def test_runs_of_two_machines_may_have_the_same_numbers(
    runs: pd.DataFrame, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files = [str(export(runs, tmp_path / "here.csv"))]
    files.append(str(export(runs.assign(seed=runs["seed"] + 10), tmp_path / "there.csv")))
    assert main(["import", *files, "--name", "both", "--storage", str(tmp_path / "both.journal")]) == 0
    assert "6 of 6 cells added" in capsys.readouterr().out
    assert len(results_of(SweepStudy("both", str(tmp_path / "both.journal")))) == 24


def test_runs_with_other_results_are_refused(runs: pd.DataFrame, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = [str(export(runs, tmp_path / "a.csv"))]
    other = runs.copy()
    other.loc[(other["seed"] == 1) & (other["iteration"] == 3), "mean_return"] += 1.0
    files.append(str(export(other, tmp_path / "b.csv")))
    said = refusal("rank", "--from", *files, capsys=capsys)
    assert "seed 1 of CartPole-v1, trust_region, γ = 1, λ = 0.5, 4 iterations is in both" in said
    assert "a.csv" in said and "b.csv with different results" in said
    # A task may be named after what else is in the message
    files = [str(export(one.assign(task="seed-v0"), tmp_path / f"{name}.csv")) for name, one in (("c", runs), ("d", other))]
    said = refusal("rank", "--from", *files, capsys=capsys)
    assert "seed 1 of seed-v0, trust_region, γ = 1, λ = 0.5, 4 iterations is in both" in said


def with_setting(table: pd.DataFrame, **settings: Any) -> pd.DataFrame:
    return table.assign(settings=json.dumps({"gae_lambda": 0.5, "policy": "MlpPolicy", "target_kl": 0.0035, **settings}))


def test_other_settings_are_not_one_curve(runs: pd.DataFrame, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = [str(export(with_setting(runs), tmp_path / "a.csv"))]
    more = runs.assign(seed=runs["seed"] + 3)
    files.append(str(export(with_setting(more, target_kl=0.5), tmp_path / "b.csv")))
    for command in (["rank"], ["figure", "curves", "-o", str(tmp_path / "curves")]):
        said = refusal(*command, "--from", *files, capsys=capsys)
        assert "Runs of CartPole-v1, trust_region have different settings (target_kl 0.0035 -> 0.5)" in said
    said = refusal("import", *files, "--name", "s", "--storage", str(tmp_path / "s.journal"), capsys=capsys)
    assert "(target_kl 0.0035 -> 0.5); import them into a sweep of another --name" in said
    # λ is of the grid, other versions and commits are no other settings, and unknown ones say nothing
    other = with_setting(more, gae_lambda=0.9).assign(commit="9", torch="9")
    unknown = runs.assign(seed=runs["seed"] + 6, settings="")
    files[1:] = [str(export(table, tmp_path / f"{number}.csv")) for number, table in enumerate((other, unknown))]
    assert main(["rank", "--from", *files]) == 0


def test_other_settings_are_not_taken_in(runs: pd.DataFrame, tmp_path: Path) -> None:
    study = SweepStudy("s", str(tmp_path / "s.journal"))
    others = with_setting(runs.assign(seed=runs["seed"] + 3), target_kl=0.5)
    assert take_in(study, with_setting(runs)) == 3
    with pytest.raises(SweepError, match=r"have different settings \(target_kl 0.0035 -> 0.5\)"):
        take_in(study, others)
    # Nor does what is run now differ from what was taken in; vf_steps is of the cells
    now = {"gae_lambda": 0.97, "policy": "MlpPolicy", "target_kl": 0.5, "vf_steps": 9}
    study = SweepStudy("t", str(tmp_path / "t.journal"))
    take_in(study, with_setting(runs, vf_steps=2))
    with pytest.raises(SweepError, match=r"other settings than the sweep \(target_kl 0.5 -> 0.0035\)"):
        study.check_settings({"CartPole-v1": now})
    study.check_settings({"CartPole-v1": now | {"target_kl": 0.0035}})
    # And what has begun takes in no others, though nothing is done yet
    study = SweepStudy("u", str(tmp_path / "u.journal"))
    study.check_settings({"CartPole-v1": now | {"target_kl": 0.0035}})
    with pytest.raises(SweepError, match=r"other settings than the sweep \(target_kl 0.0035 -> 0.5\)"):
        take_in(study, with_setting(runs, target_kl=0.5, vf_steps=2))
    assert study.trials() == []


# --- Back into a sweep ---


def test_exported_results_are_taken_in_and_nothing_is_run_again(table: pd.DataFrame, tmp_path: Path) -> None:
    path = export(table, tmp_path / "results.csv")
    study = SweepStudy("other", str(tmp_path / "other.journal"))
    study.enqueue(CELLS[:2])  # one of them waits here, one is done here already
    claim = study.claim(CELLS[:1])
    assert claim is not None
    claim.append([dict.fromkeys(COLUMNS, 1.0) | {"mean_return": 7.0}])
    claim.complete(7.0)
    read = read_results(path)
    assert take_in(study, read) == len(CELLS) - 1
    assert take_in(study, read) == 0

    study.enqueue(CELLS)
    assert study.claim(CELLS) is None
    assert all(standing.status == Status.DONE for standing in study.standings().values())
    results = results_of(SweepStudy("other", str(tmp_path / "other.journal"), create=False))
    columns = [name for name in COLUMNS_OF_TABLE if name not in ("sweep", "trial")]
    order = ["condition", "gamma", "gae_lambda", "seed", "iteration"]
    others = [frame[frame["seed"] > 0].sort_values(order)[columns].reset_index(drop=True) for frame in (results, table)]
    pd.testing.assert_frame_equal(*others)
    assert results[results["mean_return"] == 7.0]["seed"].tolist() == [CELLS[0].seed]


def test_runs_of_several_sweeps_are_kept_apart(table: pd.DataFrame, tmp_path: Path) -> None:
    second = table.assign(sweep="second", seed=table["seed"] + 10)
    study = SweepStudy("both", str(tmp_path / "both.journal"))
    assert take_in(study, pd.concat([table, second])) == 2 * len(CELLS)
    assert len(results_of(study)) == 2 * len(table)


def test_conditions_without_lambda_are_told_apart(table: pd.DataFrame) -> None:
    chosen = table[(table["condition"] == "no_vf") | (table["gae_lambda"] == 0.5)]
    both = pd.concat([chosen, chosen[chosen["condition"] == "no_vf"].assign(condition="measured_lambda")])
    lines = curves_figure(both).axes[0].lines
    assert len({(str(line.get_color()), str(line.get_linestyle()), line._unscaled_dash_pattern) for line in lines}) == 4  # type: ignore[attr-defined]
