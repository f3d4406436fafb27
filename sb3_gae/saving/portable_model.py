"""A model as weights and settings, for those who do not trust each other."""

import json
import os
import re
from contextlib import closing
from numbers import Real
from pathlib import Path
from typing import Any, Self, cast

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.type_aliases import GymEnv
from torch import nn

from sb3_gae.checks import check_choice, check_number
from sb3_gae.saving.atomic_write import write_atomically
from sb3_gae.saving.weights_file import WeightsFile, read_weights, weights_content

_SETTINGS = (
    *("n_steps", "gamma", "gae_lambda", "value_lambda", "target_kl", "cg_max_steps", "cg_damping", "cg_tolerance"),
    *("line_search_shrinking_factor", "line_search_max_iter", "normalize_advantage", "sub_sampling_factor"),
    *("vf_trust_region", "vf_steps", "vf_cg_max_steps", "vf_cg_damping", "vf_kl_fraction", "vf_optimizer"),
    *("normalize_value", "curvature_samples", "n_episodes", "baseline", "value_fit_first", "use_sde", "sde_sample_freq"),
)
_MAY_BE_NONE = ("value_lambda", "curvature_samples", "n_episodes")
_OF_ADAM = ("learning_rate", "batch_size", "n_critic_updates")
_FLAGS = ("ortho_init", "full_std", "use_expln", "squash_output", "share_features_extractor", "normalize_images")
_ACTIVATIONS = {kind.__name__: kind for kind in (nn.Tanh, nn.ReLU, nn.ELU, nn.LeakyReLU, nn.SiLU, nn.GELU, nn.Sigmoid)}


class PortableModel(OnPolicyAlgorithm):
    """To be inherited before ``OnPolicyAlgorithm``."""

    def save_weights(self, path: str | os.PathLike[str]) -> None:
        """
        Write weights and settings to a file that holds nothing to execute. What else a training needs is not in it.

        :param path: of the file; ``.safetensors`` is usual
        :raises ValueError: if policy or settings cannot be written so; ``save`` can write everything
        :raises OSError: if the file cannot be written; what was there before is still there
        """
        aliases = [name for name, kind in self.policy_aliases.items() if kind is self.policy_class]
        if not aliases:
            raise ValueError(
                f"{self.policy_class.__name__} is no policy of {type(self).__name__} with a name; use `save` for policies of "
                "your own."
            )
        settings = {name: _plain(getattr(self, name)) for name in (*_SETTINGS, *_OF_ADAM)}
        settings |= {"policy": aliases[0], "policy_kwargs": _written_policy_kwargs(self.policy_kwargs)}
        settings["learning_rate"] = _written_learning_rate(settings["learning_rate"], settings["vf_optimizer"])
        place = Path(path)
        write_atomically(place, weights_content(self.policy.state_dict(), settings), place.with_name(f".{place.name}.tmp"))

    @classmethod
    def load_weights(
        cls, path: str | os.PathLike[str], env: GymEnv | str, device: th.device | str = "auto", **kwargs: Any
    ) -> Self:
        """
        A new model with the weights and settings of a file that may be from anybody: nothing in it is executed.

        :param path: written by :meth:`save_weights`, or by ``save``: of that file what is plain is read
        :param env: with the spaces of the model
        :param device: on which to run
        :param kwargs: arguments of the algorithm, in place of those in the file. ``policy``, ``policy_kwargs`` and
            ``learning_rate`` are needed where a file of ``save`` has others than the defaults, as far as these are pickled
            there, as every schedule is
        :return: the model; its optimiser begins anew, and is Adam unless ``policy_kwargs`` are given and say otherwise
        :raises ValueError: if the file is damaged, or does not fit
        :raises TypeError: if an argument in ``kwargs`` is unknown
        """
        file = read_weights(Path(path).read_bytes())
        arguments = _checked_arguments(cls, file) | kwargs
        if "policy_kwargs" not in arguments:
            # Only then: what is passed may stand for what cannot be read
            arguments["policy_kwargs"] = _read_policy_kwargs(_without_optimizer(file.settings.get("policy_kwargs")))
        arguments["policy_kwargs"] = policy_kwargs = dict(arguments["policy_kwargs"] or {})
        _check_size(policy_kwargs, file.tensors)
        policy = arguments.pop("policy", None)
        try:
            model = cls(policy or _policy_for(env), env, device=device, **arguments)
        except (MemoryError, TypeError, AssertionError, OverflowError) as error:
            if any(f"unexpected keyword argument {name!r}" in str(error) for name in kwargs):
                # It says what is wrong, and the file is not at fault: of its settings only known ones are taken
                raise
            own = f" with your {', '.join(map(repr, kwargs))}" if kwargs else ""
            raise ValueError(f"The settings in {path}{own} make no model: {error}") from error
        try:
            model.policy.load_state_dict(file.tensors)
        except RuntimeError as error:
            raise ValueError(f"The weights in {path} do not fit `env` or `policy_kwargs`: {error}") from error
        return model


