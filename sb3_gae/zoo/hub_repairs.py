"""
Repairs of rl-zoo3's hub verbs, which fail for every algorithm with sb3-team-hf-integration 3 and huggingface_hub 2.

Both add to what is there and take nothing away, and both do nothing where upstream has caught up.
"""

import functools
from types import ModuleType
from typing import Any


def repair_hub_verbs(huggingface_sb3: ModuleType) -> None:
    """
    Let ``rl_zoo3.push_to_hub`` be imported, and ``rl_zoo3.load_from_hub`` load agents without ``VecNormalize``.

    :param huggingface_sb3: the package of sb3-team-hf-integration
    """
    supply_generate_metadata(huggingface_sb3.push_to_hub.__globals__)
    let_missing_files_be_http_errors(huggingface_sb3)


def supply_generate_metadata(names: dict[str, Any]) -> None:
    """
    rl-zoo3 imports ``generate_metadata``. It has become ``_generate_metadata``, which returns an object in place of a
    dictionary.

    :param names: the globals of ``huggingface_sb3.push_to_hub``, a module that a function of that name hides
    """
    generate = names.get("_generate_metadata")
    if generate is None or "generate_metadata" in names:
        return

    @functools.wraps(generate)
    def generate_metadata(*args: Any, **kwargs: Any) -> dict[str, Any]:
        return generate(*args, **kwargs).to_dict()

    names["generate_metadata"] = generate_metadata


def let_missing_files_be_http_errors(huggingface_sb3: ModuleType) -> None:
    """
    rl-zoo3 takes an ``HTTPError`` of requests for "there are no normalization statistics". huggingface_hub no longer
    uses requests, so let what it raises be one as well.

    :param huggingface_sb3: the package whose ``load_from_hub`` rl-zoo3 calls
    """
    from huggingface_hub.errors import EntryNotFoundError
    from requests.exceptions import HTTPError

    load = huggingface_sb3.load_from_hub
    if issubclass(EntryNotFoundError, HTTPError) or hasattr(load, "__wrapped__"):
        return

    class MissingFileError(EntryNotFoundError, HTTPError):
        """Still what huggingface_hub raises, and what rl-zoo3 expects."""

    @functools.wraps(load)
    def load_from_hub(*args: Any, **kwargs: Any) -> str:
        try:
            return load(*args, **kwargs)
        except EntryNotFoundError as error:
            raise MissingFileError(str(error)) from error

    huggingface_sb3.load_from_hub = load_from_hub  # type: ignore[attr-defined]
