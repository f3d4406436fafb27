"""``python -m sb3_gae.gridworld``."""

from sb3_gae.lab.cli import main

if __name__ == "__main__":
    raise SystemExit(main())
