"""Pieces that both parts of the page are made of."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from nicegui import ui

# Seconds between two values of a drag
_THROTTLE = 0.02


class Knob:
    """
    A slider under its name and value. What it is turned to is shown by whoever made it, together with what follows from it.

    :param name: as it is shown, and said by a screen reader
    :param low: end of the slider
    :param high: end of the slider
    :param step: of the slider
    :param value: to begin with
    :param on_change: called with the new value, also while it is dragged; it is shown by :meth:`show` and :meth:`settle`
    :param marker: for tests, to find it by
    """

    def __init__(
        self, name: str, low: float, high: float, step: float, value: float, on_change: Callable[[float], None], marker: str
    ):
        with ui.element("div").classes("w-full"):
            with ui.element("div").classes("knob-name"):
                ui.label(name)
                self._shown = ui.label(f"{value:g}")
                self._shown.props["data-test"] = f"{marker}-shown"
            # Not ui.slider, which sends a drag on every 50 milliseconds only
            self._slider = ui.element("q-slider").on(
                "update:model-value", lambda event: self._turn(event.args), throttle=_THROTTLE
            )
            self._slider.props.update({"min": low, "max": high, "step": step, "model-value": value})
            self._slider.props.update({"aria-label": name, "data-test": marker})
        # Quasar's slider knows the arrows and page keys only
        self._slider.on("keydown.home", lambda: self._turn(low))
        self._slider.on("keydown.end", lambda: self._turn(self._slider.props["max"]))
        self._on_change, self._value = on_change, value

    def show(self, value: float) -> None:
        """
        :param value: that the number has from now on; the slider is there already, or about to be settled
        """
        self._value = value
        self._shown.text = f"{value:g}"

    def settle(self) -> None:
        """Tell the slider where it is. Not while it is turned: it would be put back to where it was a moment ago."""
        put(self._slider, model_value=self._value)

    def set_high(self, high: float) -> None:
        """
        :param high: new end of the slider
        """
        put(self._slider, max=high)

    def _turn(self, value: Any) -> None:
        # Whatever a page may send
        if isinstance(value, int | float) and self._slider.props["min"] <= value <= self._slider.props["max"]:
            self._on_change(value)


def choice(name: str, options: dict[str, str], value: str, on_change: Callable[[Any], None], marker: str) -> ui.radio:
    """
    :param name: of the group
    :param options: values and their labels
    :param value: to begin with
    :param on_change: called with the new value
    :param marker: for tests, to find it by
    :return: radio buttons
    """
    with ui.element("div").classes("w-full"):
        ui.label(name).classes("knob-name")
        radio = ui.radio(options, value=value, on_change=lambda event: on_change(event.value)).props("inline dense")
        radio.props["aria-label"] = name
        radio.props["data-test"] = marker
    return radio


def put(element: ui.element, **props: Any) -> None:
    """
    Change properties, and tell the page only if they are new.

    :param element: any
    :param props: names, with _ for -, and values
    """
    new = {name.replace("_", "-"): value for name, value in props.items()}
    new = {name: value for name, value in new.items() if element.props.get(name) != value}
    if new:
        element.props.update(new)


def picture(marker: str) -> ui.html:
    """
    :param marker: for tests, to find it by
    :return: a place for the SVG of :mod:`sb3_gae.lab.pictures`, which needs no sanitizing as it is made of numbers
    """
    place = ui.html("", sanitize=False).classes("w-full")
    place.props["data-test"] = marker
    return place


@contextmanager
def panel(title: str, titled: bool = True) -> Iterator[ui.element]:
    """
    :param title: its name and heading
    :param titled: whether the heading is shown
    :return: a section of the page
    """
    with ui.element("section").classes("panel") as section:
        section.props["aria-label"] = title
        if titled:
            heading(title, 2)
        yield section


def heading(text: str, level: int) -> ui.element:
    """
    :param text: of the heading
    :param level: 1 or 2
    :return: the element
    """
    element = ui.element(f"h{level}")
    with element:
        ui.label(text)
    return element
