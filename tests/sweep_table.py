"""Results of a sweep that nobody had to run."""

import numpy as np
import pytest

from sb3_gae.sweep import Cell, Curve, SweepStudy
from sb3_gae.sweep.cli import main
from sb3_gae.sweep.grid import cells_of, product
from sb3_gae.sweep.provenance import provenance
from sb3_gae.sweep.recorder import COLUMNS

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


def refusal(*arguments: str, capsys: pytest.CaptureFixture[str]) -> str:
    assert main(arguments) == 2
    said = capsys.readouterr()
    assert said.out == "" and said.err.startswith("sb3_gae.sweep: ") and said.err.count("\n") == 1
    return said.err
