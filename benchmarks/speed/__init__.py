"""
The speed of the hot parts beside the peers and beside what the machine can do at all.

    python -m benchmarks.speed run         # -> benchmarks/results/speed.json
    python -m benchmarks.speed targets     # -> benchmarks/results/speed_targets.json
    python -m benchmarks.speed profile     # -> benchmarks/results/iteration_seconds.json
    python -m benchmarks.speed threads     # -> benchmarks/results/threads.json
    python -m benchmarks.speed report      # -> docs/speed.md and docs/images, from these files alone

Run it in the root of the repository, on a machine with nothing else to do. Each of the first four takes ``--quick``, which
shows that it works and whose numbers mean nothing.
"""
