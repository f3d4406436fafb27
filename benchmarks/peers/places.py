"""Where things are in the repository."""

from pathlib import Path

ROOT = Path(__file__).parents[2]
#: the committed files of results
RESULTS = ROOT / "benchmarks" / "results" / "peers"
