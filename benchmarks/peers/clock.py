"""Seconds of training, without those of evaluation."""

import time


class TrainingClock:
    """Wall-clock and processor seconds of this process while it runs."""

    def __init__(self) -> None:
        self._wall, self._cpu = 0.0, 0.0
        self._since: tuple[float, float] | None = None

    def start(self) -> None:
        """Go on; nothing changes if it runs."""
        if self._since is None:
            self._since = (time.perf_counter(), time.process_time())

    def stop(self) -> None:
        """Pause; nothing changes if it stands."""
        self.set(*self.read())

    def set(self, wall: float, cpu: float) -> None:
        """
        Stand at given times.

        :param wall: seconds
        :param cpu: seconds of all threads together
        """
        self._wall, self._cpu, self._since = wall, cpu, None

    def read(self) -> tuple[float, float]:
        """:return: wall-clock and processor seconds until now"""
        if self._since is None:
            return self._wall, self._cpu
        wall, cpu = self._since
        return self._wall + time.perf_counter() - wall, self._cpu + time.process_time() - cpu
