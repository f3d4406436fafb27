"""Results of a sweep as files."""

from pathlib import Path

import pandas as pd
import pytest
from sweep_table import CELLS, fill, refusal

from sb3_gae.sweep import Selection, SweepError, SweepStudy, export, read_results, results_of
from sb3_gae.sweep.cli import main
from sb3_gae.sweep.export import SUFFIXES
from sb3_gae.sweep.ledger import Outcome
from sb3_gae.sweep.recorder import COLUMNS
from sb3_gae.sweep.take_in import take_in


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_exported_files_come_back_as_they_were(sweep_table: pd.DataFrame, suffix: str, tmp_path: Path) -> None:
    if suffix == ".parquet":
        pytest.importorskip("pyarrow")
    path = export(sweep_table, tmp_path / "folder" / f"results{suffix}")
    pd.testing.assert_frame_equal(read_results(path), sweep_table)
    export(sweep_table, path)
    assert [found.name for found in path.parent.iterdir()] == [path.name], "nothing else is left there"


def test_a_file_that_holds_more_or_something_else_is_not_replaced(sweep_table: pd.DataFrame, tmp_path: Path) -> None:
    path = export(sweep_table, tmp_path / "results.csv")
    before = path.read_bytes()
    with pytest.raises(SweepError, match="holds 4 rows that are not in the storage; name another file"):
        export(sweep_table[sweep_table["trial"] > 0], path)
    with pytest.raises(SweepError, match="holds the sweep 's'; name another file"):
        export(sweep_table.assign(sweep="other"), path)
    changed = sweep_table.assign(mean_return=sweep_table["mean_return"] + (sweep_table["trial"] == 1))
    with pytest.raises(SweepError, match="has other results than the storage for 1 of the runs that both have"):
        export(changed, path)
    assert path.read_bytes() == before
    export(sweep_table.assign(seconds=7.0), path)
    (tmp_path / "letter.csv").write_text("Dear Sir,\n")
    with pytest.raises(SweepError, match="exists and is not replaced"):
        export(sweep_table, tmp_path / "letter.csv")
    assert (tmp_path / "letter.csv").read_text() == "Dear Sir,\n"


def test_more_results_replace_fewer(sweep_table: pd.DataFrame, tmp_path: Path) -> None:
    path = export(sweep_table[sweep_table["seed"] < 2], tmp_path / "results.csv")
    export(sweep_table, path)
    pd.testing.assert_frame_equal(read_results(path), sweep_table)


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
def test_a_file_that_was_cut_off_is_told_in_one_line(sweep_table: pd.DataFrame, suffix: str, tmp_path: Path) -> None:
    path = export(sweep_table, tmp_path / f"results{suffix}")
    content = path.read_bytes()
    end = content.index(b"trust_region", len(content) // 2) if suffix == ".csv" else len(content) // 2
    path.write_bytes(content[:end])
    with pytest.raises(SweepError, match=r"results\S+ cannot be read as a results file \(.+\)\.$"):
        read_results(path)


def test_what_cannot_be_exported(sweep_table: pd.DataFrame, tmp_path: Path) -> None:
    with pytest.raises(SweepError, match=r"must end in \.csv, \.csv\.gz, \.parquet"):
        export(sweep_table, tmp_path / "results.xlsx")
    with pytest.raises(SweepError, match="nothing to export"):
        export(sweep_table[:0], tmp_path / "results.csv")
    (tmp_path / "file").touch()
    with pytest.raises(SweepError, match="cannot be written"):
        export(sweep_table, tmp_path / "file" / "results.csv")


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
    pd.testing.assert_frame_equal(Selection().of(table), finished)
    assert take_in(SweepStudy("other", str(tmp_path / "other.journal")), table) == 1
    # Nor is it lost
    said = refusal(*export_command, capsys=capsys)
    assert "has runs that are not finished, too; pass --partial, or name another file" in said
    assert main([*export_command, "--partial"]) == 0
