"""Waiting for a storage whose server does not answer: it is started anew, or the network is gone for a while."""

import sys
import time
from collections.abc import Callable
from typing import TypeVar

from sb3_gae.sweep.errors import UnreachableError

_T = TypeVar("_T")

_FIRST_PAUSE, _LONGEST_PAUSE = 0.1, 2.0


class Patience:
    """
    Calls what needs a storage, and again until it answers.

    :param seconds: to wait at most for one answer
    :param stop: asked while waiting; whether to wait no longer
    """

    def __init__(self, seconds: float = 0.0, stop: Callable[[], bool] = lambda: False):
        self.seconds = seconds
        self._stop = stop
        self._is_waiting = False

    def __call__(self, operation: Callable[[], _T]) -> _T:
        """
        :param operation: that may be done twice: a server that is lost may have done it without a word
        :return: its result
        :raises UnreachableError: if it was in vain until the end
        """
        until, pause = time.monotonic() + self.seconds, _FIRST_PAUSE
        while True:
            try:
                result = operation()
            except UnreachableError as error:
                if not self.seconds:
                    raise
                self._check(error, until)
            else:
                self._is_answered()
                return result
            time.sleep(min(pause, max(0.0, until - time.monotonic())))
            pause = min(2.0 * pause, _LONGEST_PAUSE)

    def _check(self, error: UnreachableError, until: float) -> None:
        if time.monotonic() >= until or self._stop():
            advice = "What is done is kept: the same command goes on when the storage is back."
            raise UnreachableError(f"{error} {advice}") from error
        if not self._is_waiting:
            self._is_waiting = True
            _say(f"{error} Waiting for it, {self.seconds:.0f} s at most.")

    def _is_answered(self) -> None:
        if self._is_waiting:
            self._is_waiting = False
            _say("The storage answers again.")


def _say(what: str) -> None:
    print(f"sb3_gae.sweep: {what}", file=sys.stderr, flush=True)
