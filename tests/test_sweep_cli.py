"""``python -m sb3_gae.sweep``."""

import re
from pathlib import Path

import pandas as pd
import pytest

from sb3_gae.sweep.arguments import make_parser
from sb3_gae.sweep.cli import main

RUN = ["run", "--env", "CartPole-v1", "--lambdas", "0", "1", "--iterations", "2", "--no-progress"]
TINY = ["-params", "n_envs:1", "n_steps:32", "policy_kwargs:dict(net_arch=[4])"]


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_from_a_dry_run_to_figures(capsys: pytest.CaptureFixture[str]) -> None:
    grid = [*RUN, "--gammas", ".9", "--seeds", "2", "--name", "s", *TINY]
    assert main([*grid, "--dry-run"]) == 0
    said = capsys.readouterr().out
    assert "4 cells, 0 done, 4 left" in said
    assert re.search(r"CartPole-v1: 4 cells with 8 iterations left\n  about [\d.]+ s in 1 job\(s\), from an iteration", said)
    assert not list(Path().iterdir()), "a dry run makes no files"

    assert main(grid) == 0
    assert "4 cells, 4 done, 0 left" in capsys.readouterr().out
    assert main(["status", "--name", "s"]) == 0
    assert "2/2 CartPole-v1, trust_region, γ = 0.9, λ = 1, 2 iterations" in capsys.readouterr().out
    assert main([*grid, "--seeds", "3", "--dry-run"]) == 0
    assert "from 4 cells that are done" in capsys.readouterr().out

    assert main(["export", "--name", "s", "-o", "results.csv"]) == 0
    assert main(["figure", "lambda", "--from", "results.csv"]) == 0
    assert main(["figure", "curves", "--name", "s", "-o", "figures/curves.svg"]) == 0
    assert Path("logs/sweeps/results_lambda.png").exists() and Path("figures/curves.svg").exists()
    capsys.readouterr()
    assert main(["rank", "--from", "results.csv", "--lambdas", "1", "--by", "last"]) == 0
    said, warned = capsys.readouterr()
    assert "| value function by trust region | 0.9 | 1 | 2 |" in said and "narrow" not in said
    assert warned == "With fewer than 5 seeds the intervals are too narrow to tell chance.\n"


def test_results_of_several_sweeps_go_into_one_table(capsys: pytest.CaptureFixture[str]) -> None:
    for name, condition in (("fixed", "trust_region"), ("auto", "improvement_lambda")):
        assert main([*RUN, "--gammas", ".9", "--seeds", "1", "--name", name, "--conditions", condition, *TINY]) == 0
        assert main(["export", "--name", name, "-o", f"{name}.csv"]) == 0
    capsys.readouterr()
    assert main(["rank", "--from", "fixed.csv", "auto.csv"]) == 0
    said = capsys.readouterr().out
    assert (
        "| value function by trust region | 0.9 | 1 | 1 |" in said and "| λ by the measured improvement | 0.9 |  | 1 |" in said
    )


def test_a_dry_run_counts_imported_cells_that_do_not_say_how_long_they_took_to_begin(
    capsys: pytest.CaptureFixture[str],
) -> None:
    grid = [*RUN, "--gammas", ".9", "--name", "s", *TINY]
    assert main([*grid, "--seeds", "1"]) == 0 and main(["export", "--name", "s", "-o", "s.csv"]) == 0
    pd.read_csv("s.csv").assign(setup_seconds=None).to_csv("s.csv", index=False)
    assert main(["import", "s.csv", "--name", "t"]) == 0
    capsys.readouterr()
    assert main([*grid, "--seeds", "2", "--name", "t", "--dry-run"]) == 0
    assert "from 2 cells that are done" in capsys.readouterr().out


