"""Evaluations on time, whatever library trains."""

from collections.abc import Callable

from benchmarks.peers.clock import TrainingClock
from benchmarks.peers.evaluation import Act, Evaluator
from benchmarks.peers.journal import Line


class Recorder:
    """
    Asked between two updates; evaluates when it is time.

    :param evaluator: plays
    :param clock: of the training, which stands while this works
    :param interval: steps from one evaluation to the next
    :param add: is given a line for each evaluation
    """

    def __init__(self, evaluator: Evaluator, clock: TrainingClock, interval: int, add: Callable[[Line], None]):
        self._evaluator, self._clock, self._interval, self._add = evaluator, clock, interval, add

    def next_after(self, steps: int) -> int:
        """
        :param steps: of training, when an evaluation took place
        :return: steps from which on the next one is due
        """
        return (steps // self._interval + 1) * self._interval

    def evaluate(self, steps: int, act: Act) -> None:
        """
        :param steps: of training so far
        :param act: the agent
        """
        wall, cpu = self._clock.read()
        result = self._evaluator.play(act)
        self._add(
            {
                "steps": steps,
                "mean_return": round(float(result.returns.mean()), 4),
                "std_return": round(float(result.returns.std()), 4),
                "min_return": round(float(result.returns.min()), 4),
                "max_return": round(float(result.returns.max()), 4),
                "mean_length": round(float(result.lengths.mean()), 2),
                "wall_seconds": round(wall, 3),
                "cpu_seconds": round(cpu, 3),
                "evaluation_seconds": round(result.seconds, 3),
            }
        )
