"""Where time goes within calls of functions that call each other."""

import functools
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any, NamedTuple
from unittest import mock

#: of an iteration; the last is what an update does beside the two before
ROLLOUT, POLICY_STEP, VALUE_FIT, UPDATE = "rollout", "policy step", "value fit", "update"


class Section(NamedTuple):
    """
    :param phase: of an iteration; "" for that of the caller
    :param part: of the phase
    """

    phase: str
    part: str


class Stopwatch:
    """
    Gives each moment to the innermost watched call: what a watched function calls that is watched itself is not its own.

    :param clock: in seconds
    """

    def __init__(self, clock: Callable[[], float] = time.perf_counter):
        #: that each section took
        self.seconds: dict[Section, float] = defaultdict(float)
        self._clock = clock
        self._open: list[Section] = []
        self._since = 0.0
        self._patches = ExitStack()

    def watch(self, section: Section, owner: Any, *names: str) -> None:
        """
        :param section: that calls belong to
        :param owner: module, class or object
        :param names: of its functions, which are wrapped until :meth:`release`
        """
        for name in names:
            self._patches.enter_context(mock.patch.object(owner, name, self._timed(section, getattr(owner, name))))

    def release(self) -> None:
        """Put all functions back."""
        self._patches.close()

    def _timed(self, section: Section, call: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(call)
        def timed(*args: Any, **kwargs: Any) -> Any:
            with self._inside(section):
                return call(*args, **kwargs)

        return timed

    @contextmanager
    def _inside(self, section: Section) -> Iterator[None]:
        phase = section.phase or (self._open[-1].phase if self._open else "")
        self._credit()
        self._open.append(Section(phase, section.part))
        try:
            yield
        finally:
            self._credit()
            self._open.pop()

    def _credit(self) -> None:
        """To the innermost call, what has passed since it was last the innermost."""
        now = self._clock()
        if self._open:
            self.seconds[self._open[-1]] += now - self._since
        self._since = now
