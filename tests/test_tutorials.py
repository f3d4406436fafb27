"""The tutorials, as a reader runs them."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

TUTORIALS = Path(__file__).parent.parent / "docs" / "tutorials"

#: a line that each prints, and files that it leaves
ENDINGS = {
    "beside_trpo": ("TRPOGAE", []),
    "stop_and_continue": ("the same, bit for bit: True", ["checkpoints"]),
    "what_lambda_trades": ("smallest sum: λ = ", ["what_lambda_trades.png"]),
    "your_own_task": ("gae_lambda", ["swing_up_lambda.png"]),
}


def test_every_tutorial_is_tried() -> None:
    assert {path.stem for path in TUTORIALS.glob("*.py")} == set(ENDINGS)


@pytest.mark.parametrize("name", ENDINGS)
def test_a_tutorial_runs(name: str, tmp_path: Path) -> None:
    line, files = ENDINGS[name]
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
    assert line in done.stdout
    assert all((tmp_path / file).exists() for file in files)
