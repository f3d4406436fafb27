"""Between two iterations of an algorithm of SB3: stop the clock, evaluate, start it again."""

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback

from benchmarks.peers.clock import TrainingClock
from benchmarks.peers.evaluation import Act
from benchmarks.peers.recorder import Recorder


class StopClock(BaseCallback):
    """
    The first callback of a training: evaluates, and what comes after it is not counted either, until :class:`StartClock`.

    What it counts is in plain attributes, so that a checkpoint holds it.

    :param clock: of the training
    :param recorder: evaluates
    :param steps: of the whole training
    """

    def __init__(self, clock: TrainingClock, recorder: Recorder, steps: int):
        super().__init__()
        self._clock, self._recorder, self._steps = clock, recorder, steps
        self.wall_seconds, self.cpu_seconds = 0.0, 0.0
        self.next_evaluation, self.last_evaluation = 0, -1

    def _on_rollout_start(self) -> None:
        self._stop()
        if self.num_timesteps >= self.next_evaluation:
            self._evaluate()

    def _on_step(self) -> bool:
        return True

    def _on_training_end(self) -> None:
        self._stop()
        # rl-zoo3 calls this a second time, and where a training is stopped
        if self.num_timesteps >= self._steps and self.num_timesteps > self.last_evaluation:
            self._evaluate()

    def _stop(self) -> None:
        self._clock.stop()
        self.wall_seconds, self.cpu_seconds = self._clock.read()

    def _evaluate(self) -> None:
        self._recorder.evaluate(self.num_timesteps, agent_of(self.model))
        self.last_evaluation = self.num_timesteps
        self.next_evaluation = self._recorder.next_after(self.num_timesteps)


class StartClock(BaseCallback):
    """
    The last callback of a training.

    :param clock: of the training
    :param stopped: the first callback
    """

    def __init__(self, clock: TrainingClock, stopped: StopClock):
        super().__init__()
        self._clock, self._stopped = clock, stopped

    def _on_training_start(self) -> None:
        # From where the checkpoint was, if the training goes on from one
        self._clock.set(self._stopped.wall_seconds, self._stopped.cpu_seconds)
        self._clock.start()

    def _on_rollout_start(self) -> None:
        self._clock.start()

    def _on_step(self) -> bool:
        return True


def agent_of(model: BaseAlgorithm) -> Act:
    """
    :param model: of SB3
    :return: its deterministic policy for raw observations
    """
    normalize = model.get_vec_normalize_env()

    def act(observations: np.ndarray) -> np.ndarray:
        seen = observations if normalize is None else normalize.normalize_obs(observations)
        return model.predict(seen, deterministic=True)[0]

    return act
