"""
Grids of task × γ × λ × seed × condition on Optuna, and the paper's figures from their results.

``python -m sb3_gae.sweep --help``, or :func:`run_sweep`.
"""

from sb3_gae.sweep.conditions import CONDITIONS
from sb3_gae.sweep.errors import SweepError
from sb3_gae.sweep.export import export
from sb3_gae.sweep.figures import draw
from sb3_gae.sweep.grid import Cell, Curve
from sb3_gae.sweep.presets import PRESETS
from sb3_gae.sweep.results import read_results, results_of
from sb3_gae.sweep.selection import Selection
from sb3_gae.sweep.study import SweepStudy
from sb3_gae.sweep.sweep import run_sweep

__all__ = [
    "CONDITIONS",
    "PRESETS",
    "Cell",
    "Curve",
    "Selection",
    "SweepError",
    "SweepStudy",
    "draw",
    "export",
    "read_results",
    "results_of",
    "run_sweep",
]
