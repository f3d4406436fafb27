"""
A task for tests of sweeps, to be imported with ``--gym-packages``.

It writes down every run in the working folder, waits while there is a file ``hold-SEED``, and fails if there is one
``fail-SEED``.
"""

import time
from pathlib import Path
from typing import Any

import gymnasium
from gymnasium.envs.classic_control import CartPoleEnv

RUNS = Path("runs.txt")


class WitnessedEnv(CartPoleEnv):
    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        if seed is not None:
            with RUNS.open("a") as file:
                file.write(f"{seed}\n")
            while Path(f"hold-{seed}").exists():
                time.sleep(0.01)
            if Path(f"fail-{seed}").exists():
                raise RuntimeError("the motor\nis broken")
        return super().reset(seed=seed, options=options)


gymnasium.register("SweepTask-v0", entry_point=WitnessedEnv, max_episode_steps=20)
