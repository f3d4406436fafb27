"""Which runs there are, and in which order."""

from collections.abc import Iterable, Iterator
from typing import NamedTuple

from benchmarks.peers.algorithms import A2C, OURS, PPO, TIANSHOU_NPG, TIANSHOU_TRPO, TRPO
from benchmarks.peers.errors import PeersError
from benchmarks.peers.protocol import CLASSIC_TASKS, LONG_STEPS, MUJOCO_STEPS, MUJOCO_TASKS, PUBLISHED_PPO
from benchmarks.peers.variants import (
    CANDIDATES,
    DAMPING_CANDIDATES,
    HUMANOID_CANDIDATES,
    PENDULUM_CANDIDATES,
    SHIPPED,
    SWIMMER_CANDIDATES,
    VARIANTS,
)

#: of ours and of the peers that the targets name
SEEDS = 5
#: of the others, and of the ablation
FEW_SEEDS = 3
#: of classic control, where a run takes a minute
CLASSIC_SEEDS = 10
ABLATION_TASKS = ("HalfCheetah-v5", "Hopper-v5", "Walker2d-v5")
SMOKE_STEPS = 2_000
#: of tuning, none of them among those that are reported
TUNING_SEEDS = (100, 101, 102)
TUNING_TASKS = ("Walker2d-v5", "Hopper-v5", "HalfCheetah-v5", "Ant-v5", "Swimmer-v5", "Humanoid-v5")
TUNING_STEPS = 500_000
PENDULUM = "Pendulum-v1"
#: as many as tell a tenth of the return from chance
PENDULUM_TUNING_SEEDS = range(100, 112)
SWIMMER = "Swimmer-v5"
#: as many as tell a quarter of all agents from half of them
SWIMMER_TUNING_SEEDS = range(110, 118)
#: by when it has been decided
SWIMMER_TUNING_STEPS = 200_000
HUMANOID = "Humanoid-v5"
HUMANOID_TUNING_SEEDS = range(110, 113)
#: of the damping of the value fit, others than had given the idea
DAMPING_TUNING_SEEDS = range(110, 116)


class Cell(NamedTuple):
    """
    One training run.

    :param task: id of the environment
    :param algorithm: a key of :data:`~benchmarks.peers.algorithms.ALGORITHMS`
    :param variant: a key of :data:`~benchmarks.peers.variants.EVERY_VARIANT`; only ours has others than the first
    :param seed: of the training
    :param steps: of the training
    """

    task: str
    algorithm: str
    variant: str
    seed: int
    steps: int

    @property
    def name(self) -> str:
        """What tells it from all others, fit for a file's name."""
        return f"{self.task}_{self.kind}_{self.steps}_seed{self.seed}"

    @property
    def kind(self) -> str:
        """Algorithm and variant."""
        return f"{self.algorithm}.{self.variant}" if self.variant else self.algorithm


def cells_of(presets: Iterable[str]) -> list[Cell]:
    """
    :param presets: keys of :data:`PRESETS`
    :return: their cells, each once, in the order in which they are run
    :raises PeersError: if there is no such preset
    """
    cells: dict[Cell, None] = {}
    for preset in presets:
        if preset not in PRESETS:
            raise PeersError(f"`preset` must be one of {', '.join(PRESETS)}, got {preset!r}.")
        cells |= dict.fromkeys(PRESETS[preset])
    return list(cells)


def _seed_major(tasks: dict[str, int], algorithms: dict[str, int]) -> Iterator[Cell]:
    """
    One seed of everything before the next one, the algorithms that matter first: so results are of use early on.

    :param tasks: with the steps of each
    :param algorithms: with the number of seeds of each
    """
    for seed in range(max(algorithms.values())):
        for task, steps in tasks.items():
            for algorithm, seeds in algorithms.items():
                if seed < seeds:
                    yield Cell(task, algorithm, SHIPPED, seed, steps)


def _ablation() -> Iterator[Cell]:
    for seed in range(FEW_SEEDS):
        for variant in VARIANTS:
            for task in ABLATION_TASKS:
                yield Cell(task, OURS, variant, seed, MUJOCO_STEPS)


def _tuning(steps: int) -> Iterator[Cell]:
    for seed in TUNING_SEEDS:
        for variant in CANDIDATES:
            for task in TUNING_TASKS:
                yield Cell(task, OURS, variant, seed, steps)


def _tuning_of(task: str, candidates: Iterable[str], seeds: Iterable[int], steps: int) -> Iterator[Cell]:
    for seed in seeds:
        for variant in candidates:
            yield Cell(task, OURS, variant, seed, steps)


def _tuning_of_dampings() -> Iterator[Cell]:
    for seed in DAMPING_TUNING_SEEDS:
        for task, candidates in DAMPING_CANDIDATES.items():
            yield from _tuning_of(task, candidates, [seed], MUJOCO_STEPS)


def _mujoco() -> Iterator[Cell]:
    tasks = dict.fromkeys(MUJOCO_TASKS, MUJOCO_STEPS)
    first = {OURS: SEEDS, TRPO: SEEDS, PPO: SEEDS}
    yield from _seed_major(tasks, first)
    yield from _seed_major(tasks, {A2C: FEW_SEEDS, TIANSHOU_TRPO: FEW_SEEDS, TIANSHOU_NPG: FEW_SEEDS})


PRESETS: dict[str, tuple[Cell, ...]] = {
    "classic": tuple(_seed_major(CLASSIC_TASKS, {OURS: CLASSIC_SEEDS, TRPO: CLASSIC_SEEDS})),
    "mujoco": tuple(_mujoco()),
    "mujoco-3m": tuple(_seed_major(dict.fromkeys(PUBLISHED_PPO, LONG_STEPS), {OURS: SEEDS})),
    "ablation": tuple(_ablation()),
    "tuning": tuple(_tuning(TUNING_STEPS)),
    # What learns sooner need not end higher
    "tuning-long": tuple(_tuning(MUJOCO_STEPS)),
    "tuning-pendulum": tuple(_tuning_of(PENDULUM, PENDULUM_CANDIDATES, PENDULUM_TUNING_SEEDS, CLASSIC_TASKS[PENDULUM])),
    "tuning-swimmer": tuple(_tuning_of(SWIMMER, SWIMMER_CANDIDATES, SWIMMER_TUNING_SEEDS, SWIMMER_TUNING_STEPS)),
    "tuning-humanoid": tuple(_tuning_of(HUMANOID, HUMANOID_CANDIDATES, HUMANOID_TUNING_SEEDS, MUJOCO_STEPS)),
    "tuning-damping": tuple(_tuning_of_dampings()),
    "smoke": tuple(_seed_major({"CartPole-v1": SMOKE_STEPS}, {OURS: 1, TRPO: 1})),
}
