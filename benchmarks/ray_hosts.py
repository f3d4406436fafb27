"""
Workers on several hosts, which are network namespaces of this machine: speed over a network, and the loss of a host.

    sudo env PATH="$PATH" python benchmarks/ray_hosts.py speed --gigabits 1   # writes benchmarks/results/ray_hosts.csv
    sudo env PATH="$PATH" python benchmarks/ray_hosts.py loss                 # a host killed in the middle of a batch
    sudo env PATH="$PATH" python benchmarks/ray_hosts.py loss --silent        # its network goes first, as in a power cut

Linux, as root. Each host has a network of its own, its own loopback and its own /tmp/ray; a bridge joins them. The first
has the learner and no worker, so that all weights and shares go over the network, whose speed ``tc`` can hold down. The
cores are those of this machine all the same: hosts are further away here, not more.

``loss`` trains twice with two workers on two hosts. The second time one host is killed, all its processes at once, in the
middle of a batch; a third host takes over. Both trainings must have the same parameters, bit for bit. The connections of
killed processes are closed, which Ray notices at once. With ``--silent`` nothing more is heard of the host, until Ray
has missed enough of its heartbeats, which takes a minute or so.
"""

import argparse
import hashlib
import os
import shlex
import signal
import subprocess
import sys
import tempfile
import threading
import time
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

HERE = Path(__file__).parent
PREFIX = "sb3gae"
ADDRESS = "10.77.0.1:6379"
# Of a training whose batches last long enough to lose a host in one
N_ENVS, N_STEPS, ITERATIONS = 8, 2048, 4
BATCH = N_ENVS * N_STEPS
# Not the first, whose time tells when to lose the host
ITERATION_OF_LOSS = 2


def run(*command: str, check: bool = True) -> None:
    subprocess.run(command, check=check)


@contextmanager
def hosts(n_hosts: int, gigabits: float | None) -> Iterator[list[str]]:
    """
    :param n_hosts: beside the one of the learner
    :param gigabits: a second, that each of them can send; None for what memory gives
    :return: names of the namespaces, the learner's first
    """
    names = [f"{PREFIX}{host}" for host in range(n_hosts + 1)]
    remove(names)
    try:
        for name in names:
            run("ip", "netns", "add", name)
            run("ip", "-n", name, "link", "set", "lo", "up")
        head = names[0]
        run("ip", "-n", head, "link", "add", "name", "bridge", "type", "bridge")
        run("ip", "-n", head, "addr", "add", "10.77.0.1/24", "dev", "bridge")
        run("ip", "-n", head, "link", "set", "bridge", "up")
        for host, name in enumerate(names[1:], start=1):
            run("ip", "link", "add", f"{PREFIX}v{host}", "netns", head, "type", "veth", "peer", "name", "eth0", "netns", name)
            run("ip", "-n", head, "link", "set", f"{PREFIX}v{host}", "master", "bridge", "up")
            run("ip", "-n", name, "addr", "add", f"10.77.0.{host + 1}/24", "dev", "eth0")
            run("ip", "-n", name, "link", "set", "eth0", "up")
            if gigabits is not None:
                for namespace, device in ((head, f"{PREFIX}v{host}"), (name, "eth0")):
                    rate = ("tbf", "rate", f"{gigabits}gbit", "burst", "1mb", "latency", "50ms")
                    run("tc", "-n", namespace, "qdisc", "add", "dev", device, "root", *rate)
        yield names
    finally:
        remove(names)


def remove(names: Sequence[str]) -> None:
    existing = subprocess.run(["ip", "netns", "list"], capture_output=True, text=True, check=True).stdout.split()
    for name in names:
        if name in existing:
            kill_host(name)
            run("ip", "netns", "del", name)


def kill_host(name: str) -> None:
    """Until none is left: a process may have had a child meanwhile."""
    while pids := pids_of(name):
        kill(pids)
        time.sleep(0.05)


def pids_of(name: str) -> list[int]:
    found = subprocess.run(["ip", "netns", "pids", name], capture_output=True, text=True, check=True)
    return [int(pid) for pid in found.stdout.split()]


def kill(pids: Sequence[int]) -> None:
    for pid in pids:
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)


def on_host(name: str, script: str) -> subprocess.Popen:
    """Each call has its own view of the file system, so that hosts do not meet in Ray's folder of sockets."""
    prepared = f"mkdir -p /tmp/ray && mount -t tmpfs tmpfs /tmp/ray && {script}"
    # Nobody else is in this network, so nobody has to say a token
    environment = os.environ | {"RAY_USAGE_STATS_ENABLED": "0", "RAY_ADDRESS": "", "RAY_AUTH_MODE": "disabled"}
    return subprocess.Popen(["ip", "netns", "exec", name, "sh", "-c", prepared], env=environment)


def ray_start(arguments: str) -> str:
    return f"ray start {arguments} --disable-usage-stats --object-store-memory=500000000"


