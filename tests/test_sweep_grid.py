"""Grids of a sweep: cells, conditions and presets, and refusals of bad ones."""

import inspect
import json
from typing import Any

import gymnasium
import numpy as np
import pytest

from sb3_gae import TRPOGAE
from sb3_gae.sweep import CONDITIONS, PRESETS, Cell, Curve, SweepError
from sb3_gae.sweep.grid import cells_of, product
from sb3_gae.sweep.plan import default_name, make_cells
from sb3_gae.sweep.settings import check_overrides

CELL = Cell("CartPole-v1", "trust_region", 0.99, 0.96, 3, 20)


def test_a_cell_comes_back_from_its_key() -> None:
    cell = Cell("CartPole-v1", "adam", 0.1 + 0.2, 1, 7, 5, '{"vf_steps": 3}')
    assert Cell.from_key(cell.key) == cell
    # Stored in many a journal: it must not change
    assert CELL.key == (
        '{"condition": "trust_region", "gae_lambda": 0.96, "gamma": 0.99, "iterations": 20, "overrides": "{}", '
        '"seed": 3, "task": "CartPole-v1"}'
    )


def test_whole_numbers_and_meaningless_lambdas_make_no_further_cells() -> None:
    assert Cell("T", "trust_region", 1, 0, 0, 1).key == Cell("T", "trust_region", 1.0, 0.0, 0, 1).key
    assert Cell("T", "no_vf", 1.0, 0.5, 0, 1) == Cell("T", "no_vf", 1.0, None, 0, 1)
    assert product(["trust_region", "no_vf"], [0.9], [0.0, 1.0]) == [
        Curve(0.9, 0.0),
        Curve(0.9, 1.0),
        Curve(0.9, None, "no_vf"),
    ]


def test_seeds_are_outermost_and_overrides_have_no_order() -> None:
    cells = cells_of(["T"], [Curve(0.9, 0.5), Curve(0.9, 1.0)], [4, 2], 10, {"b": 1, "a": [2]})
    assert [(cell.seed, cell.gae_lambda) for cell in cells] == [(4, 0.5), (4, 1.0), (2, 0.5), (2, 1.0)]
    assert cells[0] == cells_of(["T"], [Curve(0.9, 0.5)], [4], 10, {"a": [2], "b": 1})[0]
    assert cells[0].hyperparameters == {"a": [2], "b": 1, "gamma": 0.9, "gae_lambda": 0.5}


@pytest.mark.parametrize(
    ("condition", "settings"),
    [
        ("trust_region", {}),
        ("no_vf", {"baseline": "time"}),
        ("improvement_lambda", {"gae_lambda": "improvement"}),
        ("auto_lambda", {"gae_lambda": "auto"}),
        ("explained_variance_lambda", {"gae_lambda": "explained_variance"}),
        ("value_first", {"value_fit_first": True}),
        ("adam", {"vf_optimizer": "adam"}),
        ("mc_targets", {"value_lambda": 1.0}),
        ("lambda_targets", {"value_lambda": None}),
        ("shared_frozen", {"policy": "SharedMlpPolicy", "vf_kl_fraction": 0.0}),
        ("shared_joint", {"policy": "SharedMlpPolicy", "vf_kl_fraction": 0.01}),
    ],
)
def test_conditions_are_arguments(condition: str, settings: dict[str, Any]) -> None:
    of_lambda = {} if condition == "no_vf" or condition.endswith("_lambda") else {"gae_lambda": 0.5}
    assert Cell("T", condition, 0.9, 0.5, 0, 1).hyperparameters == {"gamma": 0.9} | settings | of_lambda
    assert set(CONDITIONS[condition].settings) <= set(inspect.signature(TRPOGAE).parameters)


@pytest.mark.parametrize(
    ("name", "n_curves", "seeds", "iterations"),
    [
        ("fig2-left", 10, 21, 50),
        ("fig2-right", 72, 21, 20),
        ("fig3-left", 10, 9, 500),
        ("fig3-right", 3, 5, 1000),
        ("fig4b", 3, 5, 500),
    ],
)
def test_presets_are_of_the_papers_size(name: str, n_curves: int, seeds: int, iterations: int) -> None:
    cells = make_cells(name)
    assert len(cells) == n_curves * seeds
    assert {cell.iterations for cell in cells} == {iterations}
    assert {cell.seed for cell in cells} == set(range(seeds))
    assert {cell.task for cell in cells} <= set(gymnasium.registry)


