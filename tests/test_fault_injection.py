"""The short form of the fault injection: signals at random moments, in processes of their own."""

import importlib.util
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

ROOT = Path(__file__).parent.parent
SCRIPT = ROOT / "benchmarks" / "fault_injection.py"

# It gives up on a training by itself
COUNT_LOST = """
import random, signal, sys
sys.path.insert(0, "benchmarks")
import fault_injection as faults
import torch
torch.set_num_threads(1)
with faults.folder() as place:
    expected = faults.finish(place)
rng = random.Random(0)
survived = [*faults.kills(signal.SIGKILL, 5, expected, rng), *faults.kills(signal.SIGTERM, 2, expected, rng)]
print(len(expected), survived.count(True), survived.count(False))
"""


def load_script() -> Any:
    spec = importlib.util.spec_from_file_location("fault_injection", SCRIPT)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_nothing_is_lost_when_processes_are_killed_at_random_moments() -> None:
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "-c", COUNT_LOST], cwd=ROOT, env=environment, capture_output=True, text=True, check=True
    )
    assert done.stdout.split() == ["64", "7", "0"]


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_the_faults_strike_when_they_should() -> None:
    """A tally of faults that never came would look just as well."""
    faults = load_script()
    for fault, broken in (("reward nan", True), ("observation inf", True), (None, False)):
        env = faults.FaultyEnv(gym.make("CartPole-v1"), fault, 3)
        env.reset(seed=0)
        steps = [env.step(number % 2) for number in range(3)]
        numbers = [np.append(observation, reward) for observation, reward, *_ in steps]
        assert np.isfinite(numbers[:2]).all() and np.isfinite(numbers[2]).all() != broken
    env = faults.FaultyEnv(gym.make("CartPole-v1"), "raise", 1)
    env.reset()
    with pytest.raises(RuntimeError, match="broken"):
        env.step(0)
