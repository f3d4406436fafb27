"""The scripts behind docs/why-it-works.md, at a size that takes seconds."""

import inspect
import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest
import yaml

from sb3_gae import TRPOGAE
from sb3_gae.diagnostics.rollout_diagnostics import gradient_response, lambda_errors
from sb3_gae.presets import PAPER_LAMBDAS
from sb3_gae.zoo import default_hyperparams_path

sys.path.insert(0, str(Path(__file__).parents[1] / "docs"))

import lambda_variants as variants
import training_diagnostics as diagnostics
import training_figures as figures
import value_errors as values
from gridworld_figures import GAMMA, half_trained_policy
from measured_lambda import exact

ENV = "GaeCartPole-v0"
TASK = diagnostics.TASKS[ENV]._replace(
    checkpoints=(1, 3), n_envs=16, n_steps=200, lookahead=0, n_rollouts=1, batch=1.0, lags=(0, 1, 3)
)


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("results") / "results.jsonl"
    diagnostics.measure_run(ENV, TASK, 0, path)
    return path


#: that the measurements were made with, where another one is shipped since; docs/why-it-works.md says so
FORMER_DISCOUNTS = {"Pendulum-v1": 0.9}


@pytest.mark.parametrize("env", diagnostics.TASKS)
def test_discount_and_lambda_are_the_shipped_ones(env: str) -> None:
    settings = yaml.safe_load(default_hyperparams_path().read_text())[env]
    settings["gamma"] = FORMER_DISCOUNTS.get(env, settings["gamma"])
    default = inspect.signature(TRPOGAE).parameters["gae_lambda"].default
    task = diagnostics.TASKS[env]
    assert (task.gamma, task.gae_lambda) == (settings["gamma"], settings.get("gae_lambda", default))


def test_a_run_is_stored_once_and_a_missing_checkpoint_is_measured_again(results: Path) -> None:
    text = results.read_text()
    assert [row["iteration"] for row in diagnostics.stored(results)] == [1, 3]
    diagnostics.measure_run(ENV, TASK, 0, results)
    assert results.read_text() == text
    results.write_text(text.splitlines()[0] + "\n")
    diagnostics.measure_run(ENV, TASK, 0, results)
    assert [row["iteration"] for row in diagnostics.stored(results)] == [1, 3]
    results.write_text(text)


def test_sums_over_one_rollout_say_what_the_packages_own_estimates_say() -> None:
    _, frozen = diagnostics.train(ENV, TASK._replace(checkpoints=(1,)), 0)
    player = diagnostics.Player(ENV, TASK, 0)
    player.load(frozen)
    (buffer,) = player.rollouts(1)
    gradients, response, counted = diagnostics.Sums(), diagnostics.Sums(), player.counted(buffer)
    gradients.add(player.model, buffer, buffer.advantage_grid([TASK.gamma], PAPER_LAMBDAS)[0], counted)
    truth = gradients.sums[:, -1:]
    found = diagnostics.errors_of_gradient(gradients, truth, 1.0)
    expected = lambda_errors(player.model.policy, buffer, PAPER_LAMBDAS)
    np.testing.assert_allclose(found["bias_squared"][0], expected.bias_squared, rtol=1e-3, atol=1e-5)
    np.testing.assert_allclose(found["variance"][0], expected.variance, rtol=1e-3)
    response.add(player.model, buffer, diagnostics.delayed_signals(buffer, TASK.lags), counted)
    delayed = diagnostics.squared_norm(response.sums, response.steps).value
    both = gradient_response(player.model.policy, buffer, 4)
    for part, estimate in zip(np.split(delayed, 2), both, strict=True):
        np.testing.assert_allclose(part, estimate.value[list(TASK.lags)], rtol=1e-3, atol=1e-5)
    player.close()


def test_value_functions_are_what_they_are_called(results: Path) -> None:
    for row in diagnostics.stored(results):
        found = row["value_functions"]
        assert set(found) == {"own", "refitted", "earlier", "half", "zero", "offset"}
        assert found["zero"]["explained_variance"] == pytest.approx(0.0, abs=0.01)
        # A constant is not seen by the explained variance
        assert found["offset"]["explained_variance"] == pytest.approx(found["own"]["explained_variance"], abs=0.01)
        assert found["refitted"]["monte_carlo_error"] < found["own"]["monte_carlo_error"]
        assert found["own"]["bias_squared"][0][-1] == 0.0
        assert row["advantages"]["rms_difference"][-1] == 0.0


def test_figures_and_tables_come_from_what_is_stored(results: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = diagnostics.stored(results)
    figures.print_table(rows)
    assert capsys.readouterr().out.count(ENV) == 2
    figures.print_medians(rows)
    assert "| Cart-pole | 2 | own |" in capsys.readouterr().out
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(figures.CHECKPOINTS, ENV, (1, 3, 30))
        for draw in (figures.draw_lambdas, figures.draw_response, figures.draw_values):
            draw(rows).canvas.draw()
            plt.close("all")


def test_correlations_and_their_figure(results: Path, capsys: pytest.CaptureFixture[str]) -> None:
    groups = {
        "Gridworld": values.gridworld_cases(n_runs=2, n_steps=(2,)),
        "Training": values.training_cases(diagnostics.stored(results)),
    }
    for cases in groups.values():
        values.print_table("A title", cases, values.interval_within)
        table = capsys.readouterr().out
        # The error in the gradient is the bias at λ = 0
        assert f"| {values.GRADIENT} | 1.00 [1.00, 1.00] |" in table
    values.draw(groups).canvas.draw()
    plt.close("all")


def test_rank_correlation_is_spearmans() -> None:
    assert values.rank_correlation([1.0, 2.0, 3.0], [10.0, 100.0, 1000.0]) == pytest.approx(1.0)
    # With ties: ranks 1.5, 1.5, 3 and 1, 2, 3
    assert values.rank_correlation([0.0, 0.0, 1.0], [0.0, 1.0, 2.0]) == pytest.approx(np.sqrt(3) / 2)
    assert np.isnan(values.rank_correlation([1.0, 1.0], [1.0, 2.0]))


def test_a_lambda_for_each_state_is_searched_from_the_best_common_one() -> None:
    policy = half_trained_policy()
    nothing = np.zeros(policy.mdp.n_states)
    common = float(variants.MERIT(exact(policy, nothing, 20)).max())
    bound = float(np.linalg.norm(policy.true_gradient(GAMMA)))
    assert common < variants.best_for_each_state(policy, nothing, 20) < bound
