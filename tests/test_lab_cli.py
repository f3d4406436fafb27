"""The command line of the dial, its pictures and its colours."""

import re
import socket
from pathlib import Path

import numpy as np
import pytest

from sb3_gae import lab
from sb3_gae.estimators.group_statistics import Estimate
from sb3_gae.lab import cli
from sb3_gae.lab.export import recorded_run
from sb3_gae.lab.pictures import Axes, Line, bar_chart, cell_arrows, favourite_move, line_chart, round_up
from sb3_gae.lab.presets import load_preset
from sb3_gae.lab.rollout_view import View


def test_a_port_in_use_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("nicegui", reason="the extra `lab` is needed")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert cli.main(["--port", str(port), "--no-browser"]) == 2
    complaint = capsys.readouterr().err
    assert f"127.0.0.1:{port}" in complaint and "in use" in complaint and "--port" in complaint


def test_it_listens_to_this_machine_alone_unless_told_otherwise(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    app = pytest.importorskip("sb3_gae.lab.page.app", reason="the extra `lab` is needed")
    served = []

    def serve(listening: socket.socket, *others: object) -> None:
        served.append(listening.getsockname()[0])
        listening.close()

    monkeypatch.setattr(app, "serve", serve)
    assert cli.main(["--port", "0", "--no-browser"]) == 0
    assert "only this machine" in capsys.readouterr().out
    assert cli.main(["--port", "0", "--no-browser", "--host", "0.0.0.0"]) == 0
    assert "others on the network" in capsys.readouterr().out
    assert served == ["127.0.0.1", "0.0.0.0"]


@pytest.mark.parametrize("content", [None, b"nonsense"])
def test_a_bad_rollout_is_refused(tmp_path: Path, content: bytes | None, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("nicegui", reason="the extra `lab` is needed")
    path = tmp_path / "rollout.npz"
    if content is not None:
        path.write_bytes(content)
    assert cli.main(["--rollout", str(path), "--no-browser"]) == 2
    assert str(path) in capsys.readouterr().err


def test_without_nicegui_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert cli.main(["--no-browser"]) == 2
    assert "sb3-gae[lab]" in capsys.readouterr().err


def test_pictures_hold_what_they_are_given() -> None:
    axes = Axes("a label", (0.0, 10.0), (0.0, 1.0))
    picture = line_chart(axes, [Line(np.arange(1000) / 100, np.append(np.full(999, 0.5), np.nan), "return")], marks=[3.0])
    assert 'aria-label="a label"' in picture and picture.count("<polyline") == 1 and "nan" not in picture
    bars = bar_chart(Axes("b", (-0.5, 2.5), (-1.0, 1.0)), [np.array([1.0, -1.0, 0.0])], ["delta"])
    assert bars.count('<path class="bar delta"') == 1 and bars.count("M") == 3
    assert [round_up(value) for value in (0.0, 0.03, 1.0, 7.0, np.inf)] == pytest.approx([1.0, 0.05, 1.0, 10.0, 1.0])
    probabilities = np.array([0.1, 0.7, 0.1, 0.1])
    assert favourite_move(probabilities) == "right" and cell_arrows(probabilities).count("arrow favourite") == 1


def test_a_recorded_run_cannot_be_broken_out_of() -> None:
    simulation = load_preset("sweet_spot")
    simulation._log("</script><script>alert(1)</script>")
    page = recorded_run(simulation, "<b>")
    assert "alert(1)" in page and page.count("</script>") == 2 and "<b>" not in page
    assert "http" not in page.replace('http-equiv="Content', "")


STYLE = (Path(lab.__file__).parent / "style.css").read_text(encoding="utf-8")
THEMES = {
    name: dict(re.findall(r"--(\w+): (#\w{6})", block))
    for name, block in re.findall(r"\.body--(light|dark) \{(.*?)\}", STYLE, re.DOTALL)
}


def channels(colour: str) -> np.ndarray:
    return np.array([int(colour[place : place + 2], 16) / 255 for place in (1, 3, 5)])


def contrast(ink: np.ndarray, paper: np.ndarray) -> float:
    dark, bright = sorted((luminance(ink), luminance(paper)))
    return (bright + 0.05) / (dark + 0.05)


def luminance(channels: np.ndarray) -> float:
    linear = np.where(channels <= 0.04045, channels / 12.92, ((channels + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722])


@pytest.mark.parametrize("theme", ["light", "dark"])
def test_text_stands_out_from_what_is_behind_it(theme: str) -> None:
    colours = THEMES[theme]
    for ink in ("ink", "faint", "red", "amber", "green", "clay"):
        for paper in ("surface", "page") if ink != "clay" else ("surface",):
            assert contrast(channels(colours[ink]), channels(colours[paper])) >= 4.5, (ink, paper)


@pytest.mark.parametrize("theme", ["light", "dark"])
@pytest.mark.parametrize("tint", ["good", "bad"])
def test_cells_of_the_deepest_colour_can_be_read(theme: str, tint: str) -> None:
    deepest = pytest.importorskip("sb3_gae.lab.page.grid_panel", reason="the extra `lab` is needed").DEEPEST / 100
    colours = {name: channels(colour) for name, colour in THEMES[theme].items()}
    paper = deepest * colours[tint] + (1.0 - deepest) * colours["surface"]
    assert contrast(colours["ink"], paper) >= 4.5
    # Arrows are pictures, not text
    assert contrast(colours["clay"], paper) >= 3.0


def test_a_variance_above_that_of_lambda_1_stays_within_the_picture() -> None:
    panel = pytest.importorskip("sb3_gae.lab.page.rollout_panel", reason="the extra `lab` is needed")
    nothing, advantages = np.zeros(3), np.zeros((2, 1))
    variance = Estimate(np.array([0.1, 3.0, 1.0]), nothing)
    view = View(advantages, advantages, advantages, np.array([0.0, 0.5, 1.0]), Estimate(nothing, nothing), variance)
    (points,) = re.findall(r'class="line variance" points="([^"]+)"', panel.trade_off_chart(view))
    heights = [float(point.split(",")[1]) for point in points.split()]
    # From the last to the first, and downwards; the axis ends at 5
    np.testing.assert_allclose(np.diff(heights) / (heights[2] - heights[1]), [-2.0 / 2.9, 1.0], rtol=0.02)
