"""The robot's part of the page: one recorded rollout, γ and λ."""

import numpy as np
from nicegui import events, ui

from sb3_gae.diagnostics.rollout_file import MAX_BYTES, load_rollout
from sb3_gae.lab.page.pace import Pace
from sb3_gae.lab.page.widgets import Knob, panel, picture
from sb3_gae.lab.pictures import Axes, Band, Line, bar_chart, line_chart, round_up
from sb3_gae.lab.rollout_view import RolloutViewer, View


class RolloutPanel:
    """
    Builds itself into the page at hand.

    :param viewer: of the rollout to begin with
    """

    def __init__(self, viewer: RolloutViewer):
        self._viewer, self._trajectory = viewer, 0
        self._gamma, self._gae_lambda = viewer.rollout.gamma, viewer.rollout.gae_lambda
        with ui.element("div").classes("columns"):
            with ui.element("div").classes("stack"):
                self._build_controls()
                self._build_advantages()
            with ui.element("div").classes("stack"):
                self._build_statistics()
        self._pace = Pace(self.refresh, self._settle)
        self.refresh()

    def refresh(self) -> None:
        """Show the rollout with the factors as they are."""
        view = self._viewer.view(self._gamma, self._gae_lambda)
        rollout = self._viewer.rollout
        self._name.text = (
            f"{rollout.name}: {int(rollout.mask.sum())} steps in {self._viewer.n_trajectories} trajectories, "
            f"collected with γ = {rollout.gamma:g} and λ = {rollout.gae_lambda:g}"
        )
        self._trajectory_knob.set_high(self._viewer.n_trajectories)
        self._trajectory_knob.show(self._trajectory + 1)
        self._gamma_knob.show(self._gamma)
        self._lambda_knob.show(self._gae_lambda)
        self._advantages.content = advantage_chart(view, self._viewer.steps(self._trajectory))
        self._trade_off.content = trade_off_chart(view)
        self._response.content = response_chart(*self._viewer.response(self._gamma), self._gamma * self._gae_lambda)
        self._summary.text = summary(view)

    def _build_controls(self) -> None:
        with panel("The rollout"), ui.element("div").classes("stack"):
            self._name = ui.label("")
            self._name.props["data-test"] = "rollout-name"
            self._lambda_knob = Knob("λ", 0.0, 1.0, 0.005, self._gae_lambda, self._turn_lambda, "rollout_lambda")
            self._gamma_knob = Knob("γ", 0.8, 1.0, 0.005, self._gamma, self._turn_gamma, "rollout_gamma")
            self._trajectory_knob = Knob("trajectory", 1, 2, 1, 1, self._choose, "trajectory")
            self._upload = ui.upload(
                label="Load a rollout (.npz)", auto_upload=True, max_file_size=MAX_BYTES, max_files=1, on_upload=self._load,
                on_rejected=lambda: ui.notify(f"Refused: not one file of at most {MAX_BYTES // 2**20} MiB.", type="negative"),
            )  # fmt: skip
            self._upload.props('accept=".npz" flat bordered data-test=upload').classes("w-full")
            ui.label("Files come from SaveRolloutCallback in training.").classes("faint")
            self._complaint = ui.label("").classes("light biased")
            self._complaint.props.update({"role": "alert", "data-test": "complaint"})
            self._complaint.style("white-space: normal")

    def _build_advantages(self) -> None:
        with panel("Advantages along the trajectory"):
            explanation = "Line: with the λ of the dial. Dashed: with λ = 1. Bars: residuals δ. In units of the reward."
            ui.label(explanation).classes("faint")
            self._advantages = picture("advantages")

    def _build_statistics(self) -> None:
        with panel("Bias and variance of the batch's policy gradient for each λ"):
            ui.label(
                "Clay, solid: bias², with a band of one standard error to either side. Slate, dashed: variance. Both in units "
                "of the variance at λ = 1. Dotted: the dial."
            ).classes("faint")
            self._trade_off = picture("trade-off")
            self._summary = ui.label("")
            self._summary.props["data-test"] = "rollout-summary"
        with panel("Response of the policy gradient by delay"):
            ui.label(
                "‖E[∇log π · x at l steps later]‖²: what remains of the response function χ(l) where states do not recur. "
                "Slate: rewards. Clay: residuals, which V has shaped. Curve: the weights (γλ)ˡ. Each in units of its largest; "
                "bars below zero are noise of the estimate."
            ).classes("faint")
            self._response = picture("response")

    def _settle(self) -> None:
        for knob in (self._trajectory_knob, self._gamma_knob, self._lambda_knob):
            knob.settle()

    def _turn_lambda(self, value: float) -> None:
        self._gae_lambda = float(value)
        self._pace.ask()

    def _turn_gamma(self, value: float) -> None:
        self._gamma = float(value)
        self._pace.ask()

    def _choose(self, value: float) -> None:
        self._trajectory = int(value) - 1
        self._pace.ask()

    async def _load(self, event: events.UploadEventArguments) -> None:
        try:
            if event.file.size() > MAX_BYTES:
                raise ValueError(f"The file must not exceed {MAX_BYTES // 2**20} MiB.")
            viewer = RolloutViewer(load_rollout(await event.file.read()))
        except ValueError as error:
            self._complaint.text = f"Refused: {error}"
            return
        finally:
            # Else it counts as the one file that may be loaded
            self._upload.reset()
        self._complaint.text = ""
        self._viewer, self._trajectory = viewer, 0
        self._gamma, self._gae_lambda = viewer.rollout.gamma, viewer.rollout.gae_lambda
        self.refresh()
        self._settle()


