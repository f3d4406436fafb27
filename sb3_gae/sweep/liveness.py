"""Whether the process behind a running cell still lives."""

import os
import socket
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

#: seconds without a sign of life after which a cell on another machine may be taken over
SILENT_AFTER = 900.0


def beat_every(silent_after: float) -> float:
    """
    :param silent_after: seconds of silence after which a cell may be taken over
    :return: seconds between signs of life, so many that some may be late
    """
    return silent_after / 15.0


def patience_with(silent_after: float) -> float:
    """
    :param silent_after: seconds of silence after which a cell may be taken over
    :return: seconds to wait for a storage; less, so that who goes on after an outage finds its cell still its own
    """
    return silent_after * 2.0 / 3.0


def sign_of_life() -> dict[str, Any]:
    """
    :return: who and when, to be stored with a running cell; times in seconds since 1970
    """
    pid = os.getpid()
    return {
        "host": socket.gethostname(),
        "pid": pid,
        "pid_namespace": _pid_namespace(),
        "started": _start_of(pid),
        "time": time.time(),
    }


def why_dead(sign: Mapping[str, Any], now: float, silent_after: float = SILENT_AFTER) -> str | None:
    """
    :param sign: the last one of a running cell
    :param now: seconds since 1970
    :param silent_after: seconds
    :return: why its process counts as gone, None if it does not
    """
    who = f"process {sign['pid']} on {sign['host']}"
    if _is_visible(sign) and not _lives(int(sign["pid"]), sign.get("started")):
        return f"{who} ended without a word"
    silence = now - float(sign["time"])
    return f"{who} gave no sign of life for {silence:.0f} s" if silence > silent_after else None


def _is_visible(sign: Mapping[str, Any]) -> bool:
    """Whether the number of its process means here what it meant there: containers may have the same host name."""
    here = _pid_namespace()
    # Those of earlier versions have none
    return sign["host"] == socket.gethostname() and sign.get("pid_namespace", here) == here


def _pid_namespace() -> int | None:
    """What tells sets of process numbers apart on one machine; None where the system does not tell."""
    try:
        return Path("/proc/self/ns/pid").stat().st_ino
    except OSError:
        return None


def _lives(pid: int, started: int | None) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except OSError:
        return True  # it is there, and somebody else's
    now_started = _start_of(pid)
    # Numbers of processes are used again, but not for one that started at the same time
    return now_started != -1 and (started is None or now_started is None or started == now_started)


def _start_of(pid: int) -> int | None:
    """When a process started, in the system's ticks; -1 if it is a zombie, None where the system does not tell."""
    try:
        # The name, in parentheses, may hold spaces
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return None
    return -1 if fields[0] in ("Z", "X") else int(fields[19])
