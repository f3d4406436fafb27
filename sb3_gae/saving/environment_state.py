"""
The state of environments, so that a later process can go on where this one stopped.

An environment, a wrapper or a ``VecEnv`` with the methods ``state_dict`` and ``load_state_dict`` says itself what its
state is, apart from what it wraps, or gives None if it cannot. Of all others in a ``DummyVecEnv`` the attributes are taken,
if they can be pickled.
"""

import io
import pickle
import types
from collections.abc import Iterator
from typing import Any, NamedTuple, cast

import gymnasium as gym
from stable_baselines3.common.monitor import ResultsWriter
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecEnvWrapper

# What every vectorised environment keeps for the next reset
_OF_VEC_ENVS = ("_seeds", "_options", "reset_infos")

# Belong to the process, or to how the environment was made
_NO_STATE = frozenset({"t_start", "class_attributes", "render_mode", "spec", "_cached_spec", "_saved_kwargs"})
_NO_STATE_TYPES = (types.FunctionType, ResultsWriter)


class EnvironmentState(NamedTuple):
    """
    :param structure: names of the classes of all layers, from the outside in
    :param wrappers: state of the wrappers of the vectorised environment, normalization statistics among them
    :param envs: state of the environments; None if they cannot give it
    """

    structure: list[str]
    wrappers: bytes
    envs: bytes | None


def environment_state(env: VecEnv) -> EnvironmentState:
    """
    :param env: environments in their wrappers
    :return: their state
    """
    wrappers, inner = _vec_env_layers(env), _inner_layers(env)
    layers = [*wrappers, *inner]
    states = [dict(_pickled_one_by_one(wrapper, layers)) for wrapper in wrappers]
    return EnvironmentState(_structure(layers), pickle.dumps(states), _pickled_together(inner, layers))


def restore_environment(env: VecEnv, state: EnvironmentState) -> bool:
    """
    :param env: made as the one that the state is of, in the same wrappers
    :param state: to go on from
    :return: whether the environments stand where they stood; False if they could not say where, and must be reset
    :raises ValueError: if the environment is built otherwise
    """
    wrappers, inner = _vec_env_layers(env), _inner_layers(env)
    layers = [*wrappers, *inner]
    if (found := _structure(layers)) != state.structure:
        raise ValueError(
            f"`env` must be made as that of the checkpoint, of {_summary(state.structure)}, but is of {_summary(found)}."
        )
    for wrapper, blobs in zip(wrappers, pickle.loads(state.wrappers), strict=True):
        vars(wrapper).update({name: _loads(blob, layers) for name, blob in blobs.items()})
    if state.envs is None:
        return False
    for layer, (attributes, own) in zip(inner, _loads(state.envs, layers), strict=True):
        vars(layer).update(attributes)
        if own is not None:
            layer.load_state_dict(own)
    return True


def _vec_env_layers(env: VecEnv) -> list[VecEnvWrapper]:
    layers = []
    while isinstance(env, VecEnvWrapper):
        layers.append(env)
        env = env.venv
    return layers


def _inner_layers(env: VecEnv) -> list[Any]:
    """The vectorised environment without its wrappers, and the layers of each environment in it, in this process."""
    base = env.unwrapped
    return [base, *(layer for inner in getattr(base, "envs", []) for layer in _env_layers(inner))]


def _env_layers(env: gym.Env) -> Iterator[gym.Env]:
    yield env
    while isinstance(env, gym.Wrapper):
        env = env.env
        yield env


def _structure(layers: list[Any]) -> list[str]:
    return [f"{type(layer).__module__}.{type(layer).__qualname__}" for layer in layers]


def _summary(structure: list[str]) -> str:
    """Each class once, with how often it comes."""
    return ", ".join(f"{structure.count(name)} {name.rpartition('.')[2]}" for name in dict.fromkeys(structure))


def _pickled_one_by_one(wrapper: VecEnvWrapper, layers: list[Any]) -> Iterator[tuple[str, bytes]]:
    """What cannot be pickled, such as a file that a wrapper writes to, stays as the new wrapper has it."""
    for name, value in _attributes(wrapper).items():
        try:
            yield name, _dumps(value, layers)
        except Exception:
            continue


def _pickled_together(inner: list[Any], layers: list[Any]) -> bytes | None:
    """All or nothing: half of a state is none."""
    base = inner[0]
    if not (isinstance(base, DummyVecEnv) or _speaks_for_itself(base)):
        return None
    states = []
    for layer in inner:
        own = layer.state_dict() if _speaks_for_itself(layer) else None
        if own is None and _speaks_for_itself(layer):
            return None
        if isinstance(layer, VecEnv):
            attributes = {name: vars(layer)[name] for name in _OF_VEC_ENVS}
        else:
            attributes = _attributes(layer) if own is None else {}
        states.append((attributes, own))
    try:
        return _dumps(states, layers)
    except Exception:
        return None


def _speaks_for_itself(layer: Any) -> bool:
    return all(callable(getattr(type(layer), name, None)) for name in ("state_dict", "load_state_dict"))


def _attributes(layer: Any) -> dict[str, Any]:
    return {
        name: value for name, value in vars(layer).items() if name not in _NO_STATE and not isinstance(value, _NO_STATE_TYPES)
    }


def _dumps(value: Any, layers: list[Any]) -> bytes:
    memory = io.BytesIO()
    _Pickler(memory, layers).dump(value)
    return memory.getvalue()


def _loads(content: bytes, layers: list[Any]) -> Any:
    return _Unpickler(io.BytesIO(content), layers).load()


class _Pickler(pickle.Pickler):
    """Writes the place of a layer where a state refers to it: the layer itself is there already when a state is restored."""

    def __init__(self, file: io.BytesIO, layers: list[Any]):
        super().__init__(file, pickle.HIGHEST_PROTOCOL)
        self._places = {id(layer): place for place, layer in enumerate(layers)}

    def persistent_id(self, value: Any) -> int | None:
        return self._places.get(id(value))


class _Unpickler(pickle.Unpickler):
    def __init__(self, file: io.BytesIO, layers: list[Any]):
        super().__init__(file)
        self._layers = layers

    def persistent_load(self, place: Any) -> Any:
        return self._layers[cast(int, place)]
