"""Advantages of one λ and of a grid. The peer is SB3's buffer: for a grid, one pass for each pair of γ and λ."""

from collections.abc import Iterator
from functools import partial

import numpy as np
from stable_baselines3.common.buffers import RolloutBuffer

from benchmarks.speed.case import OURS, PEER, Case, Prepared
from benchmarks.speed.plan import Plan
from benchmarks.update_speed import N_ENVS, compute_advantages, random_rollout
from sb3_gae import GAERolloutBuffer


def advantage_cases(plan: Plan) -> Iterator[Case]:
    """
    :param plan: with the sizes
    :return: advantages against batch and environments, grids against pairs and batch
    """
    largest, middle_grid = plan.batches[-1], plan.grids[1]
    kinds: dict[str, type[RolloutBuffer]] = {OURS: GAERolloutBuffer, PEER: RolloutBuffer}
    for batch in plan.batches:
        for who, kind in kinds.items():
            yield Case("advantages", "batch", batch, who, partial(_single, kind, batch, N_ENVS))
    for n_envs in plan.n_envs:
        for who, kind in kinds.items():
            yield Case("advantages", "environments", n_envs, who, partial(_single, kind, largest, n_envs))
    for grid in plan.grids:
        for who in kinds:
            size = grid[0] * grid[1]
            yield Case("advantage grid", "pairs of γ and λ", size, who, partial(_grid, who, largest, grid))
    for batch in plan.batches:
        for who in kinds:
            yield Case("advantage grid", "batch", batch, who, partial(_grid, who, batch, middle_grid))


def _single(kind: type[RolloutBuffer], batch: int, n_envs: int) -> Prepared:
    buffer = random_rollout(kind, batch, n_envs)
    return Prepared(lambda: compute_advantages(buffer))


def _grid(who: str, batch: int, grid: tuple[int, int]) -> Prepared:
    gammas, lambdas = np.linspace(0.9, 1.0, grid[0]), np.linspace(0.0, 1.0, grid[1])
    if who == OURS:
        kept_apart = random_rollout(GAERolloutBuffer, batch, N_ENVS)
        assert isinstance(kept_apart, GAERolloutBuffer)
        return Prepared(lambda: kept_apart.advantage_grid(gammas, lambdas))  # type: ignore[arg-type]
    buffer = random_rollout(RolloutBuffer, batch, N_ENVS)

    def passes() -> None:
        for buffer.gamma in gammas:
            for buffer.gae_lambda in lambdas:
                compute_advantages(buffer)

    return Prepared(passes)
