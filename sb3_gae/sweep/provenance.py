"""Which code a result comes from."""

import functools
import platform
import subprocess
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

PACKAGES = ("sb3-gae", "stable-baselines3", "rl-zoo3", "gymnasium", "mujoco", "torch", "numpy", "optuna")


@functools.cache
def provenance() -> dict[str, str]:
    """
    :return: versions by the name of the package, that of ``python``, and ``commit``; empty where unknown
    """
    versions = {name.replace("-", "_"): _version_of(name) for name in PACKAGES}
    return versions | {"python": platform.python_version(), "commit": _commit()}


#: names in the order of the columns of an export
PROVENANCE_COLUMNS = (*(name.replace("-", "_") for name in PACKAGES), "python", "commit")


def _version_of(package: str) -> str:
    if package == "sb3-gae":
        from sb3_gae import __version__  # what runs, where the metadata may be of another checkout

        return __version__
    try:
        return version(package)
    except PackageNotFoundError:
        return ""


def _commit() -> str:
    """Of the checkout that the package is imported from, with a mark if files differ from it; empty elsewhere."""
    root = Path(__file__).resolve().parents[2]
    if not (root / ".git").exists():
        return ""
    try:
        commit = _git(root, "rev-parse", "HEAD")
        return commit + ("+changes" if _git(root, "status", "--porcelain", "--untracked-files=no") else "")
    except (OSError, subprocess.SubprocessError):
        return ""


def _git(root: Path, *arguments: str) -> str:
    result = subprocess.run(["git", "-C", str(root), *arguments], capture_output=True, text=True, check=True, timeout=10)
    return result.stdout.strip()
