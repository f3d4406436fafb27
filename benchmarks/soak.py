"""
Trains for a long time and checks at each step what must always hold.

    python benchmarks/soak.py                 # an hour
    python benchmarks/soak.py --minutes 2

The paper's biped in sixteen batched environments, with a checkpoint after each iteration; every twenty iterations the
training is thrown away and continued from its last checkpoint. Looked at: the divergence of each policy step and of each
value step, measured from outside; that rejected steps move nothing; memory; open files; threads. A broken invariant is
printed and makes the exit status 1.
"""

import argparse
import os
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import NamedTuple

import numpy as np
from invariants import watched
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

from sb3_gae import TRPOGAE, MujocoVecEnv, ResumableCheckpointCallback
from sb3_gae.sweep.worker import return_freed_memory

N_ENVS, N_STEPS, ITERATIONS_A_LIFE = 16, 64, 20
# Of a whole life, over all the lives after the second, which the allocator takes to settle
LARGEST_GROWTH_MIB = 32.0


class Resources(NamedTuple):
    """
    :param memory: resident, in MiB
    :param files: open ones
    :param threads: of the process
    """

    memory: float
    files: int
    threads: int


def resources() -> Resources:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    files, threads = (len(os.listdir(f"/proc/self/{what}")) for what in ("fd", "task"))  # noqa: PTH208
    return Resources(pages * os.sysconf("SC_PAGE_SIZE") / 2**20, files, threads)


class StopAt(BaseCallback):
    """
    Ends training between two iterations, which a return value of ``_on_step`` would not.

    :param deadline: of the monotonic clock
    :param last_update: after how many updates of the whole training this life is over. (A number that the callback counted
        by itself would come back with the checkpoint, and end the next life before it begins.)
    """

    class Over(Exception):
        """The time is over, or the life is."""

    def __init__(self, deadline: float, last_update: int):
        super().__init__()
        self.deadline = deadline
        self.last_update = last_update

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        if self.model._n_updates >= self.last_update or time.monotonic() >= self.deadline:
            raise self.Over


def live(folder: Path, deadline: float, counts: Counter[str]) -> list[str]:
    """One life of the training, from its last checkpoint on."""
    env = VecNormalize(make_vec_env("GaeBiped-v0", N_ENVS, vec_env_cls=MujocoVecEnv))
    resumed = any(folder.iterdir())
    kwargs = {"n_steps": N_STEPS, "gae_lambda": "auto", "seed": 0}
    model = TRPOGAE.resume(folder, env) if resumed else TRPOGAE("MlpPolicy", env, **kwargs)  # type: ignore[arg-type]
    before = model._n_updates
    callback = [ResumableCheckpointCallback(1, folder), StopAt(deadline, before + ITERATIONS_A_LIFE)]
    with watched(model) as watch:
        try:
            model.learn(10**9, callback=callback, reset_num_timesteps=not resumed)
        except StopAt.Over:
            pass
        finally:
            env.close()
    counts.update(watch.counts)
    counts["iterations"] = model._n_updates
    counts["lives"] += 1
    whole = model._n_updates == before + ITERATIONS_A_LIFE or time.monotonic() >= deadline
    return watch.violations + ([] if whole else [f"a life of {model._n_updates - before} iterations"])


def main(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=60.0)
    deadline = time.monotonic() + 60.0 * parser.parse_args(arguments).minutes
    counts: Counter[str] = Counter()
    violations: list[str] = []
    used: list[Resources] = []
    with tempfile.TemporaryDirectory() as folder:
        while time.monotonic() < deadline:
            violations += live(Path(folder), deadline, counts)
            # A training that is over is a ring (a callback keeps `locals()` of the rollout, and so itself), which Python's
            # collector, counting objects and not bytes, gets to after hundreds of lives; and glibc keeps what was freed
            return_freed_memory()
            used.append(resources())
            print(f"{counts['iterations']} iterations, {used[-1]}, {len(violations)} violations", flush=True)
    violations += leaks(used[2:])
    print("\n".join([f"{what}: {number}" for what, number in counts.items()] + violations))
    print("every invariant held" if not violations else f"{len(violations)} VIOLATIONS")
    return 1 if violations else 0


def leaks(used: list[Resources]) -> list[str]:
    """
    :param used: at the end of each life
    :return: what grew, in words
    """
    if len(used) < 2:
        return []
    found = []
    memory = np.array([one.memory for one in used])
    growth = np.polyfit(np.arange(len(memory)), memory, 1)[0] * (len(memory) - 1)
    if growth > LARGEST_GROWTH_MIB:
        found.append(f"memory grew by {growth:.1f} MiB in {len(memory) - 1} lives")
    for what in ("files", "threads"):
        first, last = getattr(used[0], what), getattr(used[-1], what)
        if last > first:
            found.append(f"{what}: {last} in place of {first}")
    return found


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