def _written_policy_kwargs(policy_kwargs: dict[str, Any]) -> dict[str, Any]:
    written = _plain(policy_kwargs)
    if (activation := written.get("activation_fn")) is not None:
        written["activation_fn"] = getattr(activation, "__name__", repr(activation))
    _read_policy_kwargs(json.loads(json.dumps(written, default=repr)))
    return written


def _written_learning_rate(learning_rate: Any, vf_optimizer: str) -> float | None:
    if isinstance(learning_rate, Real):
        return float(learning_rate)
    if vf_optimizer == "adam":
        raise ValueError(
            "`learning_rate` is a schedule, which cannot be kept without pickle; use `save` and `load`, or set "
            "`model.learning_rate` to a number."
        )
    # It has no effect
    return None


def _plain(value: Any) -> Any:
    """Numbers of NumPy as those of Python, which JSON can write."""
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, dict):
        return {name: _plain(part) for name, part in value.items()}
    return [_plain(part) for part in value] if isinstance(value, list | tuple) else value


def _checked_arguments(cls: type[OnPolicyAlgorithm], file: WeightsFile) -> dict[str, Any]:
    """Values that are no more than numbers and words; that they are in range is for the constructor to see."""
    uses_adam = file.settings.get("vf_optimizer") == "adam"
    arguments: dict[str, Any] = {}
    for name in (*_SETTINGS, *(_OF_ADAM if uses_adam else ())):
        value = file.settings.get(name)
        if isinstance(value, bool | int | float | str) or (value is None and name in file.settings and name in _MAY_BE_NONE):
            arguments[name] = value
    if "learning_rate" in arguments:
        # The constructor hands it to torch as it is
        check_number("learning_rate", arguments["learning_rate"], 0.0, below=True)
    if isinstance(arguments.get("gae_lambda"), str):
        raise ValueError("`gae_lambda` in the file must be a number.")
    if (policy := file.settings.get("policy")) is not None:
        check_choice("policy", policy, tuple(cls.policy_aliases))
        arguments["policy"] = policy
    return arguments


def _without_optimizer(written: Any) -> Any:
    """The optimiser begins anew, with what it is made from."""
    if not isinstance(written, dict):
        return {} if written is None else written
    return {name: value for name, value in written.items() if name not in ("optimizer_class", "optimizer_kwargs")}


def _read_policy_kwargs(written: Any) -> dict[str, Any]:
    """
    :param written: in the file
    :return: as the policy takes them
    :raises ValueError: if there is anything but sizes of layers, numbers and the name of an activation
    """
    if not isinstance(written, dict):
        raise ValueError(f"`policy_kwargs` in the file must be a dictionary, got {written!r}.")
    found: dict[str, Any] = {}
    for name, value in written.items():
        if name == "activation_fn":
            # SB3 writes the class as Python shows it
            word = re.fullmatch(r"(?:<class 'torch\.nn\.modules\.activation\.)?(\w+)(?:'>)?", str(value))
            check_choice("activation_fn", word and word[1], tuple(_ACTIVATIONS))
            found[name] = _ACTIVATIONS[cast(re.Match[str], word)[1]]
        elif _is_plain_argument(name, value):
            found[name] = value
        else:
            raise ValueError(f"`policy_kwargs[{name!r}]` = {value!r} cannot be kept without pickle; use `save` and `load`.")
    return found


def _is_plain_argument(name: str, value: Any) -> bool:
    if name == "net_arch":
        return all(map(_are_widths, value.values() if isinstance(value, dict) else [value]))
    if name == "log_std_init":
        return type(value) in (int, float)
    return name in _FLAGS and isinstance(value, bool)


def _are_widths(value: Any) -> bool:
    return isinstance(value, list) and all(type(width) is int and width > 0 for width in value)


def _check_size(policy_kwargs: dict[str, Any], tensors: dict[str, th.Tensor]) -> None:
    """Before layers are made that a small file could say to be huge."""
    net_arch = policy_kwargs.get("net_arch") or []
    branches = list(net_arch.values()) if isinstance(net_arch, dict) else [net_arch]
    n_weights = sum(tensor.numel() for tensor in tensors.values())
    for widths in branches:
        n_needed = sum(one * other for one, other in zip([1, *widths], widths, strict=False))
        if n_needed > n_weights:
            raise ValueError(f"`net_arch` = {net_arch} would have more weights than there are: {n_weights}.")


def _policy_for(env: GymEnv | str) -> str:
    if isinstance(env, str):
        with closing(gym.make(env)) as made:
            return _policy_for(made)
    space = getattr(env, "observation_space", None)
    if isinstance(space, spaces.Dict):
        return "MultiInputPolicy"
    return "CnnPolicy" if isinstance(space, spaces.Box) and is_image_space(space) else "MlpPolicy"
