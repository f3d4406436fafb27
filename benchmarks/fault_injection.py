"""
Does to a training what happens to long trainings, and counts what is lost.

Every training is CartPole-v1 with normalization, by two environments, and is continued from its last checkpoint until it is
finished. It has survived if it then is bit for bit what it would have been: parameters, statistics, random generators.

    python benchmarks/fault_injection.py                          # about five minutes
    python benchmarks/fault_injection.py --kills 5 --others 1     # a short form
    python benchmarks/fault_injection.py --write docs/fault-tally.md
"""

import argparse
import contextlib
import hashlib
import io
import os
import random
import resource
import signal
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv, VecNormalize

from sb3_gae import TRPOGAE, NumericalError, ResumableCheckpointCallback
from sb3_gae.saving.checkpoint_file import checkpoints_in, is_whole

ITERATIONS, N_STEPS, N_ENVS = 8, 32, 2
#: of the words of the tally, on its page
MEANING = """\
**Survived** means that the training, continued from what was on the disk, ended with the same bits as one to which nothing
was done: parameters, statistics, random generators. For numbers that are not finite and for errors of an environment it
also means that the right exception was raised, with the parameters of the last good update. CartPole-v1, two
environments, eight iterations.
"""
TOTAL = ITERATIONS * N_STEPS * N_ENVS
# Seconds after which a process that should have ended is a loss
PATIENCE = 120.0


class FaultyEnv(gym.Wrapper):
    """
    :param env: to be spoilt
    :param fault: ``"raise"``, ``"die"``, ``"hang"``, or what becomes of which number, as in ``"reward nan"``; None for none
    :param at: after how many steps, counted over all episodes
    """

    def __init__(self, env: gym.Env, fault: str | None, at: int):
        super().__init__(env)
        # A function, as an attribute would be a part of the state that comes back
        self.is_due = lambda steps: fault is not None and steps == at
        self.strike = lambda: fault or ""
        self.total_steps = 0

    def step(self, action: Any) -> Any:
        observation, reward, terminated, truncated, info = self.env.step(action)
        self.total_steps += 1
        if self.is_due(self.total_steps):
            what, _, number = self.strike().partition(" ")
            if what == "raise":
                raise RuntimeError("the environment is broken")
            if what == "die":
                os._exit(1)
            if what == "hang":
                time.sleep(1e6)
            if what == "reward":
                reward = float(number)
            if what == "observation":
                observation = np.full_like(observation, float(number))
        return observation, reward, terminated, truncated, info


def make_env(fault: str | None = None, at: int = 0) -> VecEnv:
    makers = [lambda: Monitor(FaultyEnv(gym.make("CartPole-v1"), fault, at))] * N_ENVS
    return VecNormalize(SubprocVecEnv(makers, "fork") if fault == "die" else DummyVecEnv(makers))


def digest(model: TRPOGAE) -> str:
    """Of everything that must be the same bit for bit."""
    normalize = model.get_vec_normalize_env()
    assert normalize is not None
    arrays = [*(tensor.numpy() for tensor in model.policy.state_dict().values()), np.asarray(model._last_obs)]
    arrays += [normalize.obs_rms.mean, normalize.obs_rms.var, normalize.ret_rms.var, normalize.returns]  # type: ignore[union-attr]
    arrays += [np.random.get_state()[1], th.get_rng_state().numpy(), np.asarray(model.num_timesteps)]  # type: ignore[list-item]
    return hashlib.sha256(b"".join(np.ascontiguousarray(array).tobytes() for array in arrays)).hexdigest()


def train(folder: Path, fault: str | None = None, at: int = 0) -> str:
    """To the end, from the last checkpoint if there is one."""
    env = make_env(fault, at)
    callback = ResumableCheckpointCallback(1, folder)
    try:
        if any(map(is_whole, checkpoints_in(folder))):
            model = TRPOGAE.resume(folder, env)
            model.learn(model.remaining_timesteps, callback=callback, reset_num_timesteps=False)
        else:
            model = TRPOGAE("MlpPolicy", env, n_steps=N_STEPS, policy_kwargs={"net_arch": [16]}, seed=1, device="cpu")
            model.learn(TOTAL, callback=callback)
    finally:
        with contextlib.suppress(EOFError, OSError):
            env.close()
    return digest(model)


# Processes


def start(work: Callable[[], Any]) -> int:
    """In a process of its own, which says nothing and whose status is 0 if all went well."""
    pid = os.fork()
    if pid:
        return pid
    status = 1
    try:
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, 1)
        if not os.environ.get("SHOW_ERRORS"):
            os.dup2(nowhere, 2)
        warnings.simplefilter("ignore")
        work()
        status = 0
    except BaseException:
        traceback.print_exc()
    os._exit(status)


