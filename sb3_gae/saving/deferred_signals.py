"""Signals that ask a process to end, kept until it is at a good place."""

import contextlib
import os
import signal
import threading
from collections.abc import Sequence
from types import FrameType
from typing import Any


class DeferredSignals:
    """
    Keeps the first signal until :meth:`deliver`. The second one counts at once.

    :param signals: to keep
    :param notice: written to stderr when the first one comes
    """

    def __init__(self, signals: Sequence[signal.Signals] = (signal.SIGINT, signal.SIGTERM), notice: str = ""):
        self._signals = signals
        self._notice = notice
        self._previous: dict[int, Any] = {}
        #: that came and is kept
        self.pending: signal.Signals | None = None

    def install(self) -> None:
        """Begin to keep signals; does nothing in any thread but the main one, as Python hears signals only there."""
        if threading.current_thread() is not threading.main_thread():
            return
        for number in self._signals:
            # Who ignores a signal, as nohup does, does not want to end; None is a handler that Python does not know
            if signal.getsignal(number) not in (signal.SIG_IGN, None):
                self._previous[number] = signal.signal(number, self._keep)

    def restore(self) -> None:
        """Give the signals back to those who had them; a signal that was kept stays pending."""
        while self._previous:
            number, handler = self._previous.popitem()
            signal.signal(number, handler)

    def deliver(self) -> None:
        """
        Restore, and let the kept signal do what it would have done.

        :raises SystemExit: for a signal that would have ended the process without a word, so that it ends in order
        :raises KeyboardInterrupt: for Ctrl-C
        """
        number, self.pending = self.pending, None
        self.restore()
        if number is None:
            return
        if signal.getsignal(number) == signal.SIG_DFL:
            raise SystemExit(128 + number)
        signal.raise_signal(number)

    def _keep(self, number: int, frame: FrameType | None) -> None:
        if self.pending is not None:
            self.pending = signal.Signals(number)
            self.deliver()
            return
        self.pending = signal.Signals(number)
        # Not by print: the signal may have interrupted one
        with contextlib.suppress(OSError):
            os.write(2, self._notice.encode())
