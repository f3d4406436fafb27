"""Which runs the benchmark against peers has, with which settings."""

import json
from pathlib import Path

import gymnasium
import pytest
import yaml

from benchmarks.peers.algorithms import A2C, ALGORITHMS, OURS, PPO, TIANSHOU_NPG, TIANSHOU_TRPO, TRPO
from benchmarks.peers.cost import EVALUATION, cost_of, read_speeds
from benchmarks.peers.errors import PeersError
from benchmarks.peers.journal import Record
from benchmarks.peers.plan import PRESETS, Cell, cells_of
from benchmarks.peers.protocol import CLASSIC_TASKS, EVALUATIONS, MUJOCO_TASKS, evaluation_interval
from benchmarks.peers.settings import described, settings_for, settings_of, zoo_file
from benchmarks.peers.table import read_results
from benchmarks.peers.variants import VARIANTS
from sb3_gae import TRPOGAE
from sb3_gae.zoo import default_hyperparams_path

ALL = cells_of(PRESETS)


def test_mujoco_has_the_seeds_that_are_asked_for() -> None:
    cells = PRESETS["mujoco"]
    for task in MUJOCO_TASKS:
        seeds = {name: sum((cell.task, cell.algorithm) == (task, name) for cell in cells) for name in ALGORITHMS}
        assert seeds == {OURS: 5, TRPO: 5, PPO: 5, A2C: 3, TIANSHOU_TRPO: 3, TIANSHOU_NPG: 3}
    assert {cell.steps for cell in cells} == {1_000_000}


def test_a_seed_of_everything_that_matters_comes_before_the_next() -> None:
    cells = PRESETS["mujoco"]
    first = cells[: 3 * len(MUJOCO_TASKS)]
    assert {(cell.task, cell.algorithm, cell.seed) for cell in first} == {
        (task, name, 0) for task in MUJOCO_TASKS for name in (OURS, TRPO, PPO)
    }


def test_a_cell_of_two_presets_is_run_once() -> None:
    cells = cells_of(["mujoco", "ablation"])
    assert len(set(cells)) == len(cells) < len(PRESETS["mujoco"]) + len(PRESETS["ablation"])


def test_names_of_cells_tell_them_apart() -> None:
    assert len({cell.name for cell in ALL}) == len(ALL)
    assert Cell("Hopper-v5", OURS, "adam", 1, 1000).name == "Hopper-v5_trpo_gae.adam_1000_seed1"


def test_an_unknown_preset_is_named() -> None:
    with pytest.raises(PeersError, match=r"`preset` must be one of .*smoke, got 'all'"):
        cells_of(["all"])


@pytest.mark.parametrize(
    "cell", {(cell.task, cell.algorithm, cell.variant): cell for cell in ALL}.values(), ids=lambda c: c.name
)
def test_every_cell_has_settings_and_a_cost(cell: Cell) -> None:
    assert cell.task in gymnasium.registry
    settings = json.loads(json.dumps(settings_of(cell)))
    assert json.loads(described(cell.algorithm, settings)).items() >= settings.items()
    assert 1 < cost_of(cell, read_speeds(), []) < 36_000


def test_settings_of_version_4_serve_version_5() -> None:
    zoo = yaml.safe_load(zoo_file("ppo").read_text())
    settings = settings_of(Cell("Walker2d-v5", PPO, "", 0, 1_000_000))
    assert settings == zoo["Walker2d-v4"] | {"n_timesteps": 1_000_000}
    assert settings_for({"Walker2d-v5": {"gamma": 1.0}} | zoo, "Walker2d-v5", "ppo.yml") == {"gamma": 1.0}
    with pytest.raises(PeersError, match=r"`task`: ppo.yml has no settings for Walker2d-v3"):
        settings_for(zoo, "Walker2d-v3", "ppo.yml")


def test_ours_are_the_shipped_settings() -> None:
    shipped = yaml.safe_load(Path(default_hyperparams_path()).read_text())["Hopper-v5"]
    cell = Cell("Hopper-v5", OURS, "", 0, 1_000_000)
    assert settings_of(cell) == shipped | {"n_timesteps": 1_000_000}
    assert settings_of(cell._replace(variant="one-value-step")) == settings_of(cell) | {"vf_steps": 1}


def test_classic_control_has_the_steps_of_the_zoo() -> None:
    zoo = yaml.safe_load(zoo_file("trpo").read_text())
    assert {task: int(zoo[task]["n_timesteps"]) for task in CLASSIC_TASKS} == CLASSIC_TASKS


def test_variants_undo_a_choice() -> None:
    # Not on Hopper, whose shipped fit is as close as one of the variants
    shipped = settings_of(Cell("HalfCheetah-v5", OURS, "", 0, 1_000_000))
    for name, variant in VARIANTS.items():
        changed = settings_of(Cell("HalfCheetah-v5", OURS, name, 0, 1_000_000))
        assert (changed != shipped) == bool(variant.overrides)


@pytest.mark.parametrize("name", VARIANTS)
def test_variants_are_arguments_that_the_algorithm_takes(name: str) -> None:
    # `normalize` is rl-zoo3's own
    arguments = {key: value for key, value in VARIANTS[name].overrides.items() if key != "normalize"}
    model = TRPOGAE("MlpPolicy", "Pendulum-v1", **arguments)
    assert all(getattr(model, key) == value for key, value in arguments.items())
    assert (model.gae_lambda == 0.95) == ("gae_lambda" not in arguments)


def test_what_was_tried_in_tuning_is_what_its_settings_say_today() -> None:
    """Else what is shipped later would change what a row of the table means, and new seeds would join old ones."""
    table = read_results()
    tried = table[(table["algorithm"] == OURS) & ~table["variant"].isin(VARIANTS)]
    assert len(tried)
    for (task, variant, steps, settings), _ in tried.groupby(["task", "variant", "steps", "settings"]):
        today = described(OURS, settings_of(Cell(task, OURS, variant, 0, int(steps))))
        assert json.loads(today) == json.loads(described(OURS, json.loads(settings))), (task, variant)


def test_there_are_as_many_evaluations_as_said() -> None:
    assert [evaluation_interval(steps) for steps in (10, 100_000)] == [1, 100_000 // EVALUATIONS]


def test_costs_follow_what_was_run() -> None:
    cell = Cell("CartPole-v1", OURS, "", 0, 100_000)
    speeds = {("CartPole-v1", TRPO): 1000.0, ("CartPole-v1", EVALUATION): 5000.0}
    # 100 s of training, and 41 evaluations of ten episodes of 500 steps, a second each
    assert cost_of(cell, speeds, []) == pytest.approx(141)
    evaluations = [{"steps": 50_000, "cpu_seconds": 20.0, "evaluation_seconds": 5.0}]
    assert cost_of(cell, speeds, [(cell, Record({}, evaluations, None))]) == pytest.approx(50)