def wait(pid: int, patience: float = PATIENCE) -> int | None:
    """The exit status of a process; None if it had to be killed."""
    end = time.monotonic() + patience
    while time.monotonic() < end:
        found, status = os.waitpid(pid, os.WNOHANG)
        if found:
            return status
        time.sleep(0.002)
    os.kill(pid, signal.SIGKILL)
    os.waitpid(pid, 0)
    return None


def finish(folder: Path) -> str:
    """Continue without faults, and say what became of it."""
    found = folder / "digest.txt"
    status = wait(start(lambda: found.write_text(train(folder))))
    return found.read_text() if status == 0 else "did not finish"


# Faults. Each yields whether the training survived, once for each that was tried


@contextlib.contextmanager
def folder() -> Iterator[Path]:
    with tempfile.TemporaryDirectory() as name:
        yield Path(name)


def kills(number: signal.Signals, times: int, expected: str, rng: random.Random) -> Iterator[bool]:
    """At random moments, several in the life of a training, until all are done."""
    done = 0
    while done < times:
        with folder() as place:
            hit = 0
            while done + hit < times:
                pid = start(lambda place=place: (place / "digest.txt").write_text(train(place)))
                time.sleep(rng.uniform(0.0, 1.0))
                os.kill(pid, number)
                status = wait(pid)
                if status == 0:
                    break
                hit += 1
                if status is None:
                    break
            survived = finish(place) == expected
        yield from [survived] * hit
        done += hit