def test_cells_that_fail_are_told(capsys: pytest.CaptureFixture[str]) -> None:
    grid = [*RUN, "--gammas", ".9", "--seeds", "1", "-params", "n_envs:1", "n_steps:1"]
    assert main(grid) == 1
    said = capsys.readouterr().out
    assert "failed: CartPole-v1, trust_region, γ = 0.9, λ = 0, seed 0, 2 iterations: ValueError: A batch needs" in said
    assert "--retry-failed; see their tracebacks with status --tracebacks" in said and "Traceback" not in said
    assert main(["status", "--name", "CartPole-v1"]) == 0
    assert "Traceback" not in capsys.readouterr().out
    assert main(["status", "--name", "CartPole-v1", "--tracebacks"]) == 0
    said = capsys.readouterr().out
    assert said.count("Traceback (most recent call last):") == 2 and "in setup_experiment" in said


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([*RUN, "--gammas", "1.5", "--seeds", "1"], "`gamma` must be a number in [0, 1], got 1.5"),
        ([*RUN, "--gammas", "1", "--seeds", "1", "--env", "CartPol-v1"], "did you mean 'CartPole-v1'?"),
        ([*RUN, "--gammas", "1"], "`seeds` is missing"),
        ([*RUN, "--gammas", "1", "--seeds", "-1"], "`seeds` must be a whole number of at least 1, got -1"),
        ([*RUN, "--gammas", "1", "--seeds", "1", "--jobs", "0"], "`jobs` must be a whole number of at least 1, got 0"),
        ([*RUN, "--gammas", "1", "--seeds", "1", "--dry-run", "--jobs", "0"], "`jobs` must be a whole number"),
        ([*RUN, "--gammas", "1", "--seeds", "1", "--threads", "0"], "`threads` must be a whole number of at least 1"),
        ([*RUN, "--gammas", "1", "--seeds", "1", "--device", "foo"], "`device`: PyTorch cannot use 'foo' here"),
        ([*RUN, "--gammas", "1", "--seeds", "1", "--device", "cpu:x"], "`device`: PyTorch cannot use 'cpu:x' here"),
        ([*RUN, "--gammas", "1", "--seeds", "1", "-params", "vf_steps:foo"], "`-params vf_steps` must be a value in Python"),
        ([*RUN, "--gammas", "1", "--seeds", "1", "-params", "vf_steps"], "written as name:value, got 'vf_steps'"),
        ([*RUN, "--gammas", "1", "--seeds", "1", "-params", "vf_steps:"], "written as name:value, got 'vf_steps:'"),
        (["run", "--env", "CartPole-v1", "--gammas", "1", "--seeds", "1", "--iterations", "1"], "`lambdas` is missing"),
        (["run", "--preset", "small", "--iterations", "0"], "`iterations` must be a whole number of at least 1, got 0"),
        (
            [*RUN, "--gammas", "1", "--seeds", "1", "--first-seed", "5000000000"],
            "`seeds` must be a number in [0, 4.29497e+09]",
        ),
        ([*RUN, "--gammas", "1", "--seeds", "1", "--dry-run", "-params", "n_steps:0"], "cannot be run: `n_steps` must be"),
        (["status", "--preset", "nopreset"], "`preset` knows fig2-left, "),
        (["status", "--name", "s", "--storage", "sqlite:///s.db"], "There is no sweep at sqlite:///s.db"),
        ([*RUN, "--gammas", "1", "--first-seed", "4"], "`first-seed` needs --seeds"),
        ([*RUN, "--gammas", "1", "--seeds", "1", "--storage", "file/x.journal"], "cannot be reached"),
        ([*RUN, "--gammas", "1", "--seeds", "1", "--conditions", "none"], "`conditions` knows"),
        (["run", "--preset", "fig2"], "`preset` knows"),
        (["status"], "Which sweep?"),
        (["import", "nothing.csv", "--name", "s"], "There is no results file nothing.csv"),
        (["status", "--preset", "small"], "There is no sweep at logs/sweeps/small.journal"),
        (["figure", "curves", "--from", "nothing.csv"], "There is no results file nothing.csv"),
        (["figure", "curves", "--from", "nothing.csv", "--name", "s"], "leave out --storage, --name and --preset"),
    ],
)
def test_errors_are_one_line(arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    Path("file").touch()
    assert main(arguments) == 2
    said = capsys.readouterr().err
    assert message in said and said.startswith("sb3_gae.sweep: ") and said.count("\n") == 1
    assert [path.name for path in Path().iterdir()] == ["file"]


def test_params_of_several_kinds_are_read() -> None:
    args = make_parser().parse_args([*RUN, "-params", "vf_steps:3", "name:'a:b'", "policy_kwargs:dict(a=[1])"])
    assert args.hyperparams == {"vf_steps": 3, "name": "a:b", "policy_kwargs": {"a": [1]}}


def test_a_package_that_fails_is_told_in_one_line(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "half_done.py").write_text("raise RuntimeError('not\\nyet')")
    monkeypatch.syspath_prepend(str(folder))
    assert main([*RUN, "--gammas", "1", "--seeds", "1", "--gym-packages", "half_done"]) == 2
    said = capsys.readouterr().err
    assert "`gym_packages`: half_done fails when it is imported (RuntimeError: not yet); mend it first." in said
    assert said.count("\n") == 1 and not Path("logs").exists()


def test_a_dry_run_makes_no_database(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    grid = [*RUN, "--gammas", "1", "--seeds", "1", "--storage", "sqlite:///s.db", *TINY, "--dry-run"]
    assert main(grid) == 0
    assert "2 cells, 0 done, 2 left" in capsys.readouterr().out
    assert not list(folder.iterdir())


def test_help_names_presets_and_conditions(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="0"):
        main(["--help"])
    assert "fig2-left" in capsys.readouterr().out
    with pytest.raises(SystemExit, match="0"):
        main(["run", "--help"])
    assert "no_vf" in capsys.readouterr().out
