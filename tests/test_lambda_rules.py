"""A λ that is no fixed number: schedules, and rules that learn from the last batches."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch as th
from envs_for_tests import differing, short_model, small_model, state_of, train_once, vec_env
from stable_baselines3.common.callbacks import BaseCallback

import sb3_gae.lambda_rules
from sb3_gae import TRPOGAE
from sb3_gae.diagnostics.rollout_diagnostics import LambdaErrors, lambda_errors
from sb3_gae.estimators.advantages import discounted_returns
from sb3_gae.gridworld import TabularPolicy, gridworld
from sb3_gae.lambda_rules import ExplainedVarianceLambda, MeasuredLambda, ScheduledLambda

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


class Batch(NamedTuple):
    """What one batch shows, for each λ of :data:`GRID`."""

    bias_squared: np.ndarray
    variance: np.ndarray
    squared_norm: np.ndarray = np.ones(len(GRID))
    inner_product: np.ndarray = np.ones(len(GRID))

    def times(self, factor: float) -> "Batch":
        return Batch(*(factor * part for part in self))


def feed(rule: MeasuredLambda, monkeypatch: pytest.MonkeyPatch, batches: Sequence[Batch]) -> list[float]:
    """Let it see these batches, and return where it was before each and at the end."""
    places = [rule.value(1.0)]
    monkeypatch.setattr("sb3_gae.lambda_rules.has_several_trajectories", lambda buffer: True)
    monkeypatch.setattr(MeasuredLambda, "_metric_for", lambda *args: "euclidean")
    nothing = np.zeros(len(GRID))
    for bias, variance, norm, product in batches:
        errors = LambdaErrors(np.array(GRID), bias, nothing, variance, nothing, nothing, norm, product)
        monkeypatch.setattr("sb3_gae.lambda_rules.lambda_errors", lambda *args, errors=errors, **options: errors)
        rule.learn_from(None, None)  # type: ignore[arg-type]
        places.append(rule.value(1.0))
    return places


def exact_batch(scale_of_errors: float) -> Batch:
    """The truth on the gridworld for batches of 40 episodes, with values that are wrong by so much."""
    mdp = gridworld()
    policy = TabularPolicy(mdp, np.random.default_rng(0).normal(size=mdp.rewards.shape[:2]) * 0.5)
    values = policy.values(0.95)
    wrong = values + scale_of_errors * np.random.default_rng(1).normal(size=values.shape) * ~mdp.terminal
    curve = policy.lambda_curve(wrong, 0.95, GRID)
    gradients = np.stack([policy.expected_gradient(wrong, 0.95, gae_lambda).ravel() for gae_lambda in GRID])
    norms = np.square(gradients).sum(axis=1)
    return Batch(curve.bias_squared, curve.variance / 40.0, norms, gradients @ policy.true_gradient(0.95).ravel())


def merits(batch: Batch) -> dict[str, np.ndarray]:
    """What each criterion makes of it, the more the better."""
    return {
        "squared_error": -(batch.bias_squared + batch.variance),
        "improvement": batch.inner_product / np.sqrt(batch.squared_norm + batch.variance),
    }


@pytest.mark.parametrize("criterion", ["squared_error", "improvement"])
@pytest.mark.parametrize("scale_of_errors", [0.0, 0.3, 3.0, 30.0])
def test_it_finds_the_best_lambda_of_the_exact_gridworld(
    scale_of_errors: float, criterion: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From the truth under noise of its own size, unbiased as the estimates are."""
    truth, rng = exact_batch(scale_of_errors), np.random.default_rng(2)
    batches = []
    for _ in range(80):
        noise = rng.normal(size=(3, len(GRID)))
        bias = truth.bias_squared + noise[0] * (truth.bias_squared + 0.1 * truth.variance)
        norm, product = truth.squared_norm * (1.0 + noise[1]), truth.inner_product * (1.0 + noise[2])
        batches.append(Batch(bias, truth.variance * rng.uniform(0.7, 1.3, len(GRID)), norm, product))
    rule = MeasuredLambda(GRID, criterion=criterion)
    feed(rule, monkeypatch, batches)
    merit = merits(truth)[criterion]
    assert abs(merit[rule.place] - merit.max()) <= 0.25 * abs(merit.max())


@pytest.mark.parametrize("criterion", ["squared_error", "improvement"])
def test_the_best_lambda_depends_on_the_value_function(criterion: str) -> None:
    """So that the test above asks for different answers."""
    chosen = [GRID[int(np.argmax(merits(exact_batch(scale))[criterion]))] for scale in (0.0, 0.3, 30.0)]
    assert chosen[0] < chosen[1] < chosen[2]


def test_improvement_does_not_mind_a_gradient_that_is_only_short(monkeypatch: pytest.MonkeyPatch) -> None:
    """A tenth of the true gradient, with a tenth of the deviation, points as well: here a little better than the whole."""
    length = np.array([0.1, 0.3, 0.5, 0.7, 0.9, 1.0])
    batch = Batch((1.0 - length) ** 2, np.square(length) * np.arange(0.90, 1.01, 0.02), np.square(length), length)
    chosen = {name: feed(MeasuredLambda(GRID, criterion=name), monkeypatch, [batch] * 20)[-1] for name in merits(batch)}
    assert chosen == {"squared_error": 0.8, "improvement": 0.0}