def advantage_chart(view: View, steps: tuple[np.ndarray, np.ndarray]) -> str:
    """
    :param view: of the rollout
    :param steps: of the trajectory, as indices
    :return: advantages with the chosen and the unbiased λ, over the residuals
    """
    curves = [array[steps] for array in (view.advantages, view.unbiased, view.deltas)]
    places, top = np.arange(len(curves[0])), round_up(max(float(np.abs(curve).max()) for curve in curves))
    axes = Axes("Advantages along the trajectory", (-0.5, len(places) - 0.5), (-top, top), x_label="step of the trajectory")
    lines = [Line(places, curves[1], "optimum"), Line(places, curves[0], "bias")]
    return bar_chart(axes, [curves[2]], ["delta"], lines)


def summary(view: View) -> str:
    """
    :param view: of the rollout
    :return: bias and variance at the chosen λ, and whether there is any bias to be seen
    """
    gae_lambda = view.lambdas[-1]
    (bias, bias_error), (variance, variance_error) = (
        (each.value[-1], each.standard_error[-1]) for each in (view.bias_squared, view.variance)
    )
    verdict = "more than two standard errors above zero"
    if gae_lambda == 1.0:
        verdict = "zero by definition, as λ = 1 is what the others are compared with"
    elif not bias > 2.0 * bias_error:
        verdict = "cannot be told from zero with this rollout"
    return (
        f"At λ = {gae_lambda:g}: bias² {bias:.3f} ± {bias_error:.3f}, {verdict}; "
        f"variance {variance:.3f} ± {variance_error:.3f}. Estimated from this rollout alone, with one standard error each."
    )


def trade_off_chart(view: View) -> str:
    """
    :param view: of the rollout
    :return: bias² and variance over the λ of the grid, the chosen one marked
    """
    order = np.argsort(view.lambdas, kind="stable")
    # λ between 0.9 and 1 is where things happen: places by the logarithm of the horizon
    places = -np.log(1.0 - 0.99 * view.lambdas) / np.log(100.0)
    value, error = (array[order] for array in view.bias_squared)
    label = "Bias squared and variance for each λ"
    value_and_error, variances = value + np.nan_to_num(error), view.variance.value[order]
    top = round_up(max(1.0, float(value_and_error.max()), float(variances.max())))
    axes = Axes(label, (0.0, 1.0), (0.0, top), x_label="λ from 0 to 1, places by log of the horizon")
    bias = Line(places[order], value, "bias")
    variance = Line(places[order], variances, "variance")
    error = np.nan_to_num(error)
    band = Band(places[order], value - error, value + error, "bias")
    return line_chart(axes, [bias, variance], [float(places[-1])], [band])


def response_chart(rewards: np.ndarray, shaped: np.ndarray, decay: float) -> str:
    """
    :param rewards: response of the rewards by delay
    :param shaped: response of the residuals
    :param decay: γλ
    :return: bars of both and the weights
    """
    n_lags = len(shaped)
    axes = Axes("Response by delay, of rewards and of residuals", (-0.5, n_lags - 0.5), (-1.0, 1.0), x_label="delay l")
    curve = Line(np.arange(n_lags), decay ** np.arange(n_lags), "weights")
    return bar_chart(axes, [rewards, shaped], ["delta", "weighted"], [curve])
