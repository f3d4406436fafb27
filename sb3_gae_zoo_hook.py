"""
Start-up hook: lets rl-zoo3 know ``trpo_gae`` without a wrapper and without a change to rl-zoo3.

``python -m rl_zoo3.train --algo trpo_gae`` reads the names it accepts before it imports any package of the user's. So
``sb3_gae_zoo_hook.pth`` (``.start`` from Python 3.15 on) calls ``install`` at every start of the interpreter. That
places a finder on ``sys.meta_path`` which does nothing until somebody imports rl-zoo3, and then hands the modules that
matter to ``sb3_gae.zoo`` once they have been executed.

Two promises to programs that have nothing to do with us: this module imports nothing that the interpreter has not
loaded already, and it raises nothing. ``SB3_GAE_NO_ZOO_HOOK=1`` turns it off. More in docs/zoo.md.
"""

import os
import sys

TYPE_CHECKING = False  # the real one is in typing, which takes longer to import than all of this
if TYPE_CHECKING:
    from collections.abc import Sequence
    from importlib.machinery import ModuleSpec
    from types import ModuleType
    from typing import Any

OFF_SWITCH = "SB3_GAE_NO_ZOO_HOOK"
WATCHED_MODULES = frozenset({"rl_zoo3.utils", "rl_zoo3.hyperparams_opt", "rl_zoo3.exp_manager"})


def install() -> None:
    """Start to wait for rl-zoo3, unless the environment says not to or it has been done."""
    if os.environ.get(OFF_SWITCH, "") not in ("", "0"):
        return
    if not any(isinstance(finder, ZooFinder) for finder in sys.meta_path):
        sys.meta_path.insert(0, ZooFinder())


class ZooFinder:
    """Finds the watched modules as the other finders do, with a loader that calls us afterwards."""

    def find_spec(
        self, name: str, path: "Sequence[str] | None" = None, target: "ModuleType | None" = None
    ) -> "ModuleSpec | None":
        """
        :param name: full name of the module that is being imported
        :param path: where to look for it
        :param target: the module that is being reloaded
        :return: ``None`` (not ours to find) for all but the watched modules
        """
        if name not in WATCHED_MODULES:
            return None
        for finder in sys.meta_path:
            find_spec = None if finder is self else getattr(finder, "find_spec", None)
            spec: ModuleSpec | None = find_spec(name, path, target) if find_spec else None
            if spec is not None:
                if hasattr(spec.loader, "exec_module"):
                    spec.loader = ZooLoader(spec.loader)  # type: ignore[assignment]
                return spec
        return None


class ZooLoader:
    """
    Loads a module with its own loader, then hands it over.

    :param loader: the module's own loader
    """

    def __init__(self, loader: "Any") -> None:
        self._loader = loader

    def create_module(self, spec: "ModuleSpec") -> "ModuleType | None":
        """
        :param spec: of the module to be created
        :return: what the module's own loader says
        """
        return self._loader.create_module(spec)

    def exec_module(self, module: "ModuleType") -> None:
        """
        :param module: the module to execute and hand over
        """
        module.__loader__ = self._loader  # from here on the module looks as if we had never been there
        if module.__spec__ is not None:
            module.__spec__.loader = self._loader
        self._loader.exec_module(module)
        hand_over(module)

    def __getattr__(self, name: str) -> "Any":
        return getattr(self._loader, name)  # runpy, inspect and pkgutil ask loaders for more


def hand_over(module: "ModuleType") -> None:
    """
    Let ``sb3_gae.zoo`` work on a module of rl-zoo3. A failure is reported and withdraws the algorithm: whoever asks
    for it is refused with the reason, and everybody else's program goes on.

    :param module: one of the watched modules, executed
    """
    try:
        from sb3_gae import zoo  # not before now: it needs torch, which rl-zoo3 has imported

        zoo.integrate(module)
    except Exception as error:
        withdraw()
        report(error)


def withdraw() -> None:
    """Take the algorithm out of rl-zoo3 again: half integrated, it would fail later and with a worse message."""
    algorithms = getattr(sys.modules.get("rl_zoo3.utils"), "ALGOS", None)
    if isinstance(algorithms, dict):
        algorithms.pop("trpo_gae", None)


def report(error: Exception) -> None:
    """
    Say once, in one line, why there is no ``trpo_gae``. Not by ``warnings``: with ``-W error`` that would raise.

    :param error: what went wrong
    """
    global _reported
    if _reported:
        return
    _reported = True
    reason = " ".join(f"{type(error).__name__}: {error}".split())
    try:  # noqa: SIM105 - contextlib is not loaded at this point
        sys.stderr.write(f"sb3-gae: rl-zoo3 goes without trpo_gae: {reason} ({OFF_SWITCH}=1 silences this)\n")
    except (AttributeError, OSError, ValueError):
        pass  # there is no stderr, or it is closed


_reported = False
