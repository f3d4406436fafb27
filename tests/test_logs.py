"""What is logged is what was done, and it reaches those who asked for it."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sb3_contrib
import torch as th
from envs_for_tests import SMALL, AnySpacesEnv, Endless, KLProbe, short_model, train_once
from gymnasium.wrappers import TimeLimit
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.utils import explained_variance
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from sb3_gae import TRPOGAE
from sb3_gae.rollout.collection import reported_episodes

# Outputs


def test_scalars_reach_tensorboard(tmp_path: Path) -> None:
    model = short_model(Monitor(AnySpacesEnv()), tensorboard_log=str(tmp_path))
    model.learn(3 * 8)
    model.learn(8, reset_num_timesteps=False)
    runs = list(tmp_path.iterdir())
    assert [run.name for run in runs] == ["TRPOGAE_1"]
    accumulator = EventAccumulator(str(runs[0]))
    accumulator.Reload()
    scalars = {tag: [event.step for event in accumulator.Scalars(tag)] for tag in accumulator.Tags()["scalars"]}
    assert {"rollout/ep_rew_mean", "rollout/ep_len_mean", "time/fps"} <= scalars.keys()
    for key in ("kl_divergence_loss", "explained_variance", "value_loss", "vf_kl_divergence", "value_scale", "learning_rate"):
        # As in SB3, a dump shows the update before
        assert scalars[f"train/{key}"] == [16, 24], key
    assert "train/n_updates" not in scalars


def test_a_second_run_has_a_directory_of_its_own(tmp_path: Path) -> None:
    model = short_model(tensorboard_log=str(tmp_path))
    model.learn(16, tb_log_name="mine")
    model.learn(16, tb_log_name="mine")
    assert sorted(run.name for run in tmp_path.iterdir()) == ["mine_1", "mine_2"]


def test_a_logger_of_the_users_is_used(tmp_path: Path) -> None:
    model = short_model(Monitor(AnySpacesEnv()))
    model.set_logger(configure(str(tmp_path), ["csv"]))
    model.learn(24)
    header, *rows = (tmp_path / "progress.csv").read_text().splitlines()
    assert {"train/kl_divergence_loss", "train/vf_steps", "rollout/ep_rew_mean", "time/total_timesteps"} <= set(
        header.split(",")
    )
    assert len(rows) == 3


def test_episodes_whose_end_a_wrapper_hides_are_in_the_mean_as_with_sb3() -> None:
    found = []
    for kind, kwargs in ((TRPOGAE, {}), (PPO, {"batch_size": 48})):
        env = make_vec_env(AnySpacesEnv, 3, wrapper_class=Endless)
        model = kind("MlpPolicy", env, n_steps=16, seed=0, **kwargs).learn(48)
        found.append([info["l"] for info in model.ep_info_buffer])
    assert found == [[5] * 9] * 2


@pytest.mark.parametrize("kind", [list, tuple])
def test_ends_are_looked_for_in_the_infos_of_every_vec_env_of_sb3(kind: type) -> None:
    """`SubprocVecEnv` has tuples."""
    infos = kind([{}, {"episode": {}}, {}])
    assert reported_episodes(np.array([False, False, True]), infos).tolist() == [1, 2]


def test_verbose_models_print_a_table_and_others_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    short_model(verbose=0).learn(32)
    assert capsys.readouterr().out == ""
    short_model(verbose=1).learn(32)
    assert "kl_divergence_loss" in capsys.readouterr().out


@pytest.mark.parametrize(("log_interval", "dumps"), [(1, 4), (2, 2), (None, 0)])
def test_logs_are_dumped_as_often_as_asked(log_interval: int | None, dumps: int, tmp_path: Path) -> None:
    model = short_model(Monitor(AnySpacesEnv()))
    model.set_logger(configure(str(tmp_path), ["csv"]))
    model.learn(4 * 8, log_interval=log_interval)  # type: ignore[arg-type]
    assert len((tmp_path / "progress.csv").read_text().splitlines()[1:]) == dumps


@pytest.mark.filterwarnings("ignore:rich is experimental")
def test_the_progress_bar_reaches_its_end(capsys: pytest.CaptureFixture[str]) -> None:
    short_model().learn(32, progress_bar=True)
    assert "32/32" in "".join(capsys.readouterr())


# What was done


class SeenKeys(BaseCallback):
    """Everything that is dumped."""

    def __init__(self) -> None:
        super().__init__()
        self.keys: set[str] = set()

    def _on_step(self) -> bool:
        self.keys |= self.model.logger.name_to_value.keys()
        return True


@pytest.mark.parametrize("vf_optimizer", ["trust_region", "adam"])
def test_every_key_that_contrib_logs_is_logged(vf_optimizer: str) -> None:
    def keys(model: Any) -> set[str]:
        seen = SeenKeys()
        model.learn(3 * 16, callback=seen, log_interval=100)
        return seen.keys | model.logger.name_to_value.keys()

    env = lambda: TimeLimit(AnySpacesEnv(), 4)  # noqa: E731
    theirs = keys(sb3_contrib.TRPO("MlpPolicy", env(), n_steps=16, batch_size=16, policy_kwargs=SMALL, seed=0))
    ours = keys(TRPOGAE("MlpPolicy", env(), n_steps=16, vf_optimizer=vf_optimizer, policy_kwargs=SMALL, seed=0))
    assert {"train/kl_divergence_loss", "train/is_line_search_success", "train/std", "train/learning_rate"} <= theirs
    assert theirs <= ours


def test_what_is_logged_is_what_was_done() -> None:
    model = short_model(n_steps=32, normalize_advantage=False)
    for update in range(1, 4):
        probe = KLProbe()
        logged = train_once(model, probe)
        buffer, samples = model.rollout_buffer, model.rollout_buffer.batch()
        with th.no_grad():
            values = model.policy.predict_values(samples.observations).flatten()
            log_probs = model.policy.get_distribution(samples.observations).log_prob(samples.actions)
        surrogate = (samples.advantages * th.exp(log_probs - samples.old_log_prob)).mean().item()
        expected = {
            "kl_divergence_loss": probe.kl(),
            "policy_objective": surrogate,
            "value_loss": (values - samples.returns).square().mean().item(),
            "explained_variance": explained_variance(buffer.values.flatten(), buffer.returns.flatten()),
            "explained_variance_after": explained_variance(values.numpy(), buffer.returns.flatten()),
            "std": model.policy.log_std.exp().mean().item(),
            "n_updates": update,
            "value_scale": model.policy.value_net.scale.item(),
        }
        assert {key: logged[f"train/{key}"] for key in expected} == pytest.approx(expected, rel=1e-3, abs=1e-6)
        assert surrogate > samples.advantages.mean().item()
        assert logged["train/explained_variance_after"] > logged["train/explained_variance"]


@pytest.mark.parametrize(("vf_steps", "radius"), [(1, 0.2), (3, 0.2), (3, 1e-3)])
def test_value_steps_and_their_divergences_are_logged(vf_steps: int, radius: float) -> None:
    logged = train_once(short_model(vf_steps=vf_steps, vf_trust_region=radius))
    assert 1 <= logged["train/vf_steps"] <= vf_steps
    assert 0.0 < logged["train/vf_kl_divergence"] <= radius
    assert 1 <= logged["train/vf_cg_steps"] <= vf_steps * 10
    assert 1 <= logged["train/cg_steps"] <= 10
    assert 1 <= logged["train/line_search_trials"] <= 10


def test_one_value_step_goes_as_far_as_is_logged() -> None:
    r"""The constraint of the paper: mean squared change of the values over 2 sigma^2, sigma^2 the error before."""
    logged = train_once(model := short_model(vf_steps=1, vf_trust_region=0.01, vf_cg_damping=0.01))
    samples = model.rollout_buffer.batch()
    with th.no_grad():
        change = model.policy.predict_values(samples.observations).flatten() - samples.old_values
    variance = (samples.old_values - samples.returns).square().mean()
    divergence = (change.square().mean() / (2.0 * variance)).item()
    assert logged["train/vf_kl_divergence"] == pytest.approx(divergence, rel=1e-3)
    assert 0.25 * 0.01 < divergence <= 0.01
