"""The demonstration's model: the truth beside the estimate, determinism, what each control does, what is logged."""

import math
import time
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_gae.estimators.advantages import generalized_advantages
from sb3_gae.lab.controls import VALUE_FUNCTIONS, Controls
from sb3_gae.lab.estimator import trace
from sb3_gae.lab.moment import best_return, first_moment, world
from sb3_gae.lab.presets import PRESETS, load_preset
from sb3_gae.lab.readings import light, status
from sb3_gae.lab.simulation import Simulation

value_functions = st.sampled_from(VALUE_FUNCTIONS)


def run(controls: Controls, n_steps: int, seed: int = 0) -> Simulation:
    simulation = Simulation(controls, seed)
    for _ in range(n_steps):
        simulation.step()
    return simulation


@settings(max_examples=15)
@given(value_functions, st.floats(0.5, 0.99), st.integers(0, 100))
def test_lambda_1_is_unbiased_for_any_value_function(value_function: str, gamma: float, seed: int) -> None:
    simulation = run(Controls(1.0, gamma, value_function, batch_size=2, learning_rate=1.0), 2, seed)
    assert simulation.reading.bias_angle < 1e-6
    assert light(simulation.reading.bias_angle) == "unbiased"


@pytest.mark.parametrize("value_function", ["zero", "noisy", "frozen"])
def test_bias_grows_as_lambda_shrinks_under_a_wrong_value_function(value_function: str) -> None:
    simulation = run(Controls(1.0, value_function=value_function), 10)
    angles = []
    for gae_lambda in np.linspace(1.0, 0.0, 11).tolist():
        simulation.change(gae_lambda=gae_lambda)
        angles.append(simulation.reading.bias_angle)
    assert np.all(np.diff(angles) > -1e-9) and angles[-1] > 0.1


def test_exact_values_are_unbiased_for_any_lambda() -> None:
    assert max(reading.bias_angle for reading in run(Controls(0.0), 5).readings) < 1e-6


@pytest.mark.parametrize("name", PRESETS)
def test_a_preset_gives_the_same_run_step_for_step(name: str) -> None:
    first, second = load_preset(name), load_preset(name)
    for _ in range(5):
        first.step(), second.step()
    first.reset()
    for _ in range(5):
        first.step()
    np.testing.assert_array_equal(first.moment.logits, second.moment.logits)
    assert first.readings == second.readings and first.events == second.events


def test_a_run_depends_on_the_controls_of_its_steps_and_not_on_what_they_were_between() -> None:
    straight, dragged = Simulation(Controls(0.5, batch_size=3)), Simulation(Controls(0.96, 0.9, "zero", batch_size=7))
    for changes in (dict(gae_lambda=0.1), dict(batch_size=3), dict(gamma=0.95), dict(value_function="exact")):
        dragged.change(**changes)
        assert dragged.moment.batch.states.shape[1] == dragged.controls.batch_size
    dragged.change(gae_lambda=0.5)
    for _ in range(2):
        straight.step(), dragged.step()
    np.testing.assert_array_equal(straight.moment.logits, dragged.moment.logits)
    assert straight.readings[1:] == dragged.readings[1:]


def test_another_seed_gives_another_run() -> None:
    assert run(Controls(), 2, seed=0).readings[1:] != run(Controls(), 2, seed=1).readings[1:]


def test_the_exact_variance_is_that_of_sampled_batches() -> None:
    moment = first_moment(Controls(0.9, value_function="noisy", batch_size=4))
    batches = [replace(moment, step=step).batch_gradient for step in range(400)]
    assert np.var(batches, axis=0).sum() == pytest.approx(moment.variance, rel=0.15)
    assert np.mean(batches, axis=0) == pytest.approx(moment.moments.mean, abs=4 * math.sqrt(moment.variance / 400))


def test_the_estimate_is_the_packages_own() -> None:
    moment = first_moment(Controls(0.7, 0.9, "noisy", batch_size=3))
    batch, values = moment.batch, np.where(world().terminal, 0.0, moment.values)
    deltas = batch.rewards + 0.9 * values[batch.next_states] - values[batch.states]
    expected = generalized_advantages(np.where(batch.mask, deltas, 0.0), batch.dones, 0.9, 0.7)
    np.testing.assert_allclose(moment.advantages[batch.mask], expected[batch.mask], atol=1e-12)


@pytest.mark.parametrize("episode", [0, 2, 99])
def test_a_trace_adds_up_to_the_advantage(episode: int) -> None:
    moment = first_moment(Controls(0.7, 0.9, "noisy", batch_size=3))
    for start in (0, 3, 10_000):
        shown = trace(moment, episode, start)
        assert shown.weights @ shown.deltas[shown.start :] == pytest.approx(shown.advantages[shown.start])
        assert len(shown.states) == len(shown.actions) + 1 == len(shown.rewards) + 1


