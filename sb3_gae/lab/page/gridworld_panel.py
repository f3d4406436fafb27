"""The gridworld's part of the page: one simulation for each tab of a browser, its knobs and what it shows."""

from collections.abc import Callable
from typing import Any

import numpy as np
from nicegui import ui

from sb3_gae.lab.controls import VALUE_FUNCTIONS
from sb3_gae.lab.estimator import trace
from sb3_gae.lab.export import recorded_run
from sb3_gae.lab.moment import Moment
from sb3_gae.lab.page.charts import bias_chart, return_chart, trace_chart, trace_table, variance_chart
from sb3_gae.lab.page.grid_panel import GridPanel, cell_name
from sb3_gae.lab.page.pace import Pace, until_shown
from sb3_gae.lab.page.widgets import Knob, choice, panel, picture, put
from sb3_gae.lab.presets import PRESETS, load_preset
from sb3_gae.lab.readings import STALL_STEPS, light

LIGHTS = {"unbiased": "●", "slight": "▲", "biased": "■"}
LIGHT_NAMES = {"unbiased": "unbiased", "slight": "slightly biased", "biased": "biased"}
ORDER_NAMES = {"policy_first": "policy step first (as in the paper)", "value_first": "value fit first"}
ABOUT = (
    "A softmax policy on a 5 by 5 gridworld with a goal worth +1 and a trap worth −1. Each step samples a batch of episodes, "
    "estimates the advantage at every visited step with GAE(γ, λ), the exponentially weighted sum of residuals, and takes one "
    "policy-gradient ascent step. Bias is the angle between the estimator's expected gradient and the true gradient, both "
    "computed exactly and on the side, only to score it: zero at λ = 1 for any value function, and growing as λ shrinks under "
    "a wrong one. One plain ascent step on a grid that can be solved stands in for the paper's trust-region update and neural "
    "networks. Each preset has a seed of its own, so it gives the same run every time; loading one resets it."
)
FASTEST, MAX_RUN = 20, 2_000