def test_presets_have_the_papers_curves() -> None:
    left = {(curve.gamma, curve.gae_lambda) for curve in PRESETS["fig2-left"].curves}
    assert left == {(0.99, value) for value in (None, 1.0, 0.99, 0.98, 0.96, 0.92, 0.84, 0.68, 0.36, 0.0)}
    biped = {(curve.gamma, curve.gae_lambda) for curve in PRESETS["fig3-left"].curves}
    at_995 = {(0.995, value) for value in (0.92, 0.96, 0.98, 0.99, 1.0)}
    assert biped == {(0.96, 0.96), (0.98, 0.96), (0.99, 0.96), (1.0, 0.96), (1.0, None)} | at_995


def test_a_preset_takes_another_size_and_task() -> None:
    cells = make_cells("fig3-right", env="CartPole-v1", seeds=[7], iterations=3, hyperparams={"vf_steps": 2})
    assert {(cell.task, cell.seed, cell.iterations) for cell in cells} == {("CartPole-v1", 7, 3)}
    assert json.loads(cells[0].overrides) == {"n_steps": 782, "vf_steps": 2}


def test_arrays_are_lists() -> None:
    plain = make_cells(env="CartPole-v1", gammas=[0.9, 0.99], lambdas=[0.9, 1.0], seeds=[0, 1], iterations=2)
    gammas, lambdas, iterations = np.array([0.9, 0.99]), np.linspace(0.9, 1.0, 2), np.int64(2)
    for seeds in (np.arange(2), np.int64(2)):
        of_arrays = make_cells(env="CartPole-v1", gammas=gammas, lambdas=lambdas, seeds=seeds, iterations=iterations)  # type: ignore[arg-type]
        assert [cell.key for cell in of_arrays] == [cell.key for cell in plain]


def test_names_are_fit_for_files() -> None:
    assert default_name("small", ["T-v0"]) == "small"
    assert default_name(None, ["ALE/Pong-v5", "ALE/Pong-v5", "T-v0"]) == "ALE-Pong-v5_T-v0"


@pytest.mark.parametrize(
    ("grid", "message"),
    [
        ({"gammas": [1.1]}, "`gamma` must be a number in [0, 1], got 1.1"),
        ({"lambdas": [-0.5]}, "`gae_lambda` must be a number in [0, 1], got -0.5"),
        ({"lambdas": [float("nan")]}, "`gae_lambda` must be a number in [0, 1], got nan"),
        ({"lambdas": []}, "`lambdas` is missing, of which the condition 'trust_region' needs at least one"),
        ({"lambdas": None, "conditions": ["no_vf", "adam"]}, "`lambdas` is missing, of which the condition 'adam'"),
        ({"gammas": []}, "The grid is empty"),
        ({"seeds": 0}, "`seeds` must be a whole number of at least 1, got 0"),
        ({"seeds": []}, "The grid is empty"),
        ({"seeds": [-1]}, "`seeds` must be a whole number of at least 0"),
        ({"seeds": [2**32]}, "`seeds` must be a number in [0, 4.29497e+09], got 4294967296"),
        ({"iterations": 0}, "`iterations` must be a whole number of at least 1"),
        ({"conditions": ["adm"]}, "did you mean 'adam'?"),
        ({"env": None}, "`env` is missing"),
        ({"hyperparams": {"policy_kwargs": {"activation_fn": object}}}, "`-params` takes numbers"),
    ],
)
def test_bad_grids_are_refused(grid: dict[str, Any], message: str) -> None:
    good: dict[str, Any] = {"env": "CartPole-v1", "gammas": [0.9], "lambdas": [1.0], "seeds": 1, "iterations": 1}
    with pytest.raises(SweepError) as error:
        make_cells(**good | grid)
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_a_preset_has_its_own_curves() -> None:
    with pytest.raises(SweepError, match="`gammas` belongs to the preset"):
        make_cells("small", gammas=[0.9])
    with pytest.raises(SweepError, match=r"got 'smal'; did you mean 'small'\?$"):
        make_cells("smal")
    with pytest.raises(SweepError, match="`iterations` must be a whole number of at least 1, got 0"):
        make_cells("small", iterations=0)


@pytest.mark.parametrize(
    ("condition", "overrides", "message"),
    [
        ("trust_region", '{"gamma": 0.9}', "use --gammas"),
        ("trust_region", '{"n_timesteps": 9}', "use --iterations"),
        ("adam", '{"vf_optimizer": "adam"}', "is what the condition 'adam' sets"),
        ("trust_region", '{"vf_step": 3}', "did you mean 'vf_steps'?"),
    ],
)
def test_bad_overrides_are_refused(condition: str, overrides: str, message: str) -> None:
    with pytest.raises(SweepError) as error:
        check_overrides([Cell("T", condition, 0.9, 1.0, 0, 1, overrides)])
    assert message in str(error.value)
