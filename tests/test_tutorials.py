"""The tutorials, as a reader runs them."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

TUTORIALS = Path(__file__).parent.parent / "docs" / "tutorials"

#: files that each leaves
LEAVES = {
    "beside_trpo": [],
    "stop_and_continue": ["checkpoints"],
    "what_lambda_trades": ["what_lambda_trades.png"],
    "your_own_task": ["swing_up_lambda.png"],
}


def without_numbers(text: str) -> list[list[str]]:
    """:return: the words of each line, with the same mark for every number"""
    return [re.sub(r"-?\d[\d.]*(e[+-]\d+)?", " # ", line).split() for line in text.splitlines()]


def test_every_tutorial_is_tried() -> None:
    assert {path.stem for path in TUTORIALS.glob("*.py")} == set(LEAVES)


@pytest.mark.parametrize("name", LEAVES)
def test_a_tutorial_runs(name: str, tmp_path: Path) -> None:
    environment = {**os.environ, "MPLBACKEND": "Agg", "OMP_NUM_THREADS": "1", "PYTHONIOENCODING": "utf-8"}
    done = subprocess.run(
        [sys.executable, TUTORIALS / f"{name}.py"],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        encoding="utf-8",
    )
    assert done.returncode == 0, done.stderr
    shown = (TUTORIALS / f"{name}.txt").read_text(encoding="utf-8")
    assert without_numbers(done.stdout) == without_numbers(shown)
    assert all((tmp_path / file).exists() for file in LEAVES[name])
