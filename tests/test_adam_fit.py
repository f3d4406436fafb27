"""The value fit by Adam, which is that of sb3-contrib's TRPO."""

from typing import Any

import numpy as np
import pytest
import sb3_contrib
import torch as th
from envs_for_tests import SMALL, state_of, train_once, vec_env

from sb3_gae import TRPOGAE, GAERolloutBuffer


def test_the_adam_fit_is_contribs(monkeypatch: pytest.MonkeyPatch) -> None:
    """From the same rollout the value networks end up the same, if both go through it in the order of time."""
    monkeypatch.setattr(np.random, "permutation", np.arange)
    settings: dict[str, Any] = {"n_steps": 32, "batch_size": 16, "learning_rate": 3e-3, "policy_kwargs": SMALL, "seed": 3}
    ours = TRPOGAE("MlpPolicy", vec_env(n_envs=1), **settings, vf_optimizer="adam", normalize_value=False)
    before = state_of(ours.policy)
    train_once(ours)
    theirs = sb3_contrib.TRPO("MlpPolicy", vec_env(n_envs=1), **settings)
    train_once(theirs)
    moved, expected = ours.policy.state_dict(), theirs.policy.state_dict()
    names = [name for name in expected if "value" in name]
    assert len(names) == 4
    for name in names:
        assert (moved[name] - before[name]).abs().max() > 1e-3
        th.testing.assert_close(moved[name], expected[name], rtol=1e-4, atol=1e-5)


def test_the_adam_fit_reads_its_arguments(monkeypatch: pytest.MonkeyPatch) -> None:
    sizes = []
    get = GAERolloutBuffer.get
    monkeypatch.setattr(GAERolloutBuffer, "get", lambda self, size: (sizes.append(size), get(self, size))[1])
    model = TRPOGAE(
        *("MlpPolicy", vec_env()),
        **dict(learning_rate=lambda remaining: 1e-2 * remaining, n_steps=16, batch_size=8, n_critic_updates=3, seed=0),
        **dict(vf_optimizer="adam", policy_kwargs=SMALL),
    )
    model.learn(4 * 32)
    assert sizes == [8] * 3 * 4
    # The last update of four begins when nothing remains
    assert model.policy.optimizer.param_groups[0]["lr"] == 0.0
    assert len(model.policy.optimizer.state) == 4, "weights and biases of the value network's two layers"


def test_adam_brings_the_loss_down() -> None:
    model = TRPOGAE(
        *("MlpPolicy", vec_env()),
        **dict(n_steps=32, learning_rate=1e-2, batch_size=16, seed=0),
        **dict(vf_optimizer="adam", normalize_value=False, policy_kwargs=SMALL),
    )
    logged = train_once(model)
    samples = model.rollout_buffer.batch()
    assert logged["train/value_loss"] < (samples.old_values - samples.returns).square().mean().item()
    assert logged["train/explained_variance_after"] > logged["train/explained_variance"]
    assert not any(key.startswith("train/vf_") for key in logged)
