"""Threads of torch while a rollout is collected, and actions that are drawn without a distribution."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import torch as th
from envs_for_tests import CHANNEL_FIRST, AnySpacesEnv, small_model, vec_env
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback
from torch import nn

from sb3_gae.errors import NumericalError
from sb3_gae.rollout.collection import ActionSampler


@pytest.fixture(autouse=True)
def two_threads() -> Iterator[None]:
    before = th.get_num_threads()
    th.set_num_threads(2)
    yield
    th.set_num_threads(before)


class Threads(BaseCallback):
    def __init__(self, fail_at: int = -1):
        super().__init__()
        self.fail_at = fail_at
        self.at_steps: set[int] = set()
        self.at_end = 0

    def _on_step(self) -> bool:
        self.at_steps.add(th.get_num_threads())
        if self.n_calls == self.fail_at:
            raise RuntimeError("asked for")
        return True

    def _on_rollout_end(self) -> None:
        self.at_end = th.get_num_threads()


def test_small_policies_take_steps_with_one_thread() -> None:
    threads = Threads()
    small_model(vec_env()).learn(64, callback=threads)
    assert threads.at_steps == {1}
    assert threads.at_end == th.get_num_threads() == 2


@pytest.mark.parametrize(
    ("make", "policy_kwargs"),
    [
        (lambda: AnySpacesEnv(CHANNEL_FIRST), {"features_extractor_kwargs": {"features_dim": 8}}),
        (AnySpacesEnv, {"net_arch": [8000, 8000]}),
    ],
    ids=["images", "large"],
)
def test_large_ones_keep_theirs(make: Any, policy_kwargs: dict[str, Any]) -> None:
    threads = Threads(fail_at=1)
    model = small_model(vec_env(make, n_envs=4), policy_kwargs=policy_kwargs)
    with pytest.raises(RuntimeError, match="asked for"):
        model.learn(16, callback=threads)
    assert threads.at_steps == {2}


def test_threads_are_given_back_whatever_happens() -> None:
    with pytest.raises(RuntimeError, match="asked for"):
        small_model(vec_env()).learn(64, callback=Threads(fail_at=3))
    assert th.get_num_threads() == 2


# Actions

SMOOTH = spaces.Box(-np.inf, np.inf, (3,), np.float64)


@pytest.mark.parametrize("observation_space", [spaces.Box(-1.0, 1.0, (3,), np.float32), SMOOTH])
@pytest.mark.parametrize(
    ("net_arch", "activation", "n_rows"),
    [
        ([], nn.Tanh, 5),
        ([8], nn.Tanh, 5),
        ([8, 8], nn.Tanh, 5),
        ([8, 8], nn.ReLU, 5),
        ([8], nn.PReLU, 5),
        ([64, 64], nn.Tanh, 65),
    ],
)
def test_a_gaussian_mlp_draws_the_policy_s_actions(
    observation_space: spaces.Box, net_arch: list[int], activation: type[nn.Module], n_rows: int
) -> None:
    architecture = {"net_arch": net_arch, "activation_fn": activation}
    model = small_model(vec_env(lambda: AnySpacesEnv(observation_space)), policy_kwargs=architecture)
    policy = model.policy
    with th.no_grad():
        # Biases begin at 0, and one that is forgotten would not show
        for parameter in policy.parameters():
            parameter.add_(0.1 * th.randn_like(parameter))
        policy.log_std.copy_(th.tensor([-0.7, 0.3]))
    sample = ActionSampler(policy)
    assert sample._mean is not None
    observations = np.random.default_rng(0).normal(size=(n_rows, 3)).astype(observation_space.dtype)
    before = observations.copy()
    th.manual_seed(0)
    found = sample(observations, 0)
    th.manual_seed(0)
    expected = policy._predict(th.as_tensor(observations)).detach().numpy()
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-6)
    np.testing.assert_array_equal(observations, before)
    # So small are the products that NumPy makes; those of 65 rows with 64 x 64 weights are torch's
    assert (sample._mean._most_rows >= n_rows) == (n_rows < 65)


@pytest.mark.parametrize("kwargs", [{"use_sde": True}, {"policy_kwargs": {"net_arch": [8], "squash_output": False}}])
def test_others_are_asked_themselves(kwargs: dict[str, Any]) -> None:
    policy = small_model(vec_env(), **kwargs).policy
    if not kwargs.get("use_sde"):
        policy.action_net.register_forward_hook(lambda module, inputs, output: output + 1.0)
    assert ActionSampler(policy)._mean is None


class DoubledLinear(nn.Linear):
    """Does more than its class says."""

    def forward(self, inputs: th.Tensor) -> th.Tensor:
        return 2.0 * super().forward(inputs)


def test_layers_of_one_s_own_are_asked_themselves() -> None:
    policy = small_model(vec_env()).policy
    layer = policy.action_net
    policy.action_net = DoubledLinear(layer.in_features, layer.out_features)
    assert ActionSampler(policy)._mean is None


def test_parameters_that_are_no_numbers_are_found() -> None:
    policy = small_model(vec_env()).policy
    with th.no_grad():
        policy.log_std[0] = float("nan")
    with pytest.raises(NumericalError, match="step 7"):
        ActionSampler(policy)(np.zeros((2, 3), dtype=np.float32), 7)
