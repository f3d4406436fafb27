"""Which code on which machine a result comes from."""

import os
import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from sb3_gae.sweep.provenance import provenance

_PEERS = ("sb3-contrib", "tianshou", "envpool")


def origin() -> dict[str, str | int]:
    """:return: versions of packages, the commit, the processor, its cores and how many of them the run may use"""
    peers = {name.replace("-", "_"): _version_of(name) for name in _PEERS}
    machine: dict[str, str | int] = {"processor": processor(), "cores": os.cpu_count() or 0, "cores_of_run": _cores_of_run()}
    return {**provenance(), **peers, **machine}


def _version_of(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return ""


def processor() -> str:
    """:return: what the system calls it"""
    info = Path("/proc/cpuinfo")
    names = [line for line in info.read_text().splitlines() if line.startswith("model name")] if info.exists() else []
    return names[0].partition(":")[2].strip() if names else platform.processor()


def _cores_of_run() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 0
