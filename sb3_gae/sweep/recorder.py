"""The learning curve of a run, a row for each iteration."""

import math
import time
from collections.abc import Callable

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback

from sb3_gae.rollout.collection import reported_episodes

#: what is logged of an update, by the name that it has in a row
_OF_THE_UPDATE = {
    "explained_variance": "train/explained_variance",
    "explained_variance_after": "train/explained_variance_after",
    "kl_divergence": "train/kl_divergence_loss",
    "line_search_success": "train/is_line_search_success",
    "cg_steps": "train/cg_steps",
    "value_loss": "train/value_loss",
    "vf_steps": "train/vf_steps",
    "vf_kl_divergence": "train/vf_kl_divergence",
    "std": "train/std",
}

#: of a row: ``iteration`` from 1, ``timesteps`` since the start, ``episodes`` that ended in the batch with their
#: ``mean_return`` and ``mean_length`` (steps), ``lambda_used`` for their advantages, ``seconds`` of rollout and update;
#: NaN where there is none
COLUMNS = ("iteration", "timesteps", "episodes", "mean_return", "mean_length", "lambda_used", "seconds", *_OF_THE_UPDATE)

Row = dict[str, float]


class Recorder(BaseCallback):
    """
    Records an iteration once its update is over, and ends the training after the last.

    :param iterations: of the run
    :param on_row: called with each row
    :param on_step: called at every step of the environments; may raise to end the run
    """

    def __init__(self, iterations: int, on_row: Callable[[Row], None], on_step: Callable[[], None] = lambda: None):
        super().__init__()
        self.iterations = iterations
        self.n_recorded = 0
        self._on_row, self._call_on_step = on_row, on_step
        self._row: Row = {}

    def _on_rollout_start(self) -> None:
        self._record_last()
        self._returns: list[float] = []
        self._lengths: list[int] = []
        self._start = time.perf_counter()

    def _on_step(self) -> bool:
        self._call_on_step()
        if self.n_recorded == self.iterations:
            return False
        infos = self.locals["infos"]
        # With whole episodes: only those that belong to the batch
        counts = quota.counts if (quota := self.locals.get("quota")) is not None else None
        for env in reported_episodes(self.locals["dones"], infos, counts).tolist():
            # Where a wrapper outside `Monitor` ended it there is none to report
            if (episode := infos[env].get("episode")) is not None:
                self._returns.append(episode["r"])
                self._lengths.append(episode["l"])
        return True

    def _on_rollout_end(self) -> None:
        self._row = {
            "iteration": self.n_recorded + 1,
            "timesteps": self.num_timesteps,
            "episodes": len(self._returns),
            "mean_return": float(np.mean(self._returns)) if self._returns else math.nan,
            "mean_length": float(np.mean(self._lengths)) if self._lengths else math.nan,
            # Of the buffer: without a value function that of the model has no effect
            "lambda_used": float(self.locals["rollout_buffer"].gae_lambda),
        }

    def _on_training_end(self) -> None:
        self._record_last()

    def _record_last(self) -> None:
        if not self._row:
            return
        logged = self.logger.name_to_value
        update = {name: float(logged.get(key, math.nan)) for name, key in _OF_THE_UPDATE.items()}
        row = self._row | {"seconds": round(time.perf_counter() - self._start, 4)} | update
        self._row = {}
        self.n_recorded += 1
        self._on_row(row)
