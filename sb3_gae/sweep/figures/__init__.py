"""The paper's figures, drawn from a table of results and nothing else."""

from sb3_gae.sweep.figures.draw import FIGURES, draw

__all__ = ["FIGURES", "draw"]
