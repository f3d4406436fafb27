"""Figures of a sweep."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure
from sweep_table import CURVES

from sb3_gae.sweep import Curve, Selection, draw
from sb3_gae.sweep.figures.curves import curves_figure
from sb3_gae.sweep.figures.heatmap import heatmap_figure
from sb3_gae.sweep.figures.lambda_curve import lambda_figure
from sb3_gae.sweep.series import series_of
from sb3_gae.sweep.statistics import estimate, interquartile_mean


def texts(figure: Figure) -> str:
    return "\n".join(found.get_text() for found in figure.findobj(lambda artist: hasattr(artist, "get_text")))  # type: ignore[attr-defined]


def test_curves_have_a_band_and_a_legend(sweep_table: pd.DataFrame) -> None:
    figure = curves_figure(sweep_table)
    (axes,) = figure.axes
    assert len(axes.lines) == len(axes.collections) == len(CURVES)
    wanted = series_of(sweep_table)[2].returns
    np.testing.assert_allclose(axes.lines[2].get_ydata(), estimate(wanted).iqm)
    shown = texts(figure)
    assert all(text in shown for text in ("γ = 0.9, λ = 0.5", "no value function", "5 seeds", "iteration (batch)"))


def test_few_runs_have_a_mean(sweep_table: pd.DataFrame) -> None:
    chosen = Selection(gammas=[0.9]).of(sweep_table)
    for count, shown in ((4, "IQM over 4 seeds"), (3, "mean over 3 seeds"), (1, "mean over 1 seed,")):
        some = chosen[chosen["seed"] < count]
        assert shown in texts(curves_figure(some)) and shown in texts(lambda_figure(some))
    assert "(mean)" in texts(heatmap_figure(chosen[chosen["seed"] < 3])) and "(IQM)" in texts(heatmap_figure(chosen))
    mixed = chosen[(chosen["seed"] < 3) | (chosen["gae_lambda"] == 0.5)]
    assert "IQM over 3 to 5 seeds (of fewer than 4 the mean)" in texts(curves_figure(mixed))


def test_curves_say_where_episodes_ended_if_that_is_rare(sweep_table: pd.DataFrame) -> None:
    chosen = Selection(gammas=[0.9], lambdas=[0.5], conditions=["trust_region"]).of(sweep_table)
    figure = curves_figure(chosen)  # in three iterations of four
    assert figure.axes[0].lines[0].get_marker() == "None" and "dots" not in texts(figure)
    rare = chosen.assign(mean_return=chosen["mean_return"].where(chosen["iteration"] == 3))
    figure = curves_figure(rare)
    (line,) = figure.axes[0].lines
    assert line.get_marker() == "o" and "dots: episodes ended" in texts(figure)
    marked = np.asarray(line.get_xdata())[line.get_markevery()]  # type: ignore[index]
    assert marked.tolist() == [3]


def test_heatmap_frames_the_best_cell(sweep_table: pd.DataFrame) -> None:
    figure = heatmap_figure(Selection(conditions=["trust_region"]).of(sweep_table))
    axes = figure.axes[0]
    (frame,) = axes.patches
    assert (frame.get_x(), frame.get_y()) == (1, 1)  # type: ignore[attr-defined]
    shown = texts(figure)
    assert "best (framed): γ = 1, λ = 0.5: " in shown
    assert shown.count("n = 5") == 6
    values = axes.collections[0].get_array()
    expected = [series.returns[:, 3] for series in series_of(sweep_table) if series.curve == Curve(0.9, 0.0)]
    assert values is not None and np.ravel(values)[0] == pytest.approx(float(interquartile_mean(expected[0])))
    assert texts(heatmap_figure(sweep_table, iteration=1)).count("iteration 1 ") == 1


def test_lambda_curve_is_a_u(sweep_table: pd.DataFrame) -> None:
    figure = lambda_figure(Selection(gammas=[0.9]).of(sweep_table))
    lost = np.asarray(figure.axes[0].lines[0].get_ydata())
    assert lost[1] == 0.0 and lost[0] > 0.0 < lost[2]
    assert "no value function" in texts(figure)


@pytest.mark.parametrize("kind", ["curves", "heatmap", "lambda"])
def test_figures_are_the_same_bit_for_bit(kind: str, sweep_table: pd.DataFrame, tmp_path: Path) -> None:
    chosen = sweep_table[sweep_table["gamma"] == 0.9]
    first, second = (draw(kind, chosen, tmp_path / name) for name in ("a.b", "c"))
    assert [path.name for path in first] == ["a.b.png", "a.b.svg"]
    for one, other in zip(first, second, strict=True):
        assert one.read_bytes() == other.read_bytes()
    assert first[0].read_bytes().startswith(b"\x89PNG")
    assert [path.name for path in draw(kind, chosen, tmp_path / "only.svg")] == ["only.svg"]


def test_conditions_without_lambda_are_told_apart(sweep_table: pd.DataFrame) -> None:
    chosen = sweep_table[(sweep_table["condition"] == "no_vf") | (sweep_table["gae_lambda"] == 0.5)]
    both = pd.concat([chosen, chosen[chosen["condition"] == "no_vf"].assign(condition="improvement_lambda")])
    lines = curves_figure(both).axes[0].lines
    assert len({(str(line.get_color()), str(line.get_linestyle()), line._unscaled_dash_pattern) for line in lines}) == 4  # type: ignore[attr-defined]