class GridworldPanel:
    """Builds itself into the page at hand, with the first preset loaded."""

    def __init__(self) -> None:
        self._preset = next(iter(PRESETS))
        self.simulation = load_preset(self._preset)
        self._episode = self._start = 0
        self._timer = ui.timer(0.2, self._tick, active=False)
        self._pace = Pace(self.refresh, self._settle)
        self._build_presets()
        self._build_run()
        with ui.element("div").classes("columns three"):
            with ui.element("div").classes("stack"):
                with panel("Return, in parts of the best possible (dashed)"):
                    self._returns = picture("returns")
                    self._hint = ui.label("").classes("faint")
                self._grid = GridPanel(self._moment)
            with ui.element("div").classes("stack"):
                self._build_knobs()
                with panel("Bias: angle between expected and true gradient, in radians (exact)"):
                    self._bias = picture("bias")
                with panel("Variance of the batch's gradient (exact)"):
                    self._variance = picture("variance")
            with ui.element("div").classes("stack wide"):
                self._build_estimator()
                self._build_log()
        with panel("What this is"):
            ui.label(ABOUT)
        self.refresh()

    def refresh(self) -> None:
        """Show the simulation as it is."""
        for name, knob in self._knobs.items():
            knob.show(getattr(self.simulation.controls, name))
        self._refresh_readings()
        self._grid.refresh()
        readings = self.simulation.readings
        self._returns.content, self._bias.content = return_chart(readings), bias_chart(readings)
        self._variance.content = variance_chart(readings)
        self._hint.text = "" if self.simulation.reading.step else "Run a few steps to draw the return and bias curves."
        events = [f"step {event.step}: {event.text}" for event in reversed(self.simulation.events)]
        self._log.content = "".join(f"<div>{text}</div>" for text in events) or (
            "Reach optimal or flip a control to start the log."
        )
        self._refresh_estimator()

    def _moment(self) -> Moment:
        return self.simulation.moment

    def _build_presets(self) -> None:
        with panel("Presets"):
            with ui.element("div").classes("beside"):
                self._preset_buttons = {
                    name: ui.button(preset.title, on_click=lambda name=name: self._load(name), color=None).props(
                        f"outline data-test=preset-{name}"
                    )
                    for name, preset in PRESETS.items()
                }
            self._story = ui.label("").classes("q-mt-sm")

    def _build_run(self) -> None:
        with panel("The run", titled=False) as run:
            run.classes("sticky")
            with ui.element("div").classes("beside"):
                self._play = ui.button("Play", icon="play_arrow", on_click=self._toggle, color=None)
                self._play.props("outline data-test=play")
                ui.button("Step", icon="skip_next", on_click=self._step_once, color=None).props("outline data-test=step")
                ui.button("Reset", icon="replay", on_click=self._reset, color=None).props("outline data-test=reset")
                with ui.element("div").classes("readings") as readings:
                    readings.props["data-test"] = "readings"
                    self._step_count, self._return, self._v = ui.label(), ui.label(), ui.label()
                    self._light, self._noise, self._status = (
                        ui.label().classes("light"),
                        ui.label(),
                        ui.label().classes("status"),
                    )
            self._light.props["data-test"], self._status.props["data-test"] = "light", "status"
            self._step_count.props["data-test"] = "step-count"

    def _build_log(self) -> None:
        with panel("Event log"):
            self._log = ui.html("", sanitize=False).classes("log")
            self._log.props.update({"role": "log", "aria-live": "polite", "tabindex": "0", "aria-label": "Event log"})
            self._log.props["data-test"] = "log"
            ui.button("Save the run as a page", icon="download", on_click=self._export, color=None).props(
                "outline data-test=export"
            ).classes("q-mt-sm")

    def _build_knobs(self) -> None:
        controls = self.simulation.controls
        with panel("Knobs"), ui.element("div").classes("stack"):
            self._knobs = {
                name: Knob(title, low, high, step, getattr(controls, name), self._turner(name), name)
                for name, title, low, high, step in (
                    ("gae_lambda", "λ, the dial", 0.0, 1.0, 0.01),
                    ("gamma", "γ, discount", 0.5, 1.0, 0.01),
                    ("batch_size", "batch, episodes a step", 1, 100, 1),
                    ("learning_rate", "learning rate", 0.5, 20.0, 0.5),
                )
            }
            self._speed_knob = Knob("speed, steps per second", 1, FASTEST, 1, 5, self._set_speed, "speed")
            kinds = {name: name for name in VALUE_FUNCTIONS}
            self._kind = choice("value function", kinds, "exact", self._turner("value_function"), "value_function")
            self._order = choice("order", ORDER_NAMES, "policy_first", self._turner("order"), "order")

    def _build_estimator(self) -> None:
        with panel("What the estimator is doing"):
            ui.label(
                "One sampled episode of the coming step. Slate: residuals δ. Clay: the same, weighted with (γλ)ˡ (the curve) "
                "and added up to the advantage of the chosen step."
            ).classes("faint")
            self._trace = picture("trace")
            self._episode_knob = Knob("episode of the batch", 1, 20, 1, 1, self._choose_episode, "episode")
            self._start_knob = Knob("step of the episode", 0, 20, 1, 0, self._choose_start, "start")
            self._share = ui.label("")
            self._sum = ui.html("", sanitize=False).classes("scrolls")
            self._sum.props.update({"tabindex": "0", "role": "region", "aria-label": "The sum of weighted residuals"})

    def _refresh_readings(self) -> None:
        reading, controls = self.simulation.reading, self.simulation.controls
        self._step_count.text = f"step {reading.step}"
        self._return.text = f"return {reading.score:.0%} of the best"
        self._v.text = f"{controls.value_function} V"
        shown = light(reading.bias_angle)
        self._light.text = f"{LIGHTS[shown]} bias: {LIGHT_NAMES[shown]} ({reading.bias_angle:.2f} rad)"
        self._light.classes(replace=f"light {shown}")
        self._noise.text = f"variance {reading.variance:.3f} (exact)"
        self._status.text = self.simulation.status
        recent = [each.share_of_gradient for each in self.simulation.readings[-STALL_STEPS:]]
        self._share.text = (
            f"Gradients of sampled batches have {np.mean(recent):.0%} of the true one (mean of the last {len(recent)}). "
            "Unbiased estimates have 100% on average."
        )
        self._story.text = PRESETS[self._preset].story
        for name, button in self._preset_buttons.items():
            button.classes(**{"add" if name == self._preset else "remove": "chosen"})
            put(button, aria_pressed="true" if name == self._preset else "false")

    def _refresh_estimator(self) -> None:
        shown = trace(self._moment(), self._episode, self._start)
        self._episode_knob.set_high(self.simulation.controls.batch_size)
        self._start_knob.set_high(len(shown.deltas) - 1)
        self._episode_knob.show(shown.episode + 1)
        self._start_knob.show(shown.start)
        self._trace.content = trace_chart(shown)
        self._sum.content = trace_table(shown, cell_name(int(shown.states[shown.start])))

    def _turner(self, name: str) -> Callable[[Any], None]:
        def turn(value: Any) -> None:
            try:
                self.simulation.change(**{name: int(value) if name == "batch_size" else value})
            except (TypeError, ValueError) as error:
                ui.notify(str(error), type="negative")
                return
            self._pace.ask()

        return turn

    def _load(self, name: str) -> None:
        self._pause()
        self._preset, self.simulation = name, load_preset(name)
        self._show_controls()

    def _reset(self) -> None:
        self._pause()
        self.simulation.reset()
        self._show_controls()

    def _show_controls(self) -> None:
        # What they report back are the values that the simulation has already
        controls = self.simulation.controls
        self._kind.value, self._order.value = controls.value_function, controls.order
        self.refresh()
        self._settle()

    def _settle(self) -> None:
        for knob in (*self._knobs.values(), self._speed_knob, self._episode_knob, self._start_knob):
            knob.settle()

    async def _tick(self) -> None:
        self._advance()
        # A browser that is slower than the speed asked for would fall behind without end; the next step waits for it
        try:
            await until_shown()
        except TimeoutError:
            self._pause()

    def _advance(self) -> None:
        if self.simulation.reading.step >= MAX_RUN:
            self._pause()
            ui.notify(f"Paused after {MAX_RUN} steps; reset to start anew.")
            return
        self.simulation.step()
        self.refresh()
        # The next episode may be shorter than the step that was chosen
        self._start_knob.settle()

    def _step_once(self) -> None:
        self._pause()
        self._advance()

    def _toggle(self) -> None:
        if self._timer.active:
            self._pause()
        else:
            self._timer.active = True
            self._play.text = "Pause"
            self._play.props["icon"] = "pause"

    def _pause(self) -> None:
        self._timer.active = False
        self._play.text = "Play"
        self._play.props["icon"] = "play_arrow"

    def _set_speed(self, value: float) -> None:
        self._timer.interval = 1.0 / value
        self._speed_knob.show(value)
        self._pace.ask()

    def _choose_episode(self, value: float) -> None:
        self._episode = int(value) - 1
        self._pace.ask()

    def _choose_start(self, value: float) -> None:
        self._start = int(value)
        self._pace.ask()

    def _export(self) -> None:
        title = PRESETS[self._preset].title
        ui.download.content(recorded_run(self.simulation, title), "lambda-dial.html", "text/html")
