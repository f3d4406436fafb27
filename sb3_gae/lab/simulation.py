"""A run of the demonstration: the present moment, what went before, and a log of what happened."""

from dataclasses import asdict, replace
from typing import Any, NamedTuple

import numpy as np

from sb3_gae.lab.controls import Controls
from sb3_gae.lab.moment import MAX_STEPS, Moment, first_moment
from sb3_gae.lab.readings import Reading, light, read, status


class Event(NamedTuple):
    """
    :param step: when it happened
    :param text: what
    """

    step: int
    text: str


class Frame(NamedTuple):
    """
    What the grid showed at one step.

    :param values: of the estimator, shape (S,)
    :param probabilities: of the moves, shape (S, A)
    """

    values: np.ndarray
    probabilities: np.ndarray


CONTROL_NAMES = {
    "gae_lambda": "λ",
    "gamma": "γ",
    "value_function": "value function",
    "batch_size": "batch",
    "learning_rate": "learning rate",
    "order": "order",
}


#: what the log says, by the light before and now
LIGHT_CHANGES = {
    ("unbiased", "slight"): "a slight bias came on",
    ("unbiased", "biased"): "bias came on",
    ("slight", "biased"): "the bias is no longer slight",
    ("biased", "slight"): "the bias became slight",
    ("slight", "unbiased"): "bias went off",
    ("biased", "unbiased"): "bias went off",
}


class Simulation:
    """
    :param controls: to begin with
    :param seed: of all randomness
    """

    def __init__(self, controls: Controls, seed: int = 0):
        self.seed = seed
        self.reset(controls)

    def reset(self, controls: Controls | None = None) -> None:
        """
        Go back to step 0.

        :param controls: to begin with; None for those in use
        """
        self.moment: Moment = first_moment(controls or self.controls, self.seed)
        self.events: list[Event] = []
        #: of all moments so far, the present one last
        self.readings: list[Reading] = [read(self.moment)]
        self.frames: list[Frame] = [self._frame()]
        self._since_change = 0
        self._light, self._status = "unbiased", self.status
        self._note_light()

    @property
    def controls(self) -> Controls:
        """In use now."""
        return self.moment.controls

    @property
    def reading(self) -> Reading:
        """Of the present moment."""
        return self.readings[-1]

    @property
    def status(self) -> str:
        """See :func:`~sb3_gae.lab.readings.status`."""
        return status([reading.score for reading in self.readings[self._since_change :]])

    def step(self) -> None:
        """Take one policy-gradient ascent step."""
        if self.moment.batch.truncated.any():
            self._log(f"episodes cut after {MAX_STEPS} steps: the policy goes round in circles")
        self.moment = self.moment.next()
        self.readings.append(read(self.moment))
        self.frames.append(self._frame())
        self._note_light()
        self._note_status()

    def change(self, **changes: Any) -> None:
        """
        Turn controls; the run goes on under the new ones.

        :param changes: names and values of :class:`~sb3_gae.lab.controls.Controls`
        :raises ValueError: if a value is out of range
        """
        before, after = asdict(self.controls), asdict(replace(self.controls, **changes))
        turned = [name for name in before if before[name] != after[name]]
        if not turned:
            return
        self.moment = self.moment.with_controls(Controls(**after))
        for name in turned:
            self._log_turn(CONTROL_NAMES[name], before[name], after[name])
        # A return under another γ is no gain, and a climb is judged by what the new controls do
        self.readings[-1], self.frames[-1] = read(self.moment), self._frame()
        self._since_change = len(self.readings) - 1
        self._status = self.status
        self._note_light()

    def _frame(self) -> Frame:
        return Frame(self.moment.values, self.moment.policy.probabilities)

    def _note_light(self) -> None:
        """Log that the light changed its colour."""
        shown = light(self.reading.bias_angle)
        if shown != self._light:
            self._log(f"{LIGHT_CHANGES[self._light, shown]} ({self.reading.bias_angle:.2f} rad)")
            self._light = shown

    def _note_status(self) -> None:
        words = {"optimal": "optimal reached", "stalled": "the climb stalled", "climbing": "climbing again"}
        if self.status != self._status:
            self._status = self.status
            self._log(f"{words[self._status]} at {self.reading.score:.0%} of the best return")

    def _log_turn(self, name: str, before: Any, after: Any) -> None:
        """Log a turned control; a drag, which turns the same one many times at one step, as one event."""
        start, place = f"{name}: ", self._turned_last()
        if place is not None and self.events[place].text.startswith(start):
            before = self.events.pop(place).text.removeprefix(start).split(" → ")[0]
        else:
            place = len(self.events)
        before = before if isinstance(before, str) else f"{before:g}"
        after = after if isinstance(after, str) else f"{after:g}"
        if before != after:
            text = f"{start}{before.replace('_', ' ')} → {after.replace('_', ' ')}"
            self.events.insert(place, Event(self.moment.step, text))

    def _turned_last(self) -> int | None:
        """Place in the log of the control that was turned last at this step; the light may have changed meanwhile."""
        turns = [place for place, event in enumerate(self.events) if " → " in event.text and event.step == self.moment.step]
        return turns[-1] if turns else None

    def _log(self, text: str) -> None:
        self.events.append(Event(self.moment.step, text))
