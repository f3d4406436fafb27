"""Each preset's promise, on the run that it shows and on others."""

from functools import cache

import numpy as np
import pytest

from sb3_gae.lab.presets import PRESETS
from sb3_gae.lab.readings import light
from sb3_gae.lab.simulation import Simulation

#: of the run that a preset shows, and of others
SEEDS = range(10)
#: when a control is turned in the presets that ask for it
TURN = 45


@cache
def run(name: str, seed: int | None = None, n_steps: int = TURN) -> Simulation:
    """The preset's own run if there is no seed; not to be changed."""
    preset = PRESETS[name]
    simulation = Simulation(preset.controls, preset.seed if seed is None else seed)
    for _ in range(n_steps):
        assert seed is not None or not simulation.moment.batch.truncated.any(), "an episode was cut"
        simulation.step()
    return simulation


def go_on(simulation: Simulation, n_steps: int, **changes: object) -> Simulation:
    """A copy that goes on with other controls."""
    copy = Simulation(simulation.controls, simulation.seed)
    copy.moment, copy.readings = simulation.moment, list(simulation.readings)
    copy.change(**changes)
    for _ in range(n_steps):
        copy.step()
    return copy


def scores(simulation: Simulation) -> np.ndarray:
    return np.array([reading.score for reading in simulation.readings])


def falls(simulation: Simulation) -> float:
    """How far the return went down, all in all."""
    return float(-np.minimum(np.diff(scores(simulation)), 0.0).sum())


def variance(simulation: Simulation) -> float:
    return float(np.mean([reading.variance for reading in simulation.readings[:30]]))


def share(simulation: Simulation) -> float:
    return float(np.mean([reading.share_of_gradient for reading in simulation.readings]))


@pytest.mark.parametrize("seed", [None, *SEEDS])
def test_the_sweet_spot_climbs_fast_and_smooth_with_a_green_light(seed: int | None) -> None:
    simulation = run("sweet_spot", seed)
    assert {light(reading.bias_angle) for reading in simulation.readings} == {"unbiased"}
    assert scores(simulation)[20] > 0.8 and scores(simulation)[-1] > 0.92
    assert falls(simulation) < 0.05


def test_the_sweet_spot_gets_to_optimal() -> None:
    simulation = run("sweet_spot", None, 60)
    assert simulation.status == "optimal"
    assert "optimal reached" in simulation.events[-1].text


@pytest.mark.parametrize("seed", [None, *SEEDS])
def test_one_step_on_a_broken_v_stalls_under_the_ceiling_with_a_red_light(seed: int | None) -> None:
    simulation = run("broken_v", seed)
    assert {light(reading.bias_angle) for reading in simulation.readings} == {"biased"}
    assert simulation.status == "stalled"
    assert scores(simulation).max() < 0.25


@pytest.mark.parametrize("seed", [None, *SEEDS[:4]])
def test_it_recovers_when_the_dial_goes_to_1(seed: int | None) -> None:
    simulation = go_on(run("broken_v", seed), 25, gae_lambda=1.0)
    assert {light(reading.bias_angle) for reading in simulation.readings[TURN:]} == {"unbiased"}
    assert scores(simulation)[-1] > 0.6


def test_more_episodes_do_not_help_it() -> None:
    assert scores(go_on(run("broken_v"), 15, batch_size=200))[-1] < 0.25


@pytest.mark.parametrize("seed", [None, *SEEDS])
def test_monte_carlo_is_unbiased_noisy_and_jitters(seed: int | None) -> None:
    simulation, calm = run("monte_carlo", seed), run("sweet_spot", seed)
    assert {light(reading.bias_angle) for reading in simulation.readings} == {"unbiased"}
    assert variance(simulation) > 2.0 * variance(calm)
    assert falls(simulation) > falls(calm)
    if seed is None:
        assert variance(simulation) > 3.0 * variance(calm)
        assert falls(simulation) > 0.1


def test_the_order_of_value_fit_and_policy_step_decides() -> None:
    simulation = run("value_first")
    assert share(simulation) < 0.4 and scores(simulation)[-1] < 0.25
    assert scores(go_on(simulation, 30, order="policy_first"))[-1] > 0.5


def test_it_does_so_on_average() -> None:
    first = [run("value_first", seed, 40) for seed in SEEDS]
    other = []
    for seed in SEEDS:
        simulation = Simulation(PRESETS["value_first"].controls, seed)
        simulation.change(order="policy_first")
        for _ in range(40):
            simulation.step()
        other.append(simulation)
    assert max(map(share, first)) < 0.5
    assert np.mean([share(simulation) for simulation in other]) > 0.7
    ends = [[scores(simulation)[-1] for simulation in runs] for runs in (first, other)]
    assert np.mean(ends[1]) > np.mean(ends[0]) + 0.2
