"""The page as a whole, and the server it comes from."""

import socket
import warnings
import webbrowser
from collections.abc import Sequence
from pathlib import Path

import uvicorn
from fastapi import FastAPI
from nicegui import app as nicegui_app
from nicegui import ui

from sb3_gae.lab.page.gridworld_panel import GridworldPanel
from sb3_gae.lab.page.host_guard import HostGuard
from sb3_gae.lab.page.rollout_panel import RolloutPanel
from sb3_gae.lab.page.widgets import heading
from sb3_gae.lab.rollout_view import RolloutViewer

TITLE = "The λ dial"
_STYLE = (Path(__file__).parent.parent / "style.css").read_text(encoding="utf-8")

_KEYBOARD = (Path(__file__).parent / "keyboard.js").read_text(encoding="utf-8")


def serve(listening: socket.socket, viewer: RolloutViewer, show: str | None = None, names: Sequence[str] = ()) -> None:
    """
    Serve the page until interrupted.

    :param listening: bound to where the page is to be
    :param viewer: of the rollout that the page begins with
    :param show: address to open in a browser, None for no browser
    :param names: of hosts to answer to, see :class:`~sb3_gae.lab.page.host_guard.HostGuard`
    """
    app = FastAPI(docs_url=None, redoc_url=None, openapi_url=None)

    # A new one for each tab, so that none disturbs another
    def page() -> None:
        build_page(viewer)

    # A run survives a network that is away for a while
    looks = dict(title=TITLE, dark=None, language="en-US", tailwind=False)
    ui.run_with(app, root=page, show_welcome_message=False, reconnect_timeout=30.0, **looks)  # type: ignore[arg-type]
    if show is not None:
        nicegui_app.on_startup(lambda: webbrowser.open(show))
    guarded = HostGuard(app, listening.getsockname()[0], names)
    # Between two processes of one machine, and in most networks, to compress takes longer than to send
    server = uvicorn.Server(
        uvicorn.Config(guarded, log_level="warning", timeout_graceful_shutdown=2, ws_per_message_deflate=False)
    )
    # NiceGUI looks through all objects of the process, and some of torch warn when they are looked at
    with warnings.catch_warnings(action="ignore", category=FutureWarning):
        server.run(sockets=[listening])


def build_page(viewer: RolloutViewer) -> None:
    """
    :param viewer: of the rollout to begin with
    """
    ui.add_css(_STYLE)
    ui.add_head_html(f"<script>{{{_KEYBOARD}}}</script>")
    theme = ui.dark_mode(None)
    with ui.element("main").classes("lab") as main:
        with ui.element("div").classes("beside q-mb-sm").style("justify-content: space-between"):
            heading("The λ dial: bias, variance and learning", 1)
            choices = {"system": None, "light": False, "dark": True}
            switch = ui.toggle(list(choices), value="system").props("dense no-caps flat aria-label=Theme data-test=theme")
            switch.on_value_change(lambda event: theme.set_value(choices.get(event.value)))
        with ui.tabs().props("no-caps align=left inline-label") as tabs:
            grid = ui.tab("grid", label="Gridworld").props("data-test=tab-grid")
            robot = ui.tab("robot", label="Recorded robot").props("data-test=tab-robot")
        with ui.tab_panels(tabs, value=grid, animated=False).classes("w-full").style("background: transparent"):
            with ui.tab_panel(grid).classes("q-px-none"):
                GridworldPanel()
            with ui.tab_panel(robot).classes("q-px-none"):
                RolloutPanel(viewer)
    ui.skip_link(target=main)
