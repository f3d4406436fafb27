"""Everything that is timed, through pytest-benchmark."""

import json
import subprocess
import sys
import tempfile
from pathlib import Path

from benchmarks.peers.errors import PeersError
from benchmarks.speed import results


def run(output: Path, quick: bool, threads: int) -> None:
    """
    :param output: file of results, to be written
    :param quick: whether to do next to nothing
    :param threads: of torch, and of the physics
    :raises PeersError: if something could not be timed
    """
    with tempfile.TemporaryDirectory() as folder:
        raw = Path(folder) / "raw.json"
        # Explicitly: no file of this name is collected otherwise
        bench = Path(__file__).with_name("bench.py")
        command = [sys.executable, "-m", "pytest", str(bench), "-v", "--benchmark-quiet", f"--benchmark-json={raw}"]
        command += [f"--threads={threads}", *(["--quick"] if quick else [])]
        if subprocess.run(command, check=False).returncode != 0:
            raise PeersError("Not everything could be timed, see above; nothing was written.")
        rows = results.rows_of(json.loads(raw.read_text()))
    results.write(output, rows, quick=quick, threads=threads)
