"""Workers as Ray actors: where they come from, how they are asked, and how a lost one is replaced."""

import os
import socket
import sys
import time
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv

from sb3_gae.errors import WorkersLostError
from sb3_gae.workers.rollout_worker import RolloutWorker

# Times that one worker may be lost with the same question before it is thought to be the question
_MOST_LOSSES = 3
# Seconds between looks at whether Ray is still there
_PULSE = 1.0
# Seconds that a cluster has to find a place for a worker, which may be the time to start a machine
_SECONDS_TO_WARN, _SECONDS_TO_START = 60.0, 900.0


class Shared:
    """
    A value for all workers, in Ray's store.

    :param put: puts it there
    :param value: the value
    """

    def __init__(self, put: Callable[[Any], Any], value: Any):
        self._put, self._value = put, value
        self.reference = put(value)

    def put_anew(self) -> None:
        """A machine that joins may else ask a lost one for its copy, again and again, until Ray gives that machine up."""
        self.reference = self._put(self._value)


class Crew:
    """
    Ray actors, each a :class:`~sb3_gae.workers.rollout_worker.RolloutWorker`.

    :param makers: for each worker, a function that makes its environments
    :param cpus_per_worker: that Ray reserves for each, and threads of torch in it
    :raises ImportError: if Ray is not installed
    :raises WorkersLostError: if the cluster has no place for a worker
    """

    def __init__(self, makers: Sequence[Callable[[], VecEnv]], cpus_per_worker: int):
        self._ray = ensure_ray(len(makers) * cpus_per_worker)
        self._makers = list(makers)
        self._cpus_per_worker = cpus_per_worker
        self._gcs_address = str(self._ray.get_runtime_context().gcs_address)
        # Spread, so that a cluster of many small machines is used as evenly as one large one
        self._actor_class = self._ray.remote(RolloutWorker).options(
            num_cpus=cpus_per_worker, scheduling_strategy="SPREAD", max_restarts=0, max_task_retries=0
        )
        self._actors = [self._new_actor(index, is_replacement=False) for index in range(len(makers))]
        #: of each worker: number of environments, observation space and action space
        self.descriptions: list[tuple[int, spaces.Space, spaces.Space]] = self.ask(
            "start", [()] * len(makers), patience=_SECONDS_TO_START
        )

    def __len__(self) -> int:
        return len(self._actors)

    def share(self, value: Any) -> Shared:
        """
        :param value: for all workers; it goes to each machine once
        :return: to be given as an argument in its place
        :raises WorkersLostError: if Ray is gone
        """
        self._check_ray()
        return Shared(self._ray.put, value)

    def ask(
        self,
        method: str,
        arguments: Sequence[tuple[Any, ...]],
        replaced: Callable[[int], None] | None = None,
        workers: Sequence[int] | None = None,
        patience: float | None = None,
    ) -> list[Any]:
        """
        Ask workers the same, all at once.

        :param method: of :class:`~sb3_gae.workers.rollout_worker.RolloutWorker`
        :param arguments: for each of them
        :param replaced: given the number of a worker that has just taken the place of a lost one, it brings the new one to
            where the old one was, which is then asked again; None if that cannot be, so that a loss is an error
        :param workers: their numbers, None for all
        :param patience: seconds after which an answer that has not come is an error; None to wait as long as workers live
        :return: the answers
        :raises WorkersLostError: if a worker is lost for good, or Ray is
        :raises Exception: what a worker raised
        """
        workers = range(len(self)) if workers is None else workers
        self._check_ray()
        answers: dict[int, Any] = {}
        losses = dict.fromkeys(workers, 0)
        of_worker = dict(zip(workers, arguments, strict=True))
        pending = {self._submit(worker, method, of_worker[worker]): worker for worker in workers}
        start, has_warned = time.monotonic(), False
        while pending:
            ready, _ = self._ray.wait(list(pending), timeout=_PULSE)
            if not ready:
                self._check_ray()
                waited = time.monotonic() - start
                if patience is not None and waited > patience:
                    raise WorkersLostError(self._no_place(len(pending), waited))
                if patience is not None and waited > _SECONDS_TO_WARN and not has_warned:
                    warnings.warn(f"{self._no_place(len(pending), waited)} Still waiting.", stacklevel=3)
                    has_warned = True
            for reference in ready:
                worker = pending.pop(reference)
                try:
                    answers[worker] = self._ray.get(reference)
                except self._ray.exceptions.RayTaskError as error:
                    raise error.cause from error
                except self._signs_of_loss() as error:
                    losses[worker] = self._replace(worker, losses[worker], error, replaced)
                    for argument in of_worker[worker]:
                        if isinstance(argument, Shared):
                            argument.put_anew()
                    pending[self._submit(worker, method, of_worker[worker])] = worker
        return [answers[worker] for worker in workers]

    def close(self) -> None:
        """End all workers. Ray itself stays, as it may serve others."""
        if self._is_the_same_ray():
            for actor in self._actors:
                self._ray.kill(actor)
        self._actors = []

    def _new_actor(self, worker: int, is_replacement: bool) -> Any:
        return self._actor_class.remote(self._makers[worker], self._cpus_per_worker, str(Path.cwd()), is_replacement)

    def _submit(self, worker: int, method: str, arguments: tuple[Any, ...]) -> Any:
        references = [argument.reference if isinstance(argument, Shared) else argument for argument in arguments]
        return getattr(self._actors[worker], method).remote(*references)

    def _replace(self, worker: int, n_losses: int, error: Exception, replaced: Callable[[int], None] | None) -> int:
        """
        :param worker: its number
        :param n_losses: with the same question, before this one
        :param error: that tells of the loss
        :param replaced: of :meth:`ask`
        :return: losses with the same question
        """
        while True:
            n_losses += 1
            self._check_replaceable(worker, n_losses, error, replaced)
            warnings.warn(f"Worker {worker} was lost ({_first_line(error)}); another collects its share again.", stacklevel=4)
            try:
                self._actors[worker] = self._new_actor(worker, is_replacement=True)
                self.ask("start", [()], workers=[worker], patience=_SECONDS_TO_START)
                assert replaced is not None
                replaced(worker)
                return n_losses
            except WorkersLostError as loss:
                if not isinstance(loss.__cause__, self._signs_of_loss()):
                    raise
                # The new worker in its turn: it may have begun on the same machine, while that went down
                error = loss.__cause__

    def _check_replaceable(self, worker: int, n_losses: int, error: Exception, replaced: Callable[[int], None] | None) -> None:
        self._check_ray()
        if replaced is None:
            raise WorkersLostError(f"Worker {worker} was lost ({_first_line(error)})") from error
        if n_losses >= _MOST_LOSSES:
            raise WorkersLostError(
                f"Worker {worker} was lost {n_losses} times with the same share ({_first_line(error)}); look for an "
                "environment that crashes or takes too much memory."
            ) from error

    def _signs_of_loss(self) -> tuple[type[Exception], ...]:
        exceptions = self._ray.exceptions
        return (
            exceptions.RayActorError,
            exceptions.WorkerCrashedError,
            exceptions.NodeDiedError,
            exceptions.ObjectLostError,
            exceptions.LocalRayletDiedError,
            exceptions.OutOfMemoryError,
        )

    def _is_the_same_ray(self) -> bool:
        return self._ray.is_initialized() and self._ray.get_runtime_context().gcs_address == self._gcs_address

    def _check_ray(self) -> None:
        """Ray itself would start another one, or end this process a minute after it lost its cluster."""
        if not self._is_the_same_ray():
            raise WorkersLostError("Ray has been shut down, and the workers with it.")
        host, _, port = self._gcs_address.rpartition(":")
        try:
            socket.create_connection((host.strip("[]"), int(port)), timeout=10.0).close()
        except OSError as error:
            self._ray.shutdown()
            raise WorkersLostError(f"Ray at {self._gcs_address} is gone ({error}), and the workers with it.") from error

    def _no_place(self, n_missing: int, seconds: float) -> str:
        cpus = [resources().get("CPU", 0) for resources in (self._ray.available_resources, self._ray.cluster_resources)]
        return (
            f"{n_missing} of {len(self)} workers of {self._cpus_per_worker} CPU each have not started in {seconds:.0f} s; "
            f"Ray has {cpus[0]:g} of {cpus[1]:g} CPUs free. If it has no place for them, add machines or use fewer workers."
        )


