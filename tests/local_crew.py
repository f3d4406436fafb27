"""Workers without Ray: in this process, one after the other, and lost on demand."""

import os
import pickle
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cloudpickle
import torch as th
from stable_baselines3.common.vec_env import VecEnv

from sb3_gae.errors import WorkersLostError
from sb3_gae.saving.random_state import random_state, restore_random_state
from sb3_gae.workers.rollout_worker import RolloutWorker


class LocalCrew:
    """Stands in for :class:`~sb3_gae.workers.crew.Crew`; what goes to a worker and back is copied."""

    #: (method, worker) that is lost the next time it is asked, after it has done its work
    to_lose: set[tuple[str, int]] = set()  # noqa: RUF012
    #: methods with which all workers are lost for good
    gone: set[str] = set()  # noqa: RUF012

    def __init__(self, makers: Sequence[Callable[[], VecEnv]], cpus_per_worker: int):
        self._makers = [cloudpickle.dumps(make) for make in makers]
        self._workers = [self._new(worker, False) for worker in range(len(makers))]
        self.descriptions = self.ask("start", [()] * len(makers))

    def share(self, value: Any) -> Any:
        return value

    def ask(
        self,
        method: str,
        arguments: Sequence[tuple[Any, ...]],
        replaced: Callable[[int], None] | None = None,
        workers: Sequence[int] | None = None,
    ) -> list[Any]:
        answers = []
        for worker, own in zip(range(len(self._workers)) if workers is None else workers, arguments, strict=True):
            if method in self.gone:
                raise WorkersLostError("Ray is gone.")
            answer = self._ask_one(worker, method, own)
            if (method, worker) in self.to_lose:
                self.to_lose.remove((method, worker))
                self._workers[worker] = self._new(worker, True)
                self._ask_one(worker, "start", ())
                assert replaced is not None
                replaced(worker)
                answer = self._ask_one(worker, method, own)
            answers.append(answer)
        return answers

    def close(self) -> None:
        self._workers = []

    def _new(self, worker: int, is_replacement: bool) -> RolloutWorker:
        return RolloutWorker(cloudpickle.loads(self._makers[worker]), 1, str(Path.cwd()), is_replacement)

    def _ask_one(self, worker: int, method: str, arguments: tuple[Any, ...]) -> Any:
        with _as_it_was():
            answer = getattr(self._workers[worker], method)(*cloudpickle.loads(cloudpickle.dumps(arguments)))
        return pickle.loads(pickle.dumps(answer))


@contextmanager
def _as_it_was() -> Iterator[None]:
    """A worker has a process of its own."""
    generators, folder, n_threads = random_state(), Path.cwd(), th.get_num_threads()
    yield
    restore_random_state(generators)
    os.chdir(folder)
    th.set_num_threads(n_threads)
