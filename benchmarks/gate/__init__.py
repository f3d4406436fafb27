"""A benchmark of a few minutes that turns red when speed or learning get worse; `python -m benchmarks.gate`."""
