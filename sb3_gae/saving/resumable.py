"""Training that goes on from a checkpoint as if it had not stopped."""

import io
import os
import pickle
import warnings
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any, ClassVar, Self

import torch as th
from stable_baselines3.common.base_class import maybe_make_env
from stable_baselines3.common.type_aliases import GymEnv

from sb3_gae.errors import WorkersLostError
from sb3_gae.saving.checkpoint_file import newest_checkpoint, state_in
from sb3_gae.saving.environment_state import restore_environment
from sb3_gae.saving.random_state import restore_random_state
from sb3_gae.saving.saved_model import SavedModel
from sb3_gae.saving.training_state import seed_of_continuation


class ResumableModel(SavedModel):
    """To be inherited before an algorithm of SB3."""

    #: names of attributes that no file keeps
    _of_the_process: ClassVar[tuple[str, ...]] = ("_end_of_learning", "_rescue", "_resumed", "learn")

    _end_of_learning: ExitStack | None = None
    _rescue: Callable[[], str] | None = None
    _resumed: dict[str, Any] | None = None

    @classmethod
    def resume(
        cls,
        path: str | os.PathLike[str],
        env: GymEnv | str,
        device: th.device | str = "auto",
        force_reset: bool = False,
        **kwargs: Any,
    ) -> Self:
        """
        A model that stands where a training stood when it wrote a checkpoint.

        .. code-block:: python

            model = TRPOGAE.resume("checkpoints", env)
            model.learn(model.remaining_timesteps, callback=callback, reset_num_timesteps=False)

        The file is unpickled, which can execute anything: only resume what you have written yourself.

        :param path: folder that :class:`~sb3_gae.ResumableCheckpointCallback` wrote to, for the newest checkpoint that is
            whole; or one checkpoint
        :param env: made as that of the training, in the same wrappers, or its id if the model made it of one; its state comes
            from the checkpoint
        :param device: on which to run
        :param force_reset: whether to begin new episodes although the environments could go on with theirs
        :param kwargs: as for ``load``; they replace what was saved
        :return: a new model
        :raises FileNotFoundError: if there is no checkpoint
        :raises ValueError: if none is whole, or the environment is another, or none
        """
        if env is None:
            raise ValueError("`env` must be an environment made as that of the training, in the same wrappers, got None.")
        file, content = newest_checkpoint(path)
        model = cls.load(io.BytesIO(content), env=maybe_make_env(env, verbose=0), device=device, force_reset=False, **kwargs)
        state = pickle.loads(state_in(content))
        made = model.get_env()
        assert made is not None
        if not restore_environment(made, state["environment"]):
            warnings.warn(
                f"{file} has no state of the environments, as they could not give one: they begin new episodes.", stacklevel=2
            )
            force_reset = True
        if force_reset:
            made.seed(seed_of_continuation(model))
            model._last_obs = None
        model._resumed = state
        # Last, as everything before may draw random numbers
        restore_random_state(state["random"])
        return model

    @property
    def remaining_timesteps(self) -> int:
        """What is left of the last ``learn``, to be given to the next after :meth:`resume`."""
        return max(0, self._total_timesteps - self.num_timesteps)

    @property
    def is_resumed(self) -> bool:
        """Whether :meth:`resume` made this model and it has not learnt since with a callback that knows of it."""
        return self._resumed is not None

    def take_resumed(self) -> dict[str, Any] | None:
        """
        :return: what :meth:`resume` found beside the model, once
        """
        resumed, self._resumed = self._resumed, None
        return resumed

    def when_learning_ends(self, clean_up: Callable[[], None]) -> None:
        """
        For callbacks, which SB3 does not tell when an error ends ``learn``.

        :param clean_up: called at the end of the present ``learn``, however it ends
        """
        assert self._end_of_learning is not None, "nothing is being learnt"
        self._end_of_learning.callback(clean_up)

    def when_workers_are_lost(self, rescue: Callable[[], str]) -> None:
        """
        :param rescue: called if the present ``learn`` ends because workers are lost. The model is then as it was at the
            beginning of the iteration. Returns a sentence that says how to go on
        """
        self._rescue = rescue

    def learn(self, *args: Any, **kwargs: Any) -> Self:
        """
        As the algorithm's own; at its end, whatever that is, it sees to what callbacks have asked for.

        :param args: as the algorithm's
        :param kwargs: as the algorithm's
        :return: this model
        :raises WorkersLostError: if workers are lost; the message says how to go on
        """
        self._rescue = None
        with ExitStack() as self._end_of_learning:
            try:
                return super().learn(*args, **kwargs)  # type: ignore[safe-super]
            except WorkersLostError as error:
                advice = "No checkpoint was written; ResumableCheckpointCallback would have."
                raise WorkersLostError(f"{error} {self._rescue() if self._rescue else advice}") from error

    def __getstate__(self) -> dict[str, Any]:
        # A copy, such as callbacks keep of the best model, is of no training that could end or be rescued
        of_the_training = set(self._of_the_process) - {"_resumed"}
        return {name: value for name, value in vars(self).items() if name not in of_the_training}

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), *self._of_the_process]