def test_value_functions_are_what_they_say() -> None:
    simulation = run(Controls(value_function="zero", batch_size=5, learning_rate=1.0), 3)
    np.testing.assert_array_equal(simulation.moment.values, 0.0)
    simulation.change(value_function="exact")
    before = simulation.moment.policy.values(0.95)
    np.testing.assert_array_equal(simulation.moment.values, before)
    simulation.change(value_function="frozen")
    simulation.step()
    np.testing.assert_array_equal(simulation.moment.values, before)
    assert np.abs(simulation.moment.exact_values - before).max() > 1e-3
    simulation.change(value_function="noisy")
    errors = [simulation.moment.values - simulation.moment.exact_values]
    simulation.step()
    errors.append(simulation.moment.values - simulation.moment.exact_values)
    np.testing.assert_allclose(errors[0], errors[1], atol=1e-12)
    assert np.abs(errors[0]).max() > 0.5


def test_the_order_decides_which_values_the_estimate_sees() -> None:
    moment = first_moment(Controls(value_function="learned", batch_size=1))
    np.testing.assert_array_equal(moment.estimator_values, moment.values)
    first = moment.with_controls(replace(moment.controls, order="value_first"))
    np.testing.assert_array_equal(first.estimator_values, first.next().learned)


def test_score_is_the_return_in_units_of_the_best() -> None:
    moment = first_moment(Controls(gamma=1.0))
    assert best_return(1.0) == pytest.approx(1.0)
    assert moment.score == pytest.approx(moment.policy.expected_return(1.0))
    assert first_moment(Controls(gamma=0.0)).score == pytest.approx(0.0, abs=1.0)


def test_controls_change_a_run_and_are_logged_once_for_a_drag() -> None:
    simulation = Simulation(Controls(0.0, value_function="zero"))
    assert [event.text for event in simulation.events] == ["bias came on (0.66 rad)"]
    simulation.step()
    for gae_lambda in (0.3, 0.6, 1.0):
        simulation.change(gae_lambda=gae_lambda)
    simulation.change(gae_lambda=1.0)
    texts = [event.text for event in simulation.events]
    assert texts[1] == "λ: 0 → 1" and texts[-1] == "bias went off (0.00 rad)"
    assert len([text for text in texts if "→" in text]) == 1
    assert len(simulation.readings) == 2


def test_each_change_of_the_light_is_logged() -> None:
    simulation = Simulation(Controls(1.0, value_function="zero"))
    shown, angles = [], []
    for gae_lambda in (0.9, 0.0, 0.9, 1.0, 0.0, 1.0):
        simulation.change(gae_lambda=gae_lambda)
        shown.append(light(simulation.reading.bias_angle))
        angles.append(f"{simulation.reading.bias_angle:.2f} rad")
    assert shown == ["slight", "biased", "slight", "unbiased", "biased", "unbiased"]
    words = [
        "a slight bias came on", "the bias is no longer slight", "the bias became slight", "bias went off", "bias came on",
        "bias went off",
    ]  # fmt: skip
    logged = [event.text for event in simulation.events if "→" not in event.text]
    assert logged == [f"{word} ({angle})" for word, angle in zip(words, angles, strict=True)]


def test_a_turn_of_the_dial_takes_a_few_milliseconds() -> None:
    simulation = run(Controls(0.0, value_function="zero"), 3)
    start = time.process_time()
    for step in range(20):
        simulation.change(gae_lambda=step / 20)
    assert (time.process_time() - start) / 20 < 0.02


def test_status() -> None:
    assert status([0.1]) == "climbing"
    assert status([0.1] * 21) == "stalled"
    assert status([0.1 + 0.01 * step for step in range(30)]) == "climbing"
    assert status([0.96] * 30) == "optimal"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"gae_lambda": 1.1}, "gae_lambda"),
        ({"gae_lambda": "1"}, "gae_lambda"),
        ({"gamma": math.nan}, "gamma"),
        ({"value_function": "__import__('os')"}, "value_function"),
        ({"batch_size": 10**9}, "batch_size"),
        ({"batch_size": 2.5}, "batch_size"),
        ({"learning_rate": 0.0}, "learning_rate"),
        ({"order": None}, "order"),
    ],
)
def test_bad_controls_are_refused_and_change_nothing(changes: dict[str, Any], message: str) -> None:
    simulation = Simulation(Controls())
    with pytest.raises(ValueError, match=message):
        simulation.change(**changes)
    assert simulation.controls == Controls() and not simulation.events


def test_an_unknown_preset_is_refused() -> None:
    with pytest.raises(ValueError, match="sweet_spot"):
        load_preset("none")