def damaged_files(kind: str, expected: str) -> Iterator[bool]:
    """The newest checkpoint of a training that was stopped, at each tenth of its length."""
    with folder() as place:
        stop_early(place)
        files = {path.name: path.read_bytes() for path in checkpoints_in(place)}
    newest = next(iter(files))
    for tenth in range(11):
        content = files[newest]
        position = min(len(content) * tenth // 10, len(content) - 1)
        if kind == "truncated":
            damaged = content[:position]
        else:
            damaged = content[:position] + bytes([content[position] ^ 1]) + content[position + 1 :]
        with folder() as place:
            for name, whole in files.items():
                (place / name).write_bytes(damaged if name == newest else whole)
            yield finish(place) == expected


def stop_early(place: Path) -> None:
    """By an environment that fails in the middle of the sixth iteration."""
    wait(start(lambda: train(place, "raise", 5 * N_STEPS + N_STEPS // 2)))


def bad_environments(fault: str, times: int, expected: str, rng: random.Random) -> Iterator[bool]:
    """Training must end with an error of the right kind, and goes on with a sound environment."""
    for _ in range(times):
        with folder() as place:
            at = rng.randrange(1, TOTAL // N_ENVS)
            refused = wait(start(lambda place=place, at=at: expect_error(place, fault, at))) == 0
            yield refused and finish(place) == expected


def expect_error(place: Path, fault: str, at: int) -> None:
    try:
        train(place, fault, at)
    except NumericalError:
        assert fault.startswith(("reward", "observation"))
    except RuntimeError:
        assert fault == "raise"
    else:
        raise AssertionError("the fault was not noticed")


def dying_workers(times: int, rng: random.Random) -> Iterator[bool]:
    """The worker of a SubprocVecEnv dies; its state goes with it, so what counts is that training goes on where it was."""
    for _ in range(times):
        with folder() as place:
            at = rng.randrange(N_STEPS + 1, TOTAL // N_ENVS)
            # Status 1 is an error; None would be a training that waits for ever
            ended = wait(start(lambda place=place, at=at: train(place, "die", at)))
            newest = checkpoints_in(place)[0]
            before = (at - 1) // N_STEPS * N_STEPS * N_ENVS
            yield ended == 256 and is_whole(newest) and newest.name == f"rl_model_{before}_steps.zip"


def hanging_environments(times: int, expected: str, rng: random.Random) -> Iterator[bool]:
    """The first SIGTERM waits for the end of an iteration that does not come, the second does not wait."""
    for _ in range(times):
        with folder() as place:
            at = rng.randrange(N_STEPS, TOTAL // N_ENVS)
            pid = start(lambda place=place, at=at: train(place, "hang", at))
            before = (at - 1) // N_STEPS * N_STEPS * N_ENVS
            end = time.monotonic() + PATIENCE
            while not (place / f"rl_model_{before}_steps.zip").exists() and time.monotonic() < end:
                time.sleep(0.01)
            time.sleep(0.5)
            os.kill(pid, signal.SIGTERM)
            time.sleep(0.2)
            os.kill(pid, signal.SIGTERM)
            yield wait(pid) is not None and finish(place) == expected


def file_size_limits(times: int, expected: str, rng: random.Random) -> Iterator[bool]:
    """No file may grow as large as a checkpoint from some iteration on; the training ends as ever, and resumes from before."""
    for _ in range(times):
        with folder() as place:
            stop_early(place)
            last = checkpoints_in(place)[0]
            limit = rng.randrange(1000, last.stat().st_size // 2)

            def limited(place: Path = place, limit: int = limit) -> None:
                resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
                assert train(place) == expected

            finished = wait(start(limited)) == 0
            yield finished and checkpoints_in(place)[0] == last and finish(place) == expected


def full_disks(times: int, expected: str, rng: random.Random) -> Iterator[bool] | None:
    """A file system with room for one checkpoint and a part of the next; None where this user cannot make one."""
    with folder() as place:
        stop_early(place)
        size = checkpoints_in(place)[0].stat().st_size
        if os.geteuid() != 0 or not mount(place, size * 2):
            return None
        subprocess.run(["umount", place], check=True)
    return (on_full_disk(int(size * rng.uniform(1.2, 3.8)), expected) for _ in range(times))


def on_full_disk(size: int, expected: str) -> bool:
    with folder() as place:
        assert mount(place, size)
        try:

            def filled() -> None:
                assert train(place) == expected

            finished = wait(start(filled)) == 0
            last_good = is_whole(checkpoints_in(place)[0])
            with folder() as elsewhere:
                for path in checkpoints_in(place):
                    (elsewhere / path.name).write_bytes(path.read_bytes())
                return finished and last_good and finish(elsewhere) == expected
        finally:
            subprocess.run(["umount", place], check=True)


def mount(place: Path, size: int) -> bool:
    command = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(place)]
    return subprocess.run(command, capture_output=True, check=False).returncode == 0


def jumping_clocks(times: int, expected: str, rng: random.Random) -> Iterator[bool]:
    """Forwards and backwards by years, at each look."""
    for _ in range(times):
        with folder() as place:
            seed = rng.randrange(2**31)

            def confused(place: Path = place, seed: int = seed) -> None:
                jumps = random.Random(seed)
                time.time = lambda: jumps.uniform(-1e9, 3e9)  # type: ignore[assignment]
                time.time_ns = lambda: int(jumps.uniform(-1e18, 3e18))  # type: ignore[assignment]
                (place / "digest.txt").write_text(train(place))

            yield wait(start(confused)) == 0 and (place / "digest.txt").read_text() == expected


# The tally


def tally(n_kills: int, n_others: int, seed: int) -> Iterator[tuple[str, list[bool] | None]]:
    """Name of each fault, and whether the training survived it, once for each that was tried; None if it could not be."""
    rng = random.Random(seed)
    with folder() as place:
        expected = finish(place)
    assert len(expected) == 64, "the training does not even finish without faults"
    for number in (signal.SIGKILL, signal.SIGTERM, signal.SIGINT):
        yield f"{number.name} at a random moment", list(kills(number, n_kills, expected, rng))
    for kind in ("truncated", "flipped"):
        name = {"truncated": "newest file truncated", "flipped": "a bit of the newest file flipped"}[kind]
        yield f"{name}, at each tenth of its length", list(damaged_files(kind, expected))
    disks = full_disks(n_others, expected, rng)
    yield "disk full (a small tmpfs)", None if disks is None else list(disks)
    yield "files limited in size (`RLIMIT_FSIZE`)", list(file_size_limits(n_others, expected, rng))
    for what in ("reward", "observation"):
        survived = [
            survived
            for number in ("nan", "inf", "-inf")
            for survived in bad_environments(f"{what} {number}", n_others, expected, rng)
        ]
        yield f"NaN and ±∞ as {what}", survived
    yield "environment raises an error", list(bad_environments("raise", n_others, expected, rng))
    yield "worker of a `SubprocVecEnv` dies", list(dying_workers(n_others, rng))
    yield "environment hangs, SIGTERM twice", list(hanging_environments(n_others, expected, rng))
    yield "clock jumps by years at each look", list(jumping_clocks(n_others, expected, rng))


def main(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=50, help="of each signal (default: 50)")
    parser.add_argument("--others", type=int, default=5, help="of each other fault (default: 5)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--write", type=Path, help="Markdown file for the tally")
    chosen = parser.parse_args(arguments)
    th.set_num_threads(1)
    # A shell lets what it runs in the background ignore it
    signal.signal(signal.SIGINT, signal.default_int_handler)
    out = io.StringIO()
    print("| fault | tried | survived | lost |\n| --- | --: | --: | --: |", file=out)
    n_lost = 0
    for name, survived in tally(chosen.kills, chosen.others, chosen.seed):
        row = (
            [len(survived), sum(survived), len(survived) - sum(survived)]
            if survived is not None
            else ["not possible here"] * 3
        )
        n_lost += row[2] if isinstance(row[2], int) else 0
        line = f"| {name} | {' | '.join(map(str, row))} |"
        print(line, flush=True)
        print(line, file=out)
    if chosen.write:
        command = f"python benchmarks/fault_injection.py --kills {chosen.kills} --others {chosen.others} --seed {chosen.seed}"
        head = f"# Tally of faults\n\nBy `{command}`; see [Checkpoints](checkpoints.md).\n\n{MEANING}\n"
        chosen.write.write_text(head + out.getvalue())
    return 1 if n_lost else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
