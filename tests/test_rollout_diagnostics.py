"""Errors of lambda and delays of rewards from rollouts, beside the exact gridworld; and their callback."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from envs_for_tests import SMALL, AnySpacesEnv
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from tabular_oracles import random_policy

from sb3_gae import TRPOGAE, GAERolloutBuffer, GradientDiagnosticsCallback, MlpPolicy
from sb3_gae.diagnostics.rollout_diagnostics import gradient_response, lambda_errors, policy_gradient_value_error
from sb3_gae.estimators.group_statistics import gradient_errors
from sb3_gae.estimators.measures import value_errors
from sb3_gae.gridworld import (
    Episodes,
    TabularPolicy,
    episode_advantages,
    episode_gradients,
    gridworld,
    lagged_gradients,
    sample_episodes,
)

LAMBDAS = (0.0, 0.9, 1.0)
GAMMA = 0.95


# --- On the gridworld ---


def torch_policy(table: TabularPolicy) -> MlpPolicy:
    """The same policy for SB3: one layer without a bias on one-hot states."""
    policy = MlpPolicy(spaces.Discrete(25), spaces.Discrete(4), lambda _: 1e-3, net_arch=[])
    with th.no_grad():
        policy.action_net.weight.copy_(th.as_tensor(table.logits.T))
        policy.action_net.bias.zero_()
    # What is frozen is no parameter: the gradient is that of the table alone
    policy.action_net.bias.requires_grad = False
    return policy


def buffer_of(episodes: Episodes, values: np.ndarray) -> GAERolloutBuffer:
    """Whole episodes as one rollout, those that end early masked."""
    n_steps, n_envs = episodes.states.shape
    buffer = GAERolloutBuffer(n_steps, spaces.Discrete(25), spaces.Discrete(4), "cpu", 1.0, GAMMA, n_envs)
    starts = np.ones(n_envs, dtype=bool)
    for t in range(n_steps):
        nowhere = np.zeros(n_envs, dtype=bool)
        buffer.add_step(
            episodes.states[t], episodes.actions[t][:, None], episodes.rewards[t], starts, episodes.dones[t], nowhere,
            episodes.mask[t],
        )  # fmt: skip
        starts = episodes.dones[t]
    known = values.copy()
    known[[4, 12]] = 0.0
    nothing = np.zeros((n_steps, n_envs), dtype=np.float32)
    buffer.set_values(known[episodes.states].astype(np.float32), nothing, nothing)
    buffer.compute_returns_and_advantage(th.zeros(n_envs), starts)
    return buffer


def assert_right_on_average(estimates: list[np.ndarray], expected: np.ndarray, slack: float = 0.0) -> None:
    """Mean over batches within its confidence interval; ``slack`` is relative, for what is biased by 1/n."""
    stacked = np.array(estimates)
    limits = 4.0 * stacked.std(axis=0) / np.sqrt(len(stacked)) + slack * np.abs(expected) + 1e-15
    assert (np.abs(stacked.mean(axis=0) - expected) < limits).all(), (stacked.mean(axis=0), expected, limits)


def test_estimates_from_rollouts_are_those_of_the_exact_model_on_average() -> None:
    table, n_batches, n_episodes = random_policy(gridworld(), 7), 60, 60
    values, policy, generator = np.random.default_rng(0).normal(size=25), torch_policy(table), np.random.default_rng(1)
    errors, of_values, responses = [], [], []
    for _ in range(n_batches):
        buffer = buffer_of(sample_episodes(table, n_episodes, generator), values)
        errors.append(lambda_errors(policy, buffer, LAMBDAS))
        of_values.append(policy_gradient_value_error(policy, buffer).value)
        responses.append(gradient_response(policy, buffer, 4))
    # Rollouts are measured by the step, the model by the episode
    truth, steps = table.lambda_curve(values, GAMMA, LAMBDAS), table.mean_length**2
    assert_right_on_average([each.bias_squared for each in errors], truth.bias_squared / steps, slack=0.05)
    norms = [np.square(table.expected_gradient(values, GAMMA, gae_lambda)).sum() for gae_lambda in LAMBDAS]
    assert_right_on_average([each.squared_norm for each in errors], np.array(norms) / steps, slack=0.05)
    assert_right_on_average(of_values, truth.bias_squared[:1] / steps, slack=0.05)
    for name, arguments in (("rewards", ()), ("shaped_rewards", (values, GAMMA))):
        exact = np.square(lagged_gradients(table, 4, *arguments)).sum(axis=(1, 2)) / steps
        assert_right_on_average([getattr(each, name).value for each in responses], exact, slack=0.05)
    assert all(np.isfinite(each.bias_squared_error).all() for each in errors)


def test_variance_is_that_between_rollouts() -> None:
    table, n_batches = random_policy(gridworld(), 7), 150
    values, policy, generator = np.random.default_rng(0).normal(size=25), torch_policy(table), np.random.default_rng(1)
    errors, gradients = [], []
    for _ in range(n_batches):
        buffer = buffer_of(sample_episodes(table, 40, generator), values)
        errors.append(lambda_errors(policy, buffer, [1.0]).variance)
        batch = buffer.batch()
        log_prob = policy.get_distribution(batch.observations).log_prob(batch.actions.long().flatten())
        (gradient,) = th.autograd.grad((batch.advantages * log_prob).mean(), policy.action_net.weight)
        gradients.append(gradient.double().numpy().ravel())
    between = np.square(gradients - np.mean(gradients, axis=0)).sum() / (n_batches - 1)
    np.testing.assert_allclose(np.mean(errors), between, rtol=0.15)


def test_errors_are_those_of_the_mean_over_steps_whatever_the_sizes_of_the_groups() -> None:
    table = random_policy(gridworld(), 7)
    policy, values = torch_policy(table), table.values(GAMMA)
    clipped = False
    for seed in range(10):
        episodes = sample_episodes(table, 5, np.random.default_rng(seed))
        actual = lambda_errors(policy, buffer_of(episodes, values), LAMBDAS, n_groups=3)
        gradients = np.stack(
            [episode_gradients(table, episodes, episode_advantages(table, episodes, values, GAMMA, each)) for each in LAMBDAS],
            axis=1,
        ).reshape(5, len(LAMBDAS), -1)
        sums = np.stack([gradients[group::3].sum(axis=0) for group in range(3)])
        steps = np.array([episodes.mask[:, group::3].sum() for group in range(3)])
        expected = gradient_errors(sums, steps)
        scale = 1e-5 * actual.variance.max()
        np.testing.assert_allclose(actual.bias_squared, expected.bias_squared.value, atol=scale)
        np.testing.assert_allclose(actual.bias_squared_error, expected.bias_squared.standard_error, atol=scale)
        np.testing.assert_allclose(actual.variance, expected.variance.value, atol=scale)
        np.testing.assert_allclose(actual.variance_error, expected.variance.standard_error, atol=scale)
        np.testing.assert_allclose(actual.squared_norm, expected.squared_norm.value, atol=scale)
        # A squared norm is not negative, though its estimate may be
        positive = np.maximum(expected.bias_squared.value, 0.0)
        np.testing.assert_allclose(actual.squared_error, positive + expected.variance.value, atol=scale)
        clipped |= bool((expected.bias_squared.value < -scale).any())
    assert clipped


def test_exact_values_gather_the_response_at_lag_zero_and_have_no_error() -> None:
    table = random_policy(gridworld(), 7)
    policy, values = torch_policy(table), table.values(GAMMA)
    buffer = buffer_of(sample_episodes(table, 2000, np.random.default_rng(0)), values)
    response = gradient_response(policy, buffer, 5)
    first, *later = response.shaped_rewards.value
    assert first > 10.0 * np.abs(later).max()
    assert response.rewards.value[1:].max() > 0.1 * first
    error = policy_gradient_value_error(policy, buffer)
    assert abs(error.value[0]) < 4.0 * error.standard_error[0]


def test_refuses_what_it_cannot_estimate() -> None:
    table = random_policy(gridworld(), 7)
    policy, values = torch_policy(table), np.zeros(25)
    buffer = buffer_of(sample_episodes(table, 8, np.random.default_rng(0)), values)
    with pytest.raises(ValueError, match=r"`lambdas` must be a non-empty list of numbers in \[0, 1\]"):
        lambda_errors(policy, buffer, [1.1])
    with pytest.raises(ValueError, match="`gamma` must be a number"):
        lambda_errors(policy, buffer, [0.5], gamma=-1.0)
    with pytest.raises(ValueError, match="`n_lags` must be a whole number"):
        gradient_response(policy, buffer, 0)
    alone = buffer_of(sample_episodes(table, 1, np.random.default_rng(0)), values)
    with pytest.raises(ValueError, match="at least two trajectories, got 1"):
        lambda_errors(policy, alone, [0.5])
    buffer.reset()
    with pytest.raises(ValueError, match="`rollout_buffer` must be full"):
        gradient_response(policy, buffer, 2)


def test_refuses_lags_that_no_step_of_an_unfinished_rollout_can_be_followed_for() -> None:
    model = TRPOGAE("MlpPolicy", make_vec_env("Pendulum-v1", 4), n_steps=8, policy_kwargs=SMALL, device="cpu").learn(32)
    assert np.isfinite(gradient_response(model.policy, model.rollout_buffer, 8).rewards.value).all()
    with pytest.raises(ValueError, match="`n_lags` must leave steps that can be followed so far in every group, got 9"):
        gradient_response(model.policy, model.rollout_buffer, 9)


# --- In the log ---


class Record(BaseCallback):
    """Keeps what is in the log when a rollout has ended, and what :func:`lambda_errors` makes of that rollout."""

    def __init__(self) -> None:
        super().__init__()
        self.logged: list[dict[str, Any]] = []
        self.errors: list[Any] = []
        self.of_values: list[dict[str, float]] = []

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        policy, buffer = self.model.policy, self.locals["rollout_buffer"]
        kept = ("gradient/", "value_error/")
        self.logged.append({key: value for key, value in self.logger.name_to_value.items() if key.startswith(kept)})
        self.errors.append(lambda_errors(policy, buffer, LAMBDAS, n_groups=4))
        arrays = buffer.rewards, buffer.values, buffer.next_values, buffer.dones
        of_values = value_errors(*arrays, buffer.gamma, buffer.mask)._asdict()
        of_gradient = policy_gradient_value_error(policy, buffer, n_groups=4).value[0]
        self.of_values.append({f"value_error/{name}": value for name, value in of_values.items()})
        self.of_values[-1]["value_error/policy_gradient"] = of_gradient


DICT = spaces.Dict({"a": spaces.Box(-1, 1, (2,)), "b": spaces.Discrete(3)})


@pytest.mark.parametrize(
    ("policy", "env_id", "n_envs", "arguments"),
    [
        ("MlpPolicy", "CartPole-v1", 2, {}),
        ("MultiInputPolicy", lambda: AnySpacesEnv(DICT), 1, {}),
        ("MlpPolicy", "CartPole-v1", 2, dict(n_steps=400, n_episodes=4)),
        ("MlpPolicy", "Pendulum-v1", 4, dict(use_sde=True)),
    ],
    ids=["MLP", "Dict", "whole episodes", "gSDE"],
)
def test_the_log_holds_every_quantity_for_every_lambda(
    policy: str, env_id: Any, n_envs: int, arguments: dict[str, Any]
) -> None:
    arguments = dict(n_steps=64, policy_kwargs=SMALL, seed=0, device="cpu") | arguments
    model = TRPOGAE(policy, make_vec_env(env_id, n_envs, seed=0), **arguments)
    record = Record()
    model.learn(2 * model.n_steps, callback=[GradientDiagnosticsCallback(LAMBDAS, n_groups=4), record])
    assert record.logged
    for logged, expected, of_values in zip(record.logged, record.errors, record.of_values, strict=True):
        for name, value in of_values.items():
            np.testing.assert_allclose(logged[name], value, rtol=1e-5)
        for quantity in set(expected._fields) - {"gae_lambda"}:
            values = [logged[f"gradient/{quantity}/lambda_{gae_lambda:g}"] for gae_lambda in LAMBDAS]
            np.testing.assert_allclose(values, getattr(expected, quantity))
        assert len(logged) == len(of_values) + (len(expected) - 1) * len(LAMBDAS)
        assert expected.bias_squared[-1] == 0.0
        assert (expected.variance > 0.0).all()


def test_estimates_come_every_so_many_rollouts() -> None:
    record = Record()
    model = TRPOGAE("MlpPolicy", "CartPole-v1", n_steps=64, policy_kwargs=SMALL, seed=0, device="cpu")
    model.learn(4 * 64, callback=[GradientDiagnosticsCallback(LAMBDAS, every=3), record], log_interval=1)
    assert [bool(logged) for logged in record.logged] == [True, False, False, True]


def test_training_is_the_same_with_and_without() -> None:
    def train(callback: Any) -> dict[str, th.Tensor]:
        model = TRPOGAE("MlpPolicy", "CartPole-v1", n_steps=64, policy_kwargs=SMALL, seed=0, device="cpu")
        return model.learn(128, callback=callback).policy.state_dict()

    with_it, without = train(GradientDiagnosticsCallback(LAMBDAS)), train(None)
    assert all(th.equal(with_it[name], value) for name, value in without.items())


@pytest.mark.parametrize("training", [True, False])
def test_the_policy_is_left_in_the_mode_that_it_was_in(training: bool) -> None:
    callback = GradientDiagnosticsCallback(LAMBDAS)
    model = TRPOGAE("MlpPolicy", "CartPole-v1", n_steps=64, policy_kwargs=SMALL, seed=0, device="cpu").learn(64, callback)
    model.policy.set_training_mode(training)
    callback.on_rollout_end()
    assert model.policy.training == training


def test_errors_of_values_are_those_at_the_gamma_asked_for_with_or_without_lambda_zero() -> None:
    callback = GradientDiagnosticsCallback([0.9], gamma=0.5, n_groups=4)
    model = TRPOGAE("MlpPolicy", "CartPole-v1", n_steps=64, policy_kwargs=SMALL, seed=0, device="cpu")
    # What is asked for at the end of the last rollout, before its update
    seen: list[Any] = []

    class Keep(BaseCallback):
        def _on_step(self) -> bool:
            return True

        def _on_rollout_end(self) -> None:
            buffer = self.locals["rollout_buffer"]
            arrays = buffer.rewards, buffer.values, buffer.next_values, buffer.dones
            seen.append((value_errors(*arrays, 0.5, buffer.mask), self.logger.name_to_value["value_error/policy_gradient"]))
            seen.append(policy_gradient_value_error(self.model.policy, buffer, 0.5, 4).value[0])

    model.learn(64, callback=[callback, Keep()])
    (expected, logged), of_gradient = seen
    assert callback.value_errors == expected
    assert logged == pytest.approx(of_gradient, rel=1e-5)
    assert callback.errors is not None and callback.errors.bias_squared.shape == (1,)


def test_a_rollout_of_a_single_trajectory_is_left_out() -> None:
    callback = GradientDiagnosticsCallback(LAMBDAS)
    TRPOGAE("MlpPolicy", "Pendulum-v1", n_steps=32, policy_kwargs=SMALL, device="cpu").learn(32, callback)
    assert callback.errors is None


def test_works_with_another_algorithm_on_our_buffer() -> None:
    callback = GradientDiagnosticsCallback(LAMBDAS)
    env = gym.make("CartPole-v1")
    PPO("MlpPolicy", env, n_steps=64, rollout_buffer_class=GAERolloutBuffer, device="cpu").learn(64, callback)
    assert callback.errors is not None


def test_says_what_it_needs() -> None:
    with pytest.raises(TypeError, match=r"GradientDiagnosticsCallback needs a sb3_gae.GAERolloutBuffer, got RolloutBuffer"):
        PPO("MlpPolicy", gym.make("CartPole-v1"), n_steps=64, device="cpu").learn(64, GradientDiagnosticsCallback())
    with pytest.raises(ValueError, match="`every` must be a whole number of at least 1, got 0"):
        GradientDiagnosticsCallback(every=0)
    with pytest.raises(ValueError, match="`n_groups` must be a whole number of at least 2, got 1"):
        GradientDiagnosticsCallback(n_groups=1)
