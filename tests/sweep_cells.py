"""Cells of a sweep, and how a study says that they stand."""

from sb3_gae.sweep import Cell, SweepStudy
from sb3_gae.sweep.ledger import Status

CELLS = [Cell("CartPole-v1", "trust_region", 0.9, value, 0, 3) for value in (0.0, 0.5, 1.0)]


def statuses(study: SweepStudy) -> list[Status]:
    table = study.standings()
    return [table[cell.key].status for cell in CELLS]
