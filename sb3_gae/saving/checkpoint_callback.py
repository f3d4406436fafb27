"""A callback that lets no training be lost."""

import os
import warnings
from pathlib import Path
from typing import cast

from stable_baselines3.common.callbacks import BaseCallback

from sb3_gae.callback_tree import check_hears_of_rollouts
from sb3_gae.checks import check_choice, check_count
from sb3_gae.errors import WorkersLostError
from sb3_gae.saving.atomic_write import write_atomically
from sb3_gae.saving.callback_state import CallbackStates, callback_states, restore_callbacks
from sb3_gae.saving.checkpoint_file import (
    checkpoint_content,
    checkpoint_path,
    checkpoints_in,
    is_whole,
    read_checkpoint,
    timesteps_of,
)
from sb3_gae.saving.deferred_signals import DeferredSignals
from sb3_gae.saving.resumable import ResumableModel
from sb3_gae.saving.training_state import restore_log, training_state

_NOTICE = "\nTraining ends after this iteration, with a checkpoint. Once more ends it at once.\n"


class ResumableCheckpointCallback(BaseCallback):
    """
    Saves checkpoints from which :meth:`TRPOGAE.resume() <sb3_gae.TRPOGAE.resume>` goes on bit for bit.

    Between two iterations, when ``save_freq`` calls of ``env.step()`` or more have been made since the last one, and at the
    beginning and the end of training (unless another callback ends it in the middle of an iteration), and where Ray workers
    were lost for good. SIGTERM and
    Ctrl-C are kept until the next iteration begins, and then do what they always do, after a checkpoint and a message that
    says how to continue; the second one counts at once.

    A checkpoint appears under its name when it is all on the disk. Older ones are deleted once the new one has been read
    again. If one cannot be written or deleted, there is a warning and the training goes on.

    :param save_freq: calls of ``env.step()`` from one checkpoint to the next, as in SB3's ``CheckpointCallback``
    :param save_path: folder of the checkpoints of one training
    :param name_prefix: of their names
    :param keep: number of checkpoints to keep
    :param handle_signals: whether to keep SIGTERM and Ctrl-C until the end of an iteration
    :param verbose: 0 no output but on SIGTERM and Ctrl-C, 1 for each checkpoint
    :raises ValueError: if a number is out of range; in ``learn``, if it is in another callback that does not tell it of
        rollouts, or the folder has checkpoints of a training that is ahead
    """

    def __init__(
        self,
        save_freq: int,
        save_path: str | os.PathLike[str],
        name_prefix: str = "rl_model",
        keep: int = 3,
        handle_signals: bool = True,
        verbose: int = 0,
    ):
        super().__init__(verbose)
        check_count("save_freq", save_freq)
        check_count("keep", keep)
        check_choice("handle_signals", handle_signals, (False, True))
        self.save_freq = save_freq
        self.save_path = Path(save_path)
        self.name_prefix = name_prefix
        self.keep = keep
        self.handle_signals = handle_signals
        self._next_save = 0
        self._last_saved = -1
        self._rollout_start = (-1, -1)
        self._signals = DeferredSignals(notice=_NOTICE)
        self._fresh: list[CallbackStates] = []

    def _init_callback(self) -> None:
        if not isinstance(self.model, ResumableModel):
            raise TypeError(f"{type(self).__name__} needs a TRPOGAE, got {type(self.model).__name__}; use CheckpointCallback.")
        check_hears_of_rollouts(self)
        self.save_path.mkdir(parents=True, exist_ok=True)

    def _on_training_start(self) -> None:
        self._fresh = []
        check_hears_of_rollouts(self)
        self._check_folder()
        root = self.locals["callback"]
        self._next_save, self._last_saved = self.n_calls, -1
        self._fresh = [callback_states(root)]
        if (resumed := self._resumable.take_resumed()) is not None:
            restore_callbacks(root, resumed["callbacks"])
            restore_log(self.logger, resumed["log"])
            self._next_save = self.n_calls
            if is_whole(self._path):
                # What was resumed from
                self._next_save, self._last_saved = self.n_calls + self.save_freq, self.model.num_timesteps
        self._resumable.when_workers_are_lost(self._save_what_is_left)
        if self.handle_signals:
            self._signals.install()
            self._resumable.when_learning_ends(self._signals.restore)

    def _check_folder(self) -> None:
        newer = [
            path
            # Whatever their prefix: `resume` takes the newest in the folder
            for path in checkpoints_in(self.save_path)
            if timesteps_of(path) > self.model.num_timesteps and is_whole(path)
        ]
        if newer:
            raise ValueError(
                f"`save_path` = {str(self.save_path)!r} has checkpoints of a training that is ahead, such as {newer[0].name}. "
                "Continue it with TRPOGAE.resume (in rl-zoo3 with --trained-agent and a checkpoint), take another folder, or "
                "delete them."
            )

    def _on_rollout_start(self) -> None:
        self._rollout_start = self._progress
        if self.n_calls >= self._next_save or self._signals.pending is not None:
            self._save()
        self._end_if_asked()

    def _on_step(self) -> bool:
        return True

    def _on_training_end(self) -> None:
        if not self._fresh:
            # rl-zoo3 also tells of the end where an error has kept training from starting, which this must not hide
            return
        updates = self._rollout_start[1]
        # In the middle of a rollout there is nothing to go on from: its steps would be missing
        if self._progress == self._rollout_start or self._progress[1] > updates:
            self._save()
        self._end_if_asked()

    def _save(self) -> None:
        path = self._path
        if self._last_saved == self.model.num_timesteps:
            return
        self._next_save = self.n_calls + self.save_freq
        states = callback_states(self.locals["callback"], self._fresh[0])
        try:
            content = checkpoint_content(self.model, training_state(self.model, states))
            write_atomically(path, content, self.save_path / f".{self.name_prefix}.tmp")
            read_checkpoint(path)
        except (OSError, ValueError) as error:
            # At the next iteration again
            self._next_save = self.n_calls
            warnings.warn(f"No checkpoint could be written: {error} Training goes on.", stacklevel=2)
            return
        self._last_saved = self.model.num_timesteps
        if self.verbose >= 1:
            print(f"Saving checkpoint to {path}")
        self._delete_old()

    def _save_what_is_left(self) -> str:
        said = []
        try:
            self._save()
        except WorkersLostError:
            # As they do after `env_method` and `set_attr`, until the next batch
            said.append("No checkpoint could be written: only the workers knew where the environments stood.")
        else:
            if not is_whole(self._path):
                said.append("No checkpoint could be written.")
        # The one of now, or one before
        if whole := self._whole_checkpoints():
            kind = type(self.model).__name__
            said.append(f"Make environments anew, and continue with {kind}.resume({str(whole[0])!r}, env).")
        return " ".join(said)

    def _whole_checkpoints(self) -> list[Path]:
        """Newest first; what is not ours is not among them."""
        return [path for path in checkpoints_in(self.save_path, self.name_prefix) if is_whole(path)]

    def _delete_old(self) -> None:
        """None that is needed in the place of a damaged one."""
        for path in self._whole_checkpoints()[self.keep :]:
            try:
                path.unlink(missing_ok=True)
            except OSError as error:
                warnings.warn(f"The old checkpoint {path} could not be deleted, and stays: {error}", stacklevel=3)

    def _end_if_asked(self) -> None:
        if (number := self._signals.pending) is None:
            return
        folder, kind = str(self.save_path), type(self.model).__name__
        left = self._resumable.remaining_timesteps
        print(
            f"Stopped by {number.name} after {self.model.num_timesteps} timesteps; {left} are left. To continue, in place of "
            f"making a new model:\n"
            f"    model = {kind}.resume({folder!r}, env)\n"
            f"    model.learn(model.remaining_timesteps, callback=callback, reset_num_timesteps=False)\n"
            f"or in rl-zoo3 with --trained-agent and the newest checkpoint in {folder}.",
            flush=True,
        )
        self._signals.deliver()

    @property
    def _path(self) -> Path:
        return checkpoint_path(self.save_path, self.name_prefix, self.model.num_timesteps)

    @property
    def _progress(self) -> tuple[int, int]:
        return self.n_calls, self.model._n_updates

    @property
    def _resumable(self) -> ResumableModel:
        return cast(ResumableModel, self.model)