def test_where_nothing_is_to_be_gained_it_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    hopeless = Batch(np.zeros(6), np.ones(6), np.zeros(6), -np.arange(1.0, 7.0))
    assert feed(MeasuredLambda(GRID, criterion="improvement"), monkeypatch, [hopeless] * 20)[-1] == 0.96


def test_it_waits_and_then_moves_by_one_place_at_most(monkeypatch: pytest.MonkeyPatch) -> None:
    variance_alone = Batch(np.zeros(6), np.arange(1.0, 7.0))
    for criterion in ("squared_error", "improvement"):
        places = feed(MeasuredLambda(GRID, patience=3, criterion=criterion), monkeypatch, [variance_alone] * 8)
        assert places == [0.96, 0.96, 0.96, 0.9, 0.8, 0.5, 0.0, 0.0, 0.0]


@pytest.mark.parametrize("criterion", ["squared_error", "improvement"])
def test_batches_count_in_units_of_their_own_variance(criterion: str, monkeypatch: pytest.MonkeyPatch) -> None:
    bias, length = np.array([9.0, 3, 1, 0.1, 0, 0]), np.array([0.1, 0.2, 0.5, 0.99, 1.0, 1.0])
    batch = Batch(bias, np.arange(1.0, 7.0), np.square(length), length)
    last = Batch(1e20 * np.zeros(6), 1e20 * np.arange(6.0, 0.0, -1.0), np.zeros(6), 1e20 * length)

    def chosen(batches: list[Batch]) -> float:
        return feed(MeasuredLambda(GRID, criterion=criterion), monkeypatch, batches)[-1]

    assert {chosen([batch.times(scale)] * 5) for scale in (1e-12, 1.0, 1e12)} == {0.9}
    # A batch on a scale of its own does not outvote the others
    assert chosen([*[batch] * 5, last, *[batch] * 5]) == 0.9


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_estimates_that_are_no_numbers_change_nothing(bad: float, monkeypatch: pytest.MonkeyPatch) -> None:
    rule = MeasuredLambda(GRID, patience=1)
    ones = np.ones(6)
    feed(rule, monkeypatch, [Batch(bad * ones, ones), Batch(ones, ones, ones, bad * ones), Batch(0 * ones, 0 * ones)])
    assert rule.value(1.0) == 0.96
    assert rule._n_batches == 0


def test_linear_algebra_that_breaks_down_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*args: Any, **kwargs: Any) -> Any:
        raise th.linalg.LinAlgError("no convergence")

    model = short_model(vec_env(), gae_lambda=MeasuredLambda(patience=0), n_steps=16)
    monkeypatch.setattr(sb3_gae.lambda_rules, "lambda_errors", broken)
    train_once(model)
    assert model.gae_lambda == 0.96


@pytest.mark.parametrize(
    ("rule", "arguments"),
    [
        (ExplainedVarianceLambda, {"lowest": -0.5}),
        (ExplainedVarianceLambda, {"memory": 1.0}),
        (MeasuredLambda, {"memory": 1.5}),
        (MeasuredLambda, {"start": 2.0}),
        (MeasuredLambda, {"patience": 0.5}),
    ],
)
def test_numbers_out_of_range_are_refused(rule: Any, arguments: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=f"`{next(iter(arguments))}` must be"):
        rule(**arguments)


class Wandering(ScheduledLambda):
    """Right at first, and wrong later."""

    def __init__(self) -> None:
        super().__init__(lambda remaining: 1.0)
        self.n_asked = 0

    def value(self, progress_remaining: float) -> float:
        self.n_asked += 1
        return 0.9 if self.n_asked == 1 else 1.5


def test_a_rule_of_ones_own_that_leaves_the_interval_is_refused() -> None:
    model = short_model(vec_env(), gae_lambda=Wandering())
    with pytest.raises(ValueError, match=r"`gae_lambda` must be a number in \[0, 1\], got 1.5"):
        train_once(model)


@pytest.mark.parametrize("argument", ["criterion", "metric"])
def test_names_that_are_unknown_are_refused(argument: str) -> None:
    with pytest.raises(ValueError, match=f"`{argument}` must be one of"):
        MeasuredLambda(**{argument: "best"})  # type: ignore[arg-type]


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


def test_a_batch_of_nearly_equal_returns_does_not_count_for_many() -> None:
    rule = ExplainedVarianceLambda(lowest=0.9, memory=0.5)
    model = small_model(vec_env(n_envs=4), n_steps=40)
    train_once(model)
    buffer, rng = model.rollout_buffer, np.random.default_rng(0)
    buffer.rewards = 1e-5 * rng.normal(size=buffer.rewards.shape)
    buffer.values = rng.normal(size=buffer.values.shape)
    buffer.last_values[:], buffer.bootstrap_values[:] = 0.0, 0.0
    assert rule.learn_from(model.policy, buffer) == {"explained_variance": -0.5}


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