def _first_line(error: Exception) -> str:
    """What follows are pages of where to look for logs."""
    return str(error).strip().partition("\n")[0]


def ensure_ray(n_cpus: int) -> ModuleType:
    """
    Use the Ray that is there: that of this process, of ``RAY_ADDRESS``, or of ``ray start`` on this machine. Else start one.

    :param n_cpus: that are needed
    :return: the module
    :raises ImportError: if Ray is not installed
    """
    ray = import_ray()
    if not ray.is_initialized():
        try:
            ray.init(num_cpus=max(n_cpus, os.cpu_count() or 1), include_dashboard=False)
        except ValueError:
            # There is a cluster, whose size is not ours to say
            ray.init()
    return ray


def import_ray() -> ModuleType:
    """
    :return: the module
    :raises ImportError: if Ray is not installed
    """
    # Nothing here reports to anybody unless the user asks for it
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    if "ray" not in sys.modules:
        # Else Ray takes a process whose parent has ended, as in a container or after `nohup`, for a worker whose raylet has
        # ended, and when the cluster is gone ends it without a word. Read on import
        os.environ["RAY_RAYLET_PID"] = str(os.getpid())
    try:
        import ray
    except ImportError as error:
        raise ImportError('Workers need Ray: pip install "sb3-gae[ray]"') from error
    return ray
