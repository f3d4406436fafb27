"""``python -m sb3_gae.sweep``."""

from sb3_gae.sweep.cli import main

# Spawned processes import this module, too
if __name__ == "__main__":
    raise SystemExit(main())
