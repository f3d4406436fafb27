"""As many pictures as a browser can follow, and no more."""

import asyncio
from collections.abc import Callable

from nicegui import background_tasks, ui

#: seconds without an answer after which nobody seems to be looking
LONGEST_WAIT = 20.0
#: seconds after which a drag is taken to be over
QUIET = 0.3


async def until_shown() -> None:
    """
    Wait until the browser has put on the page what it was sent.

    :raises TimeoutError: if it does not say so for long
    """
    await ui.run_javascript("return true", timeout=LONGEST_WAIT)


class Pace:
    """
    Calls a refresh at once if the page shows the one before, else as soon as it does: what a drag asks for in between
    would be out of date by then, and in a queue before a slow browser each answer would be later than the last.

    :param refresh: shows what there is to show when it is called
    :param settle: called when nothing has been asked for in a while
    """

    def __init__(self, refresh: Callable[[], None], settle: Callable[[], None]):
        self._refresh, self._settle = refresh, settle
        self._client = ui.context.client
        self._is_wanted = self._is_waiting = False
        self._asked = 0

    def ask(self) -> None:
        """Something has changed."""
        self._asked += 1
        if self._is_waiting:
            self._is_wanted = True
            return
        self._refresh()
        self._is_waiting = True
        background_tasks.create(self._go_on(), name="pace of a page")

    async def _go_on(self) -> None:
        try:
            with self._client:
                await until_shown()
                while self._is_wanted:
                    self._is_wanted = False
                    self._refresh()
                    await until_shown()
        except TimeoutError:
            self._is_wanted = False
        finally:
            self._is_waiting = False
        asked = self._asked
        await asyncio.sleep(QUIET)
        if asked == self._asked:
            self._settle()
