"""
A task for tests of sweeps, to be imported with ``--gym-packages``.

It writes down every run in the working folder, waits while there is a file ``hold-SEED``, fails if there is one
``fail-SEED``, asks for the end of the program if there is one ``exit-SEED``, and takes longer and longer steps while there
is one ``slow-SEED``. ``SWEEP_HOST`` in the environment names the machine.
"""

import os
import socket
import sys
import time
from pathlib import Path
from typing import Any

import gymnasium
from gymnasium.envs.classic_control import CartPoleEnv

RUNS = Path("runs.txt")
if "SWEEP_HOST" in os.environ:
    socket.gethostname = lambda: os.environ["SWEEP_HOST"]


class WitnessedEnv(CartPoleEnv):
    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        if seed is not None:
            self._slow, self._n_steps = Path(f"slow-{seed}"), 0
            with RUNS.open("a") as file:
                file.write(f"{seed}\n")
            while Path(f"hold-{seed}").exists():
                time.sleep(0.01)
            if Path(f"fail-{seed}").exists():
                raise RuntimeError("the motor\nis broken")
            if Path(f"exit-{seed}").exists():
                sys.exit("no licence")
        return super().reset(seed=seed, options=options)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        self._n_steps += 1
        if self._slow.exists():
            time.sleep(0.012 * self._n_steps)
        return super().step(action)


gymnasium.register("SweepTask-v0", entry_point=WitnessedEnv, max_episode_steps=20)
