"""Rendering without a screen, which MuJoCo has to be told of before it is imported."""

import ctypes.util
import os
import subprocess
import sys
import textwrap

import pytest

LIBRARIES = {"egl": "EGL", "osmesa": "OSMesa"}


def run_headless(code: str) -> list[str]:
    """
    Run code that renders, and skip the test where there is no library to render with.

    :return: the words that it printed
    """
    found = [backend for backend, library in LIBRARIES.items() if ctypes.util.find_library(library)]
    if not found:
        pytest.skip("neither libEGL nor libOSMesa is installed")
    result = subprocess.run(
        [sys.executable, "-W", "error::UserWarning:sb3_gae", "-c", textwrap.dedent(code)],
        env=os.environ | {"MUJOCO_GL": found[0], "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert result.returncode == 0, result.stderr
    return result.stdout.split()