def test_a_rule_of_ones_own_is_copied_for_each_model() -> None:
    rule = MeasuredLambda(GRID, start=0.5, patience=1)
    models = [small_model(vec_env(n_envs=4), n_steps=40, gae_lambda=rule) for _ in range(2)]
    assert [model.gae_lambda for model in models] == [0.5, 0.5]
    train_once(models[0])
    assert models[0]._lambda_rule._n_batches == 1  # type: ignore[union-attr]
    assert models[1]._lambda_rule._n_batches == rule._n_batches == 0  # type: ignore[union-attr]


@pytest.mark.parametrize(("name", "criterion"), [("auto", "squared_error"), ("improvement", "improvement")])
def test_names_of_rules(name: str, criterion: str) -> None:
    rule = small_model(vec_env(), gae_lambda=name)._lambda_rule
    assert isinstance(rule, MeasuredLambda) and rule.criterion == criterion


def test_networks_of_other_kinds_are_measured_in_the_euclidean_metric(monkeypatch: pytest.MonkeyPatch) -> None:
    metrics = []

    def recorded(*args: Any, metric: str, **options: Any) -> LambdaErrors:
        metrics.append(metric)
        return lambda_errors(*args, metric=metric, **options)

    monkeypatch.setattr("sb3_gae.lambda_rules.lambda_errors", recorded)
    for options in ({}, {"use_sde": True}):
        train_once(small_model(vec_env(n_envs=4), n_steps=40, gae_lambda="improvement", **options))
    assert metrics == ["fisher", "euclidean"]


@pytest.mark.parametrize(
    ("gae_lambda", "value_lambda", "expected"),
    [
        (MeasuredLambda(start=0.68), None, 0.68),
        (MeasuredLambda(start=0.99), None, 0.96),
        (MeasuredLambda(start=0.68, largest_target_lambda=0.5), None, 0.5),
        (MeasuredLambda(start=0.99, largest_target_lambda=1.0), None, 0.99),
        (MeasuredLambda(start=0.68), 0.3, 0.3),
        (lambda progress: 0.68, None, 0.68),
        ("explained_variance", None, 1.0),
    ],
)
def test_value_targets_have_a_lambda_of_their_own(gae_lambda: Any, value_lambda: float | None, expected: float) -> None:
    model = small_model(vec_env(n_envs=4), n_steps=40, gae_lambda=gae_lambda, value_lambda=value_lambda)
    train_once(model)
    fixed = small_model(vec_env(n_envs=4), n_steps=40, gae_lambda=model.gae_lambda, value_lambda=expected)
    train_once(fixed)
    np.testing.assert_array_equal(model.rollout_buffer.advantages, fixed.rollout_buffer.advantages)
    np.testing.assert_array_equal(model.rollout_buffer.returns, fixed.rollout_buffer.returns)


def test_a_target_lambda_is_checked() -> None:
    with pytest.raises(ValueError, match="`largest_target_lambda` must be a number in"):
        MeasuredLambda(largest_target_lambda=1.1)


def test_a_schedule_is_followed() -> None:
    model = small_model(vec_env(), gae_lambda=lambda progress: 0.5 + 0.5 * progress)
    log = RolloutLog()
    model.learn(4 * 32, callback=log)
    values = [entry["gae_lambda/value"] for entry in log.entries]
    assert values == [1.0, 0.875, 0.75, 0.625]


def test_a_schedule_begins_anew_with_each_call_of_learn() -> None:
    model, seen = small_model(vec_env(), gae_lambda=lambda progress: progress), []
    for n_steps, keep_counting in ((40, False), (2 * 32, False), (2 * 32, True)):
        log = RolloutLog()
        model.learn(n_steps, callback=log, reset_num_timesteps=not keep_counting)
        seen.append([entry["gae_lambda/value"] for entry in log.entries])
    # The first overshoots by 24 of its 40 steps
    assert seen == [[1.0, pytest.approx(0.2)], [1.0, 0.5], [0.5, 0.25]]


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


@pytest.mark.parametrize("value", [2.0, -0.1, None, "0.9"])
def test_a_schedule_that_leaves_the_interval_is_refused(value: Any) -> None:
    with pytest.raises(ValueError, match=f"`gae_lambda` must be a number in .*, got {value!r}"):
        small_model(vec_env(), gae_lambda=lambda progress: value)


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
    replaced = {"gae_lambda": 0.5}
    for fixed in (
        TRPOGAE.load(tmp_path / "model", env=vec_env(n_envs=4), **replaced),  # type: ignore[arg-type]
        TRPOGAE.load(tmp_path / "model", env=vec_env(n_envs=4), custom_objects=replaced),
        TRPOGAE.load(tmp_path / "model", vec_env(n_envs=4), "cpu", replaced),
    ):
        train_once(fixed)
        assert fixed.gae_lambda == 0.5
