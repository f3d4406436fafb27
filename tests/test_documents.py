"""What README and docs tell a user to type."""

import re
import shlex
import sys
from pathlib import Path

import gymnasium
import matplotlib
import pytest
from documented import COMMANDS, DOCUMENTS, ROOT

from sb3_gae.envs import TASKS
from sb3_gae.sweep.cli import main

BLOCKS = {
    f"{document.name}:{number}": code
    for document in DOCUMENTS
    for number, code in enumerate(re.findall(r"^```python\n(.*?)^```", document.read_text(), re.MULTILINE | re.DOTALL))
}
LINKS = [
    (document, link)
    for document in DOCUMENTS
    for link in re.findall(r'(?:\]\(|<img src=")(?!https?:)([^)#"]+)', document.read_text())
]


def test_documents_have_code_and_links() -> None:
    assert {name.split(":")[0] for name in BLOCKS} >= {"README.md", "tasks.md", "zoo.md"}
    assert LINKS


@pytest.mark.parametrize("name", BLOCKS)
def test_code_runs(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    # For a program that reads its command line
    monkeypatch.setattr(sys, "argv", [name, "--help"])
    known = {*gymnasium.registry, *TASKS}
    try:
        exec(compile(BLOCKS[name], name, "exec"), {"__name__": "__main__"})
    except SystemExit as end:
        assert end.code == 0
    finally:
        for task_id in set(gymnasium.registry) - known:
            del gymnasium.registry[task_id]


@pytest.mark.parametrize(("document", "link"), LINKS)
def test_links_lead_somewhere(document: Path, link: str) -> None:
    assert (document.parent / link).exists()


def test_tests_that_the_theory_names_are_there() -> None:
    named = re.findall(r"`tests/(\w+)\.py::(\w+)`", (ROOT / "docs" / "theory.md").read_text())
    assert len(named) > 20
    missing = [
        f"{file}::{test}"
        for file, test in named
        if not re.search(rf"^def {test}\(", (ROOT / "tests" / f"{file}.py").read_text(), re.MULTILINE)
    ]
    assert not missing


def ranks() -> list[tuple[str, str]]:
    """:return: folder and arguments of each command of the page that prints a table of a sweep's curves"""
    found, folder = [], "."
    for words in COMMANDS["paper-figures.md"]:
        if words[0] == "cd":
            folder = words[1]
        elif words[1:4] == ["-m", "sb3_gae.sweep", "rank"]:
            found.append((folder, shlex.join(words[3:])))
    return found


#: of which the page shows a figure, or the first lines, or what one line says
WITHOUT_TABLE = {
    "rank --by last --from benchmarks/results/sweeps/fig2-right.parquet",
    "rank --from lambda-auto-cart-pole.parquet fig2-left.parquet",
    "rank --from benchmarks/results/sweeps/lambda-rules-HalfCheetah-v5.parquet",
    "rank --from benchmarks/results/sweeps/lambda-rules-Hopper-v5.parquet",
    "rank --from lambda-auto-HalfCheetah-v5.parquet lambda-rules-HalfCheetah-v5.parquet --conditions trust_region",
}
TABLES = [(folder, command) for folder, command in ranks() if command not in WITHOUT_TABLE]


def test_there_are_tables_of_sweeps() -> None:
    assert len(TABLES) >= 14
    assert {command for _, command in ranks()} >= WITHOUT_TABLE


@pytest.mark.parametrize(("folder", "command"), TABLES)
def test_tables_of_sweeps_are_what_the_command_prints(
    folder: str, command: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(ROOT / folder)
    assert main(shlex.split(command)) == 0
    assert capsys.readouterr().out in (ROOT / "docs" / "paper-figures.md").read_text()


def figures() -> list[tuple[str, str, str]]:
    """:return: name of each picture of the page of sweeps, with the folder and the arguments of the command that draws it"""
    page = (ROOT / "docs" / "paper-figures.md").read_text().replace("\\\n", " ")
    found, waiting, folder = [], [], "."
    for image, fence, target, command in re.findall(
        r"\]\(images/(\w+)\.svg\)|^(```bash)$|^cd (.+)$|^python -m sb3_gae\.sweep (figure .+)$", page, re.MULTILINE
    ):
        if image:
            waiting.append(image)
        elif fence:
            folder = "."
        elif target:
            folder = target
        else:
            found.append((waiting.pop(0), folder, command))
    assert not waiting, f"no command draws {waiting}"
    return found


def test_there_are_figures_of_sweeps() -> None:
    assert len(figures()) >= 11


@pytest.mark.parametrize(("name", "folder", "command"), figures())
def test_figures_of_sweeps_are_what_the_command_draws(
    name: str, folder: str, command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    committed = (ROOT / "docs" / "images" / f"{name}.svg").read_text()
    if f"Matplotlib v{matplotlib.__version__}," not in committed:
        pytest.skip("another matplotlib, which may draw the same in other words")
    monkeypatch.chdir(ROOT / folder)
    drawn = tmp_path / "figure.svg"
    assert main([*shlex.split(command), "--output", str(drawn)]) == 0
    assert drawn.read_text() == committed
