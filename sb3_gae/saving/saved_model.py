"""Saved files are looked at before they are used, and parameters are replaced wholly or not at all."""

import copy
import io
import pathlib
from typing import Any, Self

import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.type_aliases import GymEnv, TensorDict

from sb3_gae.saving.saved_file import check_saved_file


class SavedModel(BaseAlgorithm):
    """To be inherited before an algorithm of SB3."""

    def set_parameters(
        self, load_path_or_dict: str | TensorDict, exact_match: bool = True, device: th.device | str = "auto"
    ) -> None:
        """
        As SB3's, but all or nothing: if anything does not fit, every parameter is as it was.

        :param load_path_or_dict: a saved file, or what ``get_parameters`` returns
        :param exact_match: whether every parameter must be given
        :param device: on which to load
        :raises ValueError: if something does not fit, or the file is damaged
        :raises FileNotFoundError: if there is no such file
        """
        if not isinstance(load_path_or_dict, dict):
            check_saved_file(load_path_or_dict, own=False)
        before = copy.deepcopy(self.get_parameters())
        try:
            super().set_parameters(load_path_or_dict, exact_match, device)
        except Exception:
            super().set_parameters(before)  # type: ignore[arg-type]
            raise

    @classmethod
    def load(cls, path: str | pathlib.Path | io.BufferedIOBase, env: GymEnv | None = None, *args: Any, **kwargs: Any) -> Self:
        """
        As SB3's, after looking whether the file is whole and one of ours.

        :param path: a saved file
        :param env: to continue training on
        :param args: as SB3's
        :param kwargs: as SB3's; further ones replace what was saved
        :return: a new model
        :raises ValueError: if the file is damaged, or was saved by another algorithm
        :raises FileNotFoundError: if there is no such file
        """
        check_saved_file(path)
        return super().load(path, env, *args, **kwargs)