def on_cluster(names: Sequence[str], cpus: Sequence[int], command: Sequence[str]) -> subprocess.Popen:
    """
    :param names: of the hosts, the learner's first
    :param cpus: of each other host
    :param command: of the learner
    :return: its process
    """
    start = ray_start("--head --node-ip-address=10.77.0.1 --port=6379 --num-cpus=0 --include-dashboard=false")
    # Without the address it may be another Ray of this machine, which is found by the names of processes
    wait = f"until [ $(ray status --address={ADDRESS} | grep -c '1 node_') -gt {len(cpus)} ]; do sleep 1; done"
    learner = on_host(names[0], f"{start} > /dev/null && {wait} && RAY_ADDRESS={ADDRESS} {shlex.join(command)}")
    for host, (name, n_cpus) in enumerate(zip(names[1:], cpus, strict=True), start=2):
        join = ray_start(f"--address={ADDRESS} --node-ip-address=10.77.0.{host} --num-cpus={n_cpus} --block")
        on_host(name, f"until {join} > /dev/null 2>&1; do sleep 1; done")
    return learner


def speed(gigabits: float | None, arguments: Sequence[str]) -> int:
    out = ["--out", str(HERE / "results" / "ray_hosts.csv")]
    with hosts(2, gigabits) as names:
        command = [sys.executable, str(HERE / "ray_speed.py"), "--address", ADDRESS, *out, *arguments]
        return on_cluster(names, [2, 2], command).wait()


def loss(silent: bool) -> int:
    undisturbed = digest_of_training([])
    disturbed = digest_of_training(["--lose", "silently" if silent else "killed"])
    same = undisturbed == disturbed
    print(f"parameters of both trainings: {'the same, bit for bit' if same else 'DIFFERENT'}")
    return not same


def digest_of_training(arguments: Sequence[str]) -> str:
    with tempfile.TemporaryDirectory(prefix=PREFIX) as folder, hosts(3, None) as names:
        digest = Path(folder) / "digest"
        command = [sys.executable, __file__, "train", "--digest", str(digest), *arguments]
        if status := on_cluster(names, [1, 1, 1], command).wait():
            raise SystemExit(f"The learner ended with status {status}.")
        return digest.read_text()


def train(digest: Path, lose: str | None) -> None:
    """In the learner's namespace."""
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.vec_env import VecNormalize

    from sb3_gae import TRPOGAE, RayVecEnv

    base = make_vec_env("GaeBiped-v0", N_ENVS, vec_env_cls=RayVecEnv, vec_env_kwargs={"n_workers": 2})
    assert isinstance(base, RayVecEnv)

    class LoseHost(BaseCallback):
        def _on_step(self) -> bool:
            return True

        def _on_rollout_start(self) -> None:
            if lose and self.num_timesteps == ITERATION_OF_LOSS * BATCH:
                assert base.last_collection is not None
                lose_host_after(base.last_collection.worker_seconds / 2, silently=lose == "silently")

        def _on_rollout_end(self) -> None:
            is_over = self.num_timesteps == (ITERATION_OF_LOSS + 1) * BATCH
            if lose and is_over and not any("was lost" in str(warning.message) for warning in given):
                raise SystemExit("The host was not lost in the middle of the batch, which says nothing of a loss.")

    model = TRPOGAE("MlpPolicy", VecNormalize(base), n_steps=N_STEPS, seed=0, device="cpu")
    with warnings.catch_warnings(record=True) as given:
        warnings.simplefilter("always")
        start = time.monotonic()
        model.learn(ITERATIONS * BATCH, callback=LoseHost())
    print(
        f"{time.strftime('%X')} trained in {time.monotonic() - start:.0f} s",
        *(warning.message for warning in given),
        sep="\n  ",
    )
    parameters = b"".join(tensor.numpy().tobytes() for tensor in model.policy.state_dict().values())
    digest.write_text(hashlib.sha256(parameters).hexdigest())


def lose_host_after(seconds: float, silently: bool) -> None:
    """All that takes time is done before, lest the batch should be over."""
    host, pids = host_with_a_worker()

    def lose() -> None:
        if silently:
            run("ip", "-n", f"{PREFIX}0", "link", "set", f"{PREFIX}v{host}", "down")
        kill(pids)
        print(f"{time.strftime('%X')} killed the {len(pids)} processes of host {PREFIX}{host}", flush=True)

    threading.Timer(seconds, lose).start()


def host_with_a_worker() -> tuple[int, list[int]]:
    for host in range(1, 4):
        pids = pids_of(f"{PREFIX}{host}")
        if any(is_rollout_worker(pid) for pid in pids):
            return host, pids
    raise SystemExit("There is no worker on any host.")


def is_rollout_worker(pid: int) -> bool:
    with suppress(FileNotFoundError, ProcessLookupError):
        return b"RolloutWorker" in Path(f"/proc/{pid}/cmdline").read_bytes()
    return False


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    of_speed = commands.add_parser("speed", help="further arguments go to ray_speed.py")
    of_speed.add_argument("--gigabits", type=float)
    of_loss = commands.add_parser("loss", help="two trainings, which must be the same")
    of_loss.add_argument(
        "--silent", action="store_true", help="the host's network goes first, so that no connection is closed"
    )
    of_train = commands.add_parser("train", help="for `loss`, on the host of the learner")
    of_train.add_argument("--digest", type=Path, required=True)
    of_train.add_argument("--lose", choices=["killed", "silently"])
    args, further = parser.parse_known_args()
    if further and args.command != "speed":
        parser.error(f"unrecognized arguments: {' '.join(further)}")
    if args.command == "train":
        train(args.digest, args.lose)
    else:
        sys.exit(loss(args.silent) if args.command == "loss" else speed(args.gigabits, further))


if __name__ == "__main__":
    main()
