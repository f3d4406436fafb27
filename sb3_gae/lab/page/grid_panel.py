"""The grid as 25 buttons, and what the one that was clicked says."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from nicegui import ui

from sb3_gae.gridworld import MOVE_NAMES
from sb3_gae.lab.moment import Moment, world
from sb3_gae.lab.page.widgets import panel, put
from sb3_gae.lab.pictures import cell_arrows, favourite_move

SIZE = 5


class End(NamedTuple):
    """
    :param name: of a cell where episodes end
    :param sign: that tells it without colour
    :param worth: as it is shown
    :param value: of entering it
    """

    name: str
    sign: str
    worth: str
    value: float


#: percent of a cell's colour; more, and its arrows and text would not stand out
DEEPEST = 35.0
#: by state
ENDS = {4: End("goal", "★", "+1", 1.0), 12: End("trap", "✕", "−1", -1.0)}


def cell_name(state: int) -> str:
    """
    :param state: of the gridworld
    :return: in words, counting from 1
    """
    row, column = divmod(state, SIZE)
    return f"row {row + 1}, column {column + 1}"


def cell_style(value: float) -> str:
    """
    :param value: of a cell
    :return: green for more, slate for less than nothing; the stronger the further from it
    """
    amount = min(abs(value), 1.0) * DEEPEST
    return f"--amount: {amount:.0f}%; --tint: var({'--good' if value >= 0.0 else '--bad'})"


def cell_classes(state: int, is_chosen: bool) -> str:
    """
    :param state: of the gridworld
    :param is_chosen: whether its numbers are shown
    :return: CSS classes
    """
    return f"cell{f' {ENDS[state].name}' if state in ENDS else ''}{' chosen' if is_chosen else ''}"


def cell_content(state: int, value: float, probabilities: np.ndarray) -> str:
    """
    :param state: of the gridworld, no end
    :param value: of the cell
    :param probabilities: of the moves in it, shape (4,)
    :return: what is in the cell, as HTML
    """
    name = '<span class="name">START</span>' if world().start[state] else ""
    return f'{name}<span class="arrows">{cell_arrows(probabilities)}</span><span class="number">{value:.2f}</span>'


class GridPanel:
    """
    :param moment: gives the present one
    """

    def __init__(self, moment: Callable[[], Moment]):
        self._moment = moment
        self.chosen = int(np.argmax(world().start))
        with panel("The grid"):
            with ui.element("div").classes("cells") as grid:
                grid.props["role"] = "group"
                grid.props["aria-label"] = "Gridworld of 5 rows and 5 columns"
                self._cells = [self._cell(state) for state in range(SIZE**2)]
            ui.label(
                "Greener cells hold more value, slate ones less than nothing; the number is what the estimator takes for V. "
                "The longest arrow, in clay orange, is the policy's favourite move. Click a cell to read its numbers; arrow "
                "keys go from cell to cell."
            ).classes("faint q-mt-sm")
        with panel("The cell"):
            self._details = ui.html("", sanitize=False).classes("scrolls")
            self._details.props["data-test"] = "cell-details"

    def refresh(self) -> None:
        """Show the present moment."""
        moment = self._moment()
        values, probabilities = moment.values, moment.policy.probabilities
        for state, button in enumerate(self._cells):
            is_chosen = state == self.chosen
            button.classes(replace=cell_classes(state, is_chosen))
            put(button, aria_pressed=str(is_chosen).lower(), tabindex="0" if is_chosen else "-1")
            if state in ENDS:
                continue
            button.style(replace=cell_style(values[state]))
            favourite = f"{favourite_move(probabilities[state])} {probabilities[state].max():.0%}"
            put(button, aria_label=f"{cell_name(state)}, value {values[state]:.2f}, favourite move {favourite}")
            button.content = cell_content(state, values[state], probabilities[state])
        self._details.content = cell_table(moment, self.chosen)

    def _cell(self, state: int) -> ui.html:
        button = ui.html("", sanitize=False, tag="button").on("click", lambda: self._choose(state))
        button.props.update({"type": "button", "data-test": f"cell-{state}"})
        if state in ENDS:
            end = ENDS[state]
            button.props["aria-label"] = f"{cell_name(state)}, the {end.name}, worth {end.worth}"
            button.style(cell_style(end.value))
            button.content = (
                f'<span class="name">{end.name.upper()}</span><span class="sign">{end.sign}</span>'
                f'<span class="number">{end.worth}</span>'
            )
        return button

    def _choose(self, state: int) -> None:
        self.chosen = state
        self.refresh()


def cell_table(moment: Moment, state: int) -> str:
    """
    :param moment: the present one
    :param state: of the gridworld
    :return: its value, and probability and true advantage of each move, as HTML
    """
    if state in ENDS:
        end = ENDS[state]
        return (
            f"<p>{cell_name(state).capitalize()}: the {end.name}. Entering it is worth {end.worth} and ends the episode.</p>"
        )
    policy, gamma = moment.policy, moment.controls.gamma
    advantages, actions = policy.advantages(gamma)[state], policy.action_values(gamma)[state]
    expected = moment.moments.advantage_mean[state]
    rows = "".join(
        f"<tr><td>{name}</td><td>{policy.probabilities[state, move]:.1%}</td><td>{actions[move]:+.3f}</td>"
        f"<td>{advantages[move]:+.3f}</td><td>{expected[move]:+.3f}</td></tr>"
        for move, name in enumerate(MOVE_NAMES)
    )
    return (
        f"<p>{cell_name(state).capitalize()}: the estimator takes V = {moment.values[state]:+.3f}; the truth is "
        f"{moment.exact_values[state]:+.3f}.</p><table><thead><tr><th>move</th><th>probability</th><th>true Q</th>"
        f"<th>true advantage</th><th>expected estimate</th></tr></thead><tbody>{rows}</tbody></table>"
    )
