"""One cell as rl-zoo3 would train it: ``python -m rl_zoo3.train --algo trpo_gae --env TASK -params ...``."""

import contextlib
import io
import time
from argparse import Namespace
from collections.abc import Callable
from typing import Any

from rl_zoo3.exp_manager import ExperimentManager
from stable_baselines3.common.utils import set_random_seed

import sb3_gae.zoo
from sb3_gae.sweep.grid import Cell
from sb3_gae.sweep.plan import Options
from sb3_gae.sweep.recorder import Recorder, Row
from sb3_gae.sweep.settings import as_json
from sb3_gae.trpo_gae import TRPOGAE


class _Manager(ExperimentManager):
    """rl-zoo3's, without files: neither monitors nor a folder of settings for each of a thousand runs."""

    def create_envs(self, n_envs: int, eval_env: bool = False, no_log: bool = False) -> Any:
        self.vec_env_kwargs = self.vec_env_kwargs | self._threads()
        return super().create_envs(n_envs, eval_env, no_log=True)

    def _threads(self) -> dict[str, int]:
        """Known only once the settings are read."""
        if getattr(self, "rollout_workers", None) is not None:
            return {"cpus_per_worker": self.args.threads}
        # Others have no threads to set
        return {"n_threads": self.args.threads} if getattr(self, "batched_envs", False) else {}

    def create_log_folder(self) -> None:
        pass

    def _save_config(self, saved_hyperparams: dict[str, Any]) -> None:
        pass


class Experiment:
    """
    A model and its environments, ready to learn.

    :param cell: to be run
    :param options: how
    """

    def __init__(self, cell: Cell, options: Options):
        start = time.perf_counter()
        sb3_gae.zoo.register()
        set_random_seed(cell.seed)
        self.cell = cell
        manager = _Manager(
            Namespace(threads=options.threads),
            sb3_gae.zoo.ALGO,
            cell.task,
            log_folder="",
            eval_freq=-1,
            hyperparams=cell.hyperparameters,
            seed=cell.seed,
            verbose=0,
            device=options.device,
            config=options.conf_file,
        )
        with contextlib.redirect_stdout(io.StringIO()):
            made = manager.setup_experiment()
        assert made is not None
        model, settings = made
        assert isinstance(model, TRPOGAE)
        self.model: TRPOGAE = model
        #: hyperparameters, those of the file included, fit for JSON
        self.settings = as_json(settings)
        self._callbacks = manager.callbacks
        #: seconds that it took to make
        self.seconds = time.perf_counter() - start

    @property
    def largest_batch(self) -> int:
        """Steps of all environments that an iteration takes at most."""
        return self.model.n_steps * self.model.n_envs

    def run(self, on_row: Callable[[Row], None], on_step: Callable[[], None] = lambda: None) -> None:
        """
        Train for the iterations of the cell and close the environments.

        :param on_row: called after each iteration
        :param on_step: called at each step; may raise to end the run
        """
        recorder = Recorder(self.cell.iterations, on_row, on_step)
        try:
            # Batches of whole episodes are smaller than this, and the recorder ends the training
            total = self.cell.iterations * self.largest_batch
            self.model.learn(total, callback=[*self._callbacks, recorder], log_interval=None)  # type: ignore[arg-type]
        finally:
            assert self.model.env is not None
            self.model.env.close()
