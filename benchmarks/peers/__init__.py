"""
The learning benchmark against peers: who learns what, in how many steps and how many seconds.

    python -m benchmarks.peers run --preset mujoco --jobs 2             # goes on where it was stopped
    python -m benchmarks.peers run --preset mujoco --jobs 2 --dry-run   # what is left, and how long it takes
    python -m benchmarks.peers status --preset mujoco
    python -m benchmarks.peers export                                   # logs/peers -> benchmarks/results/peers
    python -m benchmarks.peers report                                   # -> README.md, docs and docs/images

Run it in the root of the repository. Every library is used through its own public interface, each run in a process of
its own; the protocol stands in :mod:`benchmarks.peers.protocol` and in docs/benchmarks.md.
"""
