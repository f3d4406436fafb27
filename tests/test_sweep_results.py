"""The table of a sweep's results, and selections of it."""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from sweep_table import CELLS, mean_return

from sb3_gae.sweep import Cell, Curve, Selection, SweepError, draw
from sb3_gae.sweep.results import rows_of_cells
from sb3_gae.sweep.series import series_of


def test_there_is_a_row_for_each_seed_and_iteration(sweep_table: pd.DataFrame) -> None:
    assert len(sweep_table) == len(CELLS) * 4
    row = sweep_table[(sweep_table["gamma"] == 1.0) & (sweep_table["gae_lambda"] == 0.5) & (sweep_table["seed"] == 3)].iloc[2]
    assert row["mean_return"] == mean_return(Cell("CartPole-v1", "trust_region", 1.0, 0.5, 3, 4), 3)
    assert (row["iteration"], row["timesteps"], row["overrides"]) == (3, 30, '{"vf_steps": 2}')
    assert (row["commit"], row["settings"], row["setup_seconds"]) == ("12345678e90", '{"policy": "MlpPolicy"}', 0.5)
    assert row["numpy"] == np.__version__


def test_series_are_in_order_and_bridge_iterations_without_an_episode(sweep_table: pd.DataFrame) -> None:
    series = series_of(sweep_table)
    assert [one.curve for one in series[:3]] == [Curve(0.9, None, "no_vf"), Curve(0.9, 1.0), Curve(0.9, 0.5)]
    assert series[0].returns.shape == (5, 4)
    np.testing.assert_array_equal(series[0].returns[:, 1], series[0].returns[:, 0])


@pytest.mark.parametrize(
    ("kind", "arguments", "message"),
    [
        ("curves", {"selection": Selection(gammas=[0.5])}, "no finished cell has gamma 0.5; there are 0.9, 1"),
        (
            "curves",
            {"selection": Selection(tasks=["Acrobot-v1"])},
            "no finished cell has task Acrobot-v1; there are CartPole-v1",
        ),
        ("curves", {"selection": Selection(iterations=9)}, "no finished cell has iterations 9; there are 4"),
        ("heatmap", {"selection": Selection(conditions=["no_vf"])}, "one condition that has a λ, and the selection has none"),
        ("heatmap", {"iteration": 5}, "`iteration` must be from 1 to 4"),
        ("lambda", {}, "at one γ, and the selection has 0.9, 1"),
        ("lambda", {"selection": Selection(gammas=[0.9], lambdas=[0.5])}, "needs at least two λ"),
        ("curves", {"output": "out.pdf"}, "`output` must end in .png or .svg, or have no ending for both, got 'out.pdf'"),
        ("curves", {"output": "out.SVG"}, "`output` must end in .png or .svg"),
        ("pie", {}, "`figure` knows curves, heatmap, lambda"),
    ],
)
def test_empty_and_mixed_selections(
    kind: str, arguments: dict[str, Any], message: str, sweep_table: pd.DataFrame, tmp_path: Path
) -> None:
    with pytest.raises(SweepError) as error:
        draw(kind, sweep_table, tmp_path / arguments.pop("output", "figure"), **arguments)
    assert message in str(error.value) and "\n" not in str(error.value)
    assert not list(tmp_path.iterdir())


def test_a_lambda_that_no_cell_has_is_said_though_there_are_cells_without_one(sweep_table: pd.DataFrame) -> None:
    with pytest.raises(SweepError, match=r"no finished cell has gae_lambda 0\.25, 0\.75; there are 0, 0\.5, 1\.$"):
        Selection(lambdas=(value for value in (0.25, 0.75))).of(sweep_table)
    with pytest.raises(SweepError, match=r"no finished cell has gae_lambda 0\.5; there is none\.$"):
        Selection(conditions=["no_vf"], lambdas=[0.5]).of(sweep_table)
    chosen = Selection(lambdas=iter([0.5])).of(sweep_table)
    assert set(chosen["condition"]) == {"trust_region", "no_vf"}
    assert set(chosen["gae_lambda"].dropna()) == {0.5}


def test_runs_of_different_lengths_are_not_mixed(sweep_table: pd.DataFrame, tmp_path: Path) -> None:
    both = pd.concat([sweep_table, sweep_table[sweep_table["iteration"] <= 2].assign(iterations=2)])
    with pytest.raises(SweepError, match=r"iterations differ \(2, 4\); choose one with --of-iterations"):
        draw("curves", both, tmp_path / "figure")
    assert len(Selection(iterations=4).of(both)) == len(sweep_table)
    with pytest.raises(SweepError, match="No cell has finished yet"):
        draw("curves", sweep_table[:0], tmp_path / "figure")


def test_rows_of_some_cells(sweep_table: pd.DataFrame) -> None:
    assert sorted(rows_of_cells(sweep_table, CELLS[:2])["trial"].unique()) == [0, 1]
