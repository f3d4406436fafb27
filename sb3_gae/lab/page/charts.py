"""What a run and an estimate look like: numbers to pictures and HTML."""

import numpy as np

from sb3_gae.gridworld import MOVE_NAMES
from sb3_gae.lab.estimator import Trace
from sb3_gae.lab.pictures import Axes, Line, bar_chart, line_chart, round_up
from sb3_gae.lab.readings import Reading

#: rows of the table of an episode
MAX_ROWS = 16


def return_chart(readings: list[Reading]) -> str:
    """
    :param readings: of the run so far
    :return: the return against the dashed optimum
    """
    steps, scores = _column(readings, "step"), _column(readings, "score")
    end = _end(steps)
    axes = Axes(
        f"Return over steps: now {scores[-1]:.0%} of the best possible, which is a dashed line", (0.0, end), (-1.0, 1.0),
        "{:.0%}".format,
    )  # fmt: skip
    return line_chart(axes, [Line(np.array([0.0, end]), np.ones(2), "optimum"), Line(steps, scores, "return")])


def bias_chart(readings: list[Reading]) -> str:
    """
    :param readings: of the run so far
    :return: angle of the bias
    """
    steps, angles = _column(readings, "step"), _column(readings, "bias_angle")
    top = round_up(max(0.5, float(np.nanmax(angles, initial=0.0))))
    axes = Axes(f"Bias over steps: now {angles[-1]:.2f} radians", (0.0, _end(steps)), (0.0, top))
    return line_chart(axes, [Line(steps, angles, "bias")])


def variance_chart(readings: list[Reading]) -> str:
    """
    :param readings: of the run so far
    :return: variance of the batch's gradient
    """
    steps, variances = _column(readings, "step"), _column(readings, "variance")
    top = round_up(max(0.05, float(variances.max())))
    axes = Axes(f"Variance over steps: now {variances[-1]:.3f}", (0.0, _end(steps)), (0.0, top))
    return line_chart(axes, [Line(steps, variances, "variance")])


def trace_chart(shown: Trace) -> str:
    """
    :param shown: one episode
    :return: its residuals, those weighted for one step, and the weights as a curve
    """
    n_steps, weighted = len(shown.deltas), np.zeros(len(shown.deltas))
    weighted[shown.start :] = shown.weights * shown.deltas[shown.start :]
    top = round_up(float(np.abs(shown.deltas).max()))
    axes = Axes(
        f"Residuals of an episode of {n_steps} steps, and their weights from step {shown.start} on",
        (-0.5, n_steps - 0.5), (-top, top), x_label="step of the episode",
    )  # fmt: skip
    curve = Line(np.arange(shown.start, n_steps), shown.weights * top, "weights")
    return bar_chart(axes, [shown.deltas, weighted], ["delta", "weighted"], [curve])


def trace_table(shown: Trace, cell_name: str) -> str:
    """
    :param shown: one episode
    :param cell_name: of the cell that the chosen step starts in
    :return: the sum written out, as HTML
    """
    start, rows = shown.start, []
    for lag, weight in enumerate(shown.weights[:MAX_ROWS]):
        step = start + lag
        rows.append(
            f"<tr><td>{step}</td><td>{MOVE_NAMES[shown.actions[step]]}</td><td>{shown.rewards[step]:+.0f}</td>"
            f"<td>{shown.deltas[step]:+.3f}</td><td>{weight:.3f}</td><td>{weight * shown.deltas[step]:+.3f}</td></tr>"
        )
    left_out = len(shown.weights) - MAX_ROWS
    rest = f'<p class="faint">and {left_out} more</p>' if left_out > 0 else ""
    return (
        f"<p>Step {start} in {cell_name}, move {MOVE_NAMES[shown.actions[start]]}: estimate Â = Σ (γλ)<sup>l</sup> δ = "
        f"<b>{shown.advantages[start]:+.3f}</b>, true advantage {shown.true_advantages[start]:+.3f}.</p>"
        "<table><thead><tr><th>step</th><th>move</th><th>r</th><th>δ</th><th>(γλ)<sup>l</sup></th><th>product</th></tr></thead>"
        f"<tbody>{''.join(rows)}</tbody></table>{rest}"
    )


def _column(readings: list[Reading], name: str) -> np.ndarray:
    return np.array([getattr(reading, name) for reading in readings], dtype=np.float64)


def _end(steps: np.ndarray) -> float:
    return max(20.0, float(steps[-1]))
