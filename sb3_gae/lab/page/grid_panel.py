"""The grid as 25 buttons, and what the one that was clicked says."""

from collections.abc import Callable

import numpy as np
from nicegui import ui

from sb3_gae.gridworld import MOVE_NAMES
from sb3_gae.lab.moment import Moment, world
from sb3_gae.lab.page.widgets import panel, put
from sb3_gae.lab.pictures import cell_arrows, favourite_move

SIZE = 5
GOAL, TRAP = 4, 12


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
    amount = min(abs(value), 1.0) * 75.0
    return f"--amount: {amount:.0f}%; --tint: var({'--good' if value >= 0.0 else '--bad'})"


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
                "Greener cells hold more value; the number is what the estimator takes for V. The longest arrow, in clay "
                "orange, is the policy's favourite move. Click a cell to read its numbers."
            ).classes("faint q-mt-sm")
        with panel("The cell"):
            self._details = ui.html("", sanitize=False).classes("scrolls")
            self._details.props["data-test"] = "cell-details"

    def refresh(self) -> None:
        """Show the present moment."""
        moment = self._moment()
        values, probabilities = moment.values, moment.policy.probabilities
        for state, (button, arrows, number) in enumerate(self._cells):
            button.classes(replace=self._cell_classes(state))
            put(button, aria_pressed="true" if state == self.chosen else "false")
            if state in (GOAL, TRAP):
                continue
            button.style(replace=cell_style(values[state]))
            favourite = f"{favourite_move(probabilities[state])} {probabilities[state].max():.0%}"
            put(button, aria_label=f"{cell_name(state)}, value {values[state]:.2f}, favourite move {favourite}")
            arrows.content = cell_arrows(probabilities[state])
            number.text = f"{values[state]:.2f}"
        self._details.content = cell_table(moment, self.chosen)

    def _cell(self, state: int) -> tuple[ui.element, ui.html, ui.label]:
        with ui.element("button").on("click", lambda: self._choose(state)) as button:
            button.props["type"] = "button"
            button.props["data-test"] = f"cell-{state}"
            name = {GOAL: "GOAL", TRAP: "TRAP"}.get(state) or ("START" if world().start[state] else "")
            if name:
                ui.label(name).classes("name")
            arrows, number = ui.html("", sanitize=False).classes("arrows"), ui.label("").classes("number")
            if state in (GOAL, TRAP):
                sign, worth = ("★", "+1") if state == GOAL else ("✕", "−1")
                ui.label(sign).classes("sign")
                number.text = worth
                button.props["aria-label"] = f"{cell_name(state)}, the {name.lower()}, worth {worth}"
                button.style(cell_style(1.0 if state == GOAL else -1.0))
        return button, arrows, number

    def _cell_classes(self, state: int) -> str:
        kind = {GOAL: " goal", TRAP: " trap"}.get(state, "")
        return f"cell{kind}{' chosen' if state == self.chosen else ''}"

    def _choose(self, state: int) -> None:
        self.chosen = state
        self.refresh()


def cell_table(moment: Moment, state: int) -> str:
    """
    :param moment: the present one
    :param state: of the gridworld
    :return: its value, and probability and true advantage of each move, as HTML
    """
    if state in (GOAL, TRAP):
        name, worth = ("goal", "+1") if state == GOAL else ("trap", "−1")
        return f"<p>{cell_name(state).capitalize()}: the {name}. Entering it is worth {worth} and ends the episode.</p>"
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
