"""A λ that is no fixed number: schedules, and rules that learn from the last batches."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from envs_for_tests import differing, small_model, state_of, train_once, vec_env
from stable_baselines3.common.callbacks import BaseCallback

from sb3_gae import TRPOGAE
from sb3_gae.advantages import discounted_returns
from sb3_gae.gridworld import TabularPolicy, gridworld
from sb3_gae.lambda_rules import ExplainedVarianceLambda, MeasuredLambda
from sb3_gae.rollout_diagnostics import LambdaErrors

GRID = (0.0, 0.5, 0.8, 0.9, 0.96, 1.0)


class RolloutLog(BaseCallback):
    """What was logged about each rollout."""

    def __init__(self) -> None:
        super().__init__()
        self.entries: list[dict[str, float]] = []

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        self.entries.append(dict(self.logger.name_to_value))


def feed(rule: MeasuredLambda, monkeypatch: pytest.MonkeyPatch, batches: Sequence[tuple[Any, Any]]) -> list[float]:
    """Let it see these estimates of bias squared and variance, and return where it was before each and at the end."""
    places = [rule.value(1.0)]
    monkeypatch.setattr("sb3_gae.lambda_rules.has_several_trajectories", lambda buffer: True)
    for bias_squared, variance in batches:
        bias, var, nothing = np.asarray(bias_squared), np.asarray(variance), np.zeros(len(rule.lambdas))
        errors = LambdaErrors(np.array(rule.lambdas), bias, nothing, var, nothing, np.maximum(bias, 0) + var, nothing)
        monkeypatch.setattr("sb3_gae.lambda_rules.lambda_errors", lambda *args, errors=errors: errors)
        rule.learn_from(None, None)  # type: ignore[arg-type]
        places.append(rule.value(1.0))
    return places


def exact_curve(scale_of_errors: float) -> tuple[np.ndarray, np.ndarray]:
    """True bias squared and variance on the gridworld, with values that are wrong by so much."""
    mdp = gridworld()
    policy = TabularPolicy(mdp, np.random.default_rng(0).normal(size=mdp.rewards.shape[:2]) * 0.5)
    values = policy.values(0.95)
    wrong = values + scale_of_errors * np.random.default_rng(1).normal(size=values.shape) * ~mdp.terminal
    curve = policy.lambda_curve(wrong, 0.95, GRID)
    return curve.bias_squared, curve.variance / 40.0


@pytest.mark.parametrize("scale_of_errors", [0.0, 0.3, 3.0, 30.0])
def test_it_finds_the_best_lambda_of_the_exact_gridworld(scale_of_errors: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """From true errors under noise of their own size, unbiased as the estimates are."""
    bias, variance = exact_curve(scale_of_errors)
    best = float(np.min(bias + variance))
    rng = np.random.default_rng(2)
    batches = [
        (bias + rng.normal(size=len(GRID)) * (bias + 0.1 * variance), variance * rng.uniform(0.7, 1.3, len(GRID)))
        for _ in range(80)
    ]
    rule = MeasuredLambda(GRID)
    feed(rule, monkeypatch, batches)
    assert (bias + variance)[rule.place] <= 1.25 * best


def test_the_best_lambda_depends_on_the_value_function() -> None:
    """So that the test above asks for different answers."""
    chosen = [GRID[int(np.argmin(sum(exact_curve(scale))))] for scale in (0.0, 0.3, 30.0)]
    assert chosen[0] < chosen[1] < chosen[2] == 1.0


def test_it_waits_and_then_moves_by_one_place_at_most(monkeypatch: pytest.MonkeyPatch) -> None:
    variance_alone = (np.zeros(6), np.arange(1.0, 7.0))
    places = feed(MeasuredLambda(GRID, patience=3), monkeypatch, [variance_alone] * 8)
    assert places == [0.96, 0.96, 0.96, 0.9, 0.8, 0.5, 0.0, 0.0, 0.0]


def test_batches_count_in_units_of_their_own_variance(monkeypatch: pytest.MonkeyPatch) -> None:
    for scale in (1e-12, 1.0, 1e12):
        batches = [(np.array([9.0, 3, 1, 0.1, 0, 0]), np.arange(1.0, 7.0))] * 5
        scaled = [(scale * bias, scale * variance) for bias, variance in batches]
        # A batch on a scale of its own does not outvote the others
        mixed = [*batches, (1e20 * np.zeros(6), 1e20 * np.arange(6.0, 0.0, -1.0)), *batches]
        assert feed(MeasuredLambda(GRID), monkeypatch, scaled)[-1] == feed(MeasuredLambda(GRID), monkeypatch, batches)[-1]
        assert feed(MeasuredLambda(GRID), monkeypatch, mixed)[-1] == 0.9


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_estimates_that_are_no_numbers_change_nothing(bad: float, monkeypatch: pytest.MonkeyPatch) -> None:
    rule = MeasuredLambda(GRID, patience=1)
    feed(rule, monkeypatch, [(np.full(6, bad), np.ones(6)), (np.zeros(6), np.zeros(6))])
    assert rule.value(1.0) == 0.96
    assert rule._n_batches == 0


@pytest.mark.parametrize("lambdas", [(0.5, 0.9), (0.9, 0.5, 1.0), (0.5, 0.5, 1.0), (), (-0.1, 1.0)])
def test_grids_that_do_not_ascend_to_1_are_refused(lambdas: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match="`lambdas` must"):
        MeasuredLambda(lambdas)


def test_the_simple_rule_trusts_a_value_function_that_explains_more() -> None:
    rule = ExplainedVarianceLambda(lowest=0.9, memory=0.5)
    assert rule.value(1.0) == 1.0
    model = small_model(vec_env(n_envs=4), n_steps=40)
    train_once(model)
    buffer = model.rollout_buffer
    buffer.values = np.zeros_like(buffer.values)
    rule.learn_from(model.policy, buffer)
    assert rule.value(1.0) == pytest.approx(1.0, abs=0.02)
    buffer.values = discounted_returns(buffer.rewards, np.zeros_like(buffer.rewards), buffer.dones, buffer.gamma)
    buffer.truncated[:], buffer.terminated[:] = False, buffer.dones
    buffer.last_values[:] = 0.0
    for _ in range(20):
        rule.learn_from(model.policy, buffer)
    assert rule.value(1.0) == pytest.approx(0.9, abs=0.001)


# In training


def test_auto_is_logged_and_applied_to_the_next_batch(monkeypatch: pytest.MonkeyPatch) -> None:
    model = small_model(vec_env(n_envs=4), n_steps=40, gae_lambda="auto")
    assert model.gae_lambda == 0.96
    rule = model._lambda_rule
    assert isinstance(rule, MeasuredLambda)
    rule.patience = 1
    used = []
    for _ in range(6):
        expected = rule.value(1.0)
        callback = RolloutLog()
        train_once(model, callback)
        (log,) = callback.entries
        assert log["gae_lambda/value"] == model.gae_lambda == model.rollout_buffer.gae_lambda == expected
        assert f"gae_lambda/variance/lambda_{expected:g}" in log
        assert "gae_lambda/bias_squared/lambda_1" in log
        used.append(expected)
    assert len(set(used)) > 1


def test_a_schedule_is_followed() -> None:
    model = small_model(vec_env(), gae_lambda=lambda progress: 0.5 + 0.5 * progress)
    log = RolloutLog()
    model.learn(4 * 32, callback=log)
    values = [entry["gae_lambda/value"] for entry in log.entries]
    assert values == [1.0, 0.875, 0.75, 0.625]


def test_measuring_draws_no_random_numbers_of_training() -> None:
    """The first batches, before λ moves, go as with the fixed λ that it starts from."""
    states = []
    for gae_lambda in (0.96, "auto"):
        model = small_model(vec_env(n_envs=4), n_steps=40, gae_lambda=gae_lambda)
        for _ in range(3):
            train_once(model)
        states.append(state_of(model.policy))
    assert differing(*states) == []


@pytest.mark.parametrize("gae_lambda", ["Auto", "lin_0.9", "", -0.1, 1.5, float("nan"), None])
def test_other_values_are_refused(gae_lambda: Any) -> None:
    with pytest.raises(ValueError, match="`gae_lambda` must be a number in"):
        small_model(vec_env(), gae_lambda=gae_lambda)


def test_a_schedule_that_leaves_the_interval_is_refused() -> None:
    with pytest.raises(ValueError, match="`gae_lambda` must be a number in"):
        small_model(vec_env(), gae_lambda=lambda progress: 2.0 * progress)


def test_what_was_measured_is_saved(tmp_path: Path) -> None:
    model = small_model(vec_env(n_envs=4), n_steps=40, gae_lambda="auto")
    train_once(model)
    model.save(tmp_path / "model")
    loaded = TRPOGAE.load(tmp_path / "model", env=vec_env(n_envs=4))
    rule, expected = loaded._lambda_rule, model._lambda_rule
    assert isinstance(rule, MeasuredLambda)
    assert isinstance(expected, MeasuredLambda)
    np.testing.assert_array_equal(rule._sums, expected._sums)
    assert loaded.gae_lambda == 0.96
    for how in ({"gae_lambda": 0.5}, {"custom_objects": {"gae_lambda": 0.5}}):
        fixed = TRPOGAE.load(tmp_path / "model", env=vec_env(n_envs=4), **how)  # type: ignore[arg-type]
        train_once(fixed)
        assert fixed.gae_lambda == 0.5
