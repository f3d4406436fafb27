"""Results of several files, or of files that somebody changed, in one table, figure or sweep."""

import json
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from sweep_table import CELLS, refusal

from sb3_gae.sweep import SweepError, SweepStudy, export, read_results, results_of
from sb3_gae.sweep.cli import main
from sb3_gae.sweep.ledger import Status
from sb3_gae.sweep.recorder import COLUMNS
from sb3_gae.sweep.results import COLUMNS as COLUMNS_OF_TABLE
from sb3_gae.sweep.series import series_of
from sb3_gae.sweep.take_in import take_in


def write_runs(table: pd.DataFrame, path: Path) -> Path:
    """As an export, unless something is wrong with the table."""
    table.to_csv(path, index=False)
    return path


@pytest.fixture
def runs(sweep_table: pd.DataFrame) -> pd.DataFrame:
    """Three seeds of one curve."""
    curve = (sweep_table["gamma"] == 1.0) & (sweep_table["gae_lambda"] == 0.5)
    return sweep_table[curve & (sweep_table["seed"] < 3)].reset_index(drop=True)


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


def test_runs_with_other_results_may_be_left_out(
    sweep_table: pd.DataFrame, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files = [str(export(sweep_table, tmp_path / "a.csv"))]
    other = sweep_table.assign(mean_return=sweep_table["mean_return"] + (sweep_table["condition"] == "no_vf"))
    files.append(str(export(other, tmp_path / "b.csv")))
    assert main(["rank", "--from", files[0], "--conditions", "trust_region", "--lambdas", "0.5"]) == 0
    alone = capsys.readouterr().out
    assert main(["rank", "--from", *files, "--conditions", "trust_region", "--lambdas", "0.5"]) == 0
    assert capsys.readouterr().out == alone
    # It has no λ, and so is there with any
    assert "no_vf" in refusal("rank", "--from", *files, "--lambdas", "0.5", capsys=capsys)


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


def test_exported_results_are_taken_in_and_nothing_is_run_again(sweep_table: pd.DataFrame, tmp_path: Path) -> None:
    path = export(sweep_table, tmp_path / "results.csv")
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
    others = [frame[frame["seed"] > 0].sort_values(order)[columns].reset_index(drop=True) for frame in (results, sweep_table)]
    pd.testing.assert_frame_equal(*others)
    assert results[results["mean_return"] == 7.0]["seed"].tolist() == [CELLS[0].seed]


def test_runs_of_several_sweeps_are_kept_apart(sweep_table: pd.DataFrame, tmp_path: Path) -> None:
    second = sweep_table.assign(sweep="second", seed=sweep_table["seed"] + 10)
    study = SweepStudy("both", str(tmp_path / "both.journal"))
    assert take_in(study, pd.concat([sweep_table, second])) == 2 * len(CELLS)
    assert len(results_of(study)) == 2 * len(sweep_table)
