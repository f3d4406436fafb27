"""Callbacks are called as by SB3's PPO, and what is logged is what was done."""

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from envs_for_tests import SMALL, AnySpacesEnv, KLProbe, differing, state_of, train_once, vec_env
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import (
    BaseCallback,
    CallbackList,
    CheckpointCallback,
    EvalCallback,
    EveryNTimesteps,
    StopTrainingOnMaxEpisodes,
    StopTrainingOnRewardThreshold,
)
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.logger import configure
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.utils import explained_variance
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

import sb3_gae.update.policy_step
import sb3_gae.update.value_step
from sb3_gae import TRPOGAE


def small_model(env: Any = None, policy: Any = "MlpPolicy", **kwargs: Any) -> TRPOGAE:
    return TRPOGAE(policy, env or vec_env(), **({"n_steps": 8, "policy_kwargs": SMALL, "seed": 0} | kwargs))


def small_ppo(env: Any = None) -> PPO:
    return PPO("MlpPolicy", env or vec_env(), n_steps=8, batch_size=16, n_epochs=1, policy_kwargs=SMALL, seed=0)


# Callbacks


class Recorder(BaseCallback):
    """Every call, with the counters that a callback can see then."""

    def __init__(self, stop_at: float = math.inf):
        super().__init__()
        self.stop_at = stop_at
        self.events: list[tuple[str, int, int]] = []

    def note(self, event: str) -> None:
        self.events.append((event, self.n_calls, self.model.num_timesteps))

    def _on_training_start(self) -> None:
        self.note("training start")

    def _on_rollout_start(self) -> None:
        self.note("rollout start")

    def _on_step(self) -> bool:
        self.note("step")
        return self.model.num_timesteps < self.stop_at

    def _on_rollout_end(self) -> None:
        self.note("rollout end")

    def _on_training_end(self) -> None:
        self.note("training end")


@pytest.mark.parametrize("stop_at", [math.inf, 16, 22])
@pytest.mark.parametrize("total", [1, 16, 40])
def test_callbacks_are_called_as_by_ppo(total: int, stop_at: float) -> None:
    def events(model: OnPolicyAlgorithm) -> list[tuple[str, int, int]]:
        recorder = Recorder(stop_at)
        model.learn(total, callback=recorder)
        return recorder.events

    ours = events(small_model())
    assert ours == events(small_ppo())
    assert ours[0][0] == "training start" and ours[-1][0] == "training end"
    assert sum(event == "rollout end" for event, *_ in ours) == (min(total + 15, stop_at - 1)) // 16


def test_a_callback_that_stops_leaves_the_policy_as_it_is() -> None:
    model = small_model()
    before = state_of(model.policy)
    model.learn(1000, callback=lambda locals_, globals_: model.num_timesteps < 6)
    assert model.num_timesteps == 6
    assert differing(before, state_of(model.policy)) == []


def test_learning_goes_on_after_a_stop() -> None:
    model = small_model()
    model.learn(1000, callback=Recorder(stop_at=22))
    assert train_once(model)["train/n_updates"] == 2
    assert model.num_timesteps == 22 + 16


class LocalsAtStep(BaseCallback):
    """What a callback finds in ``self.locals``."""

    def _on_step(self) -> bool:
        self.at_step = dict(self.locals)
        return True

    def _on_rollout_end(self) -> None:
        self.at_end = dict(self.locals)


def test_callbacks_find_what_ppo_shows_them_but_for_values_that_are_computed_later() -> None:
    ours, theirs = LocalsAtStep(), LocalsAtStep()
    model = small_model()
    model.learn(16, callback=ours)
    small_ppo().learn(16, callback=theirs)
    # Values and log-probabilities of the whole rollout are computed at once at its end
    assert theirs.at_step.keys() - ours.at_step.keys() <= {"obs_tensor", "values", "log_probs", "idx", "done", "terminal_obs"}
    for name in ("new_obs", "rewards", "dones", "actions", "clipped_actions"):
        mine, expected = ours.at_step[name], theirs.at_step[name]
        assert (mine.shape, mine.dtype) == (expected.shape, expected.dtype), name
    assert ours.at_step["n_rollout_steps"] == theirs.at_step["n_rollout_steps"] == 8
    assert len(ours.at_step["infos"]) == 2
    assert ours.at_step["self"] is model
    assert ours.at_step["rollout_buffer"] is model.rollout_buffer
    assert ours.at_step["env"] is model.get_env()
    assert ours.at_step["callback"] is ours
    assert ours.at_step["n_steps"] == 7 and ours.at_end["n_steps"] == 8, "steps that are over, as PPO counts them"
    assert (theirs.at_step["n_steps"], theirs.at_end["n_steps"]) == (7, 8)


@pytest.mark.parametrize("shape", [(2,), (2, 2)])
def test_actions_that_callbacks_see_have_the_shape_that_ppo_shows(shape: tuple[int, ...]) -> None:
    def seen(make_model: Any) -> tuple[int, ...]:
        callback = LocalsAtStep()
        env = vec_env(lambda: AnySpacesEnv(action_space=spaces.Box(-1.0, 1.0, shape, np.float32)))
        make_model(env).learn(16, callback=callback)
        return callback.at_step["actions"].shape

    assert seen(small_model) == seen(small_ppo)


def test_a_full_buffer_awaits_the_end_of_a_rollout() -> None:
    full = []

    class Look(BaseCallback):
        def _on_step(self) -> bool:
            return True

        def _on_rollout_end(self) -> None:
            buffer = self.locals["rollout_buffer"]
            full.append(buffer.full and np.isfinite(buffer.advantages).all() and (buffer.advantages != 0).all())

    small_model().learn(32, callback=Look())
    assert full == [True, True]


def test_eval_callback_saves_the_best_model(tmp_path: Path) -> None:
    callback = EvalCallback(
        Monitor(AnySpacesEnv()),
        n_eval_episodes=2,
        eval_freq=8,
        best_model_save_path=str(tmp_path),
        log_path=str(tmp_path),
        verbose=0,
        warn=False,
    )
    model = small_model()
    model.learn(32, callback=callback)
    evaluations = np.load(tmp_path / "evaluations.npz")
    assert evaluations["timesteps"].tolist() == [16, 32]
    assert callback.best_mean_reward == pytest.approx(evaluations["results"].mean(axis=1).max())
    assert type(TRPOGAE.load(tmp_path / "best_model.zip")) is TRPOGAE


def test_evaluation_in_the_middle_of_a_rollout_changes_nothing() -> None:
    def trained(callback: BaseCallback | None) -> dict[str, th.Tensor]:
        model = small_model()
        model.learn(32, callback=callback)
        return state_of(model.policy)

    evaluation = EvalCallback(Monitor(AnySpacesEnv()), n_eval_episodes=1, eval_freq=3, verbose=0, warn=False)
    assert differing(trained(None), trained(evaluation)) == []


def test_checkpoints_can_be_loaded(tmp_path: Path) -> None:
    model = small_model()
    model.learn(48, callback=CheckpointCallback(save_freq=8, save_path=str(tmp_path), name_prefix="agent"))
    assert sorted(file.name for file in tmp_path.iterdir()) == [f"agent_{steps}_steps.zip" for steps in (16, 32, 48)]
    loaded = TRPOGAE.load(tmp_path / "agent_32_steps.zip", env=vec_env())
    # Taken at the last step of a rollout, before its update
    assert (loaded.num_timesteps, loaded._n_updates) == (32, 1)
    train_once(loaded)


def test_lists_of_callbacks_and_callbacks_in_callbacks_work() -> None:
    inner, outer = Recorder(), Recorder()
    small_model().learn(64, callback=CallbackList([outer, EveryNTimesteps(32, inner)]))
    assert sum(event == "step" for event, *_ in outer.events) == 32
    assert [steps for event, _, steps in inner.events if event == "step"] == [32, 64]


def test_training_stops_at_a_number_of_episodes() -> None:
    model = small_model()
    model.learn(1000, callback=StopTrainingOnMaxEpisodes(max_episodes=2))
    assert model.num_timesteps == 2 * 2 * 5, "two episodes of 5 steps in each of two environments"


def test_training_stops_at_a_reward() -> None:
    stop = StopTrainingOnRewardThreshold(reward_threshold=-1e9)
    evaluation = EvalCallback(Monitor(AnySpacesEnv()), stop, n_eval_episodes=1, eval_freq=5, verbose=0, warn=False)
    model = small_model()
    model.learn(1000, callback=evaluation)
    assert model.num_timesteps == 10


@pytest.mark.filterwarnings("ignore:rich is experimental")
def test_the_progress_bar_reaches_its_end(capsys: pytest.CaptureFixture[str]) -> None:
    small_model().learn(32, progress_bar=True)
    assert "32/32" in "".join(capsys.readouterr())


def test_a_trained_model_can_be_evaluated() -> None:
    model = small_model()
    model.learn(32)
    rewards, lengths = evaluate_policy(model, Monitor(AnySpacesEnv()), n_eval_episodes=3, return_episode_rewards=True)
    assert lengths == [5, 5, 5] and np.isfinite(rewards).all()


# Outputs


def test_scalars_reach_tensorboard(tmp_path: Path) -> None:
    model = small_model(Monitor(AnySpacesEnv()), tensorboard_log=str(tmp_path))
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
    model = small_model(tensorboard_log=str(tmp_path))
    model.learn(16, tb_log_name="mine")
    model.learn(16, tb_log_name="mine")
    assert sorted(run.name for run in tmp_path.iterdir()) == ["mine_1", "mine_2"]


def test_a_logger_of_the_users_is_used(tmp_path: Path) -> None:
    model = small_model(Monitor(AnySpacesEnv()))
    model.set_logger(configure(str(tmp_path), ["csv"]))
    model.learn(24)
    header, *rows = (tmp_path / "progress.csv").read_text().splitlines()
    assert {"train/kl_divergence_loss", "train/vf_steps", "rollout/ep_rew_mean", "time/total_timesteps"} <= set(
        header.split(",")
    )
    assert len(rows) == 3


def test_verbose_models_print_a_table_and_others_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    small_model(verbose=0).learn(32)
    assert capsys.readouterr().out == ""
    small_model(verbose=1).learn(32)
    assert "kl_divergence_loss" in capsys.readouterr().out


@pytest.mark.parametrize(("log_interval", "dumps"), [(1, 4), (2, 2), (None, 0)])
def test_logs_are_dumped_as_often_as_asked(log_interval: int | None, dumps: int, tmp_path: Path) -> None:
    model = small_model(Monitor(AnySpacesEnv()))
    model.set_logger(configure(str(tmp_path), ["csv"]))
    model.learn(4 * 8, log_interval=log_interval)  # type: ignore[arg-type]
    assert len((tmp_path / "progress.csv").read_text().splitlines()[1:]) == dumps


# What was done


def test_what_is_logged_is_what_was_done() -> None:
    model = small_model(n_steps=32, normalize_advantage=False)
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
    logged = train_once(small_model(vf_steps=vf_steps, vf_trust_region=radius))
    assert 1 <= logged["train/vf_steps"] <= vf_steps
    assert 0.0 < logged["train/vf_kl_divergence"] <= radius
    assert 1 <= logged["train/vf_cg_steps"] <= vf_steps * 10
    assert 1 <= logged["train/cg_steps"] <= 10
    assert 1 <= logged["train/line_search_trials"] <= 10


def test_one_value_step_goes_as_far_as_is_logged() -> None:
    r"""The constraint of the paper: mean squared change of the values over 2 sigma^2, sigma^2 the error before."""
    logged = train_once(model := small_model(vf_steps=1, vf_trust_region=0.01))
    samples = model.rollout_buffer.batch()
    with th.no_grad():
        change = model.policy.predict_values(samples.observations).flatten() - samples.old_values
    variance = (samples.old_values - samples.returns).square().mean()
    divergence = (change.square().mean() / (2.0 * variance)).item()
    assert logged["train/vf_kl_divergence"] == pytest.approx(divergence, rel=1e-3)
    assert 0.25 * 0.01 < divergence <= 0.01


# Searches that fail


def fail_searches(monkeypatch: pytest.MonkeyPatch, step: Any, objective: float, divergence: float) -> None:
    """Let each trial of a step end so, after it has moved the parameters."""
    real = step.trust_region_step

    def failing(problem: Any, settings: Any) -> Any:
        return real(dataclasses.replace(problem, evaluate=lambda: (objective, divergence)), settings)

    monkeypatch.setattr(step, "trust_region_step", failing)


@pytest.mark.parametrize(
    ("objective", "divergence"),
    [(math.inf, 0.0100001), (-math.inf, 0.0), (math.nan, 0.0), (1e9, math.nan), (-math.inf, math.inf)],
    ids=["too far", "worse", "objective is NaN", "divergence is NaN", "both infinite"],
)
def test_a_policy_search_that_fails_restores_every_bit_and_logs_that_nothing_was_done(
    objective: float, divergence: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = small_model()
    train_once(model)
    fail_searches(monkeypatch, sb3_gae.update.policy_step, objective, divergence)
    before = state_of(model.policy)
    probe = KLProbe()
    logged = train_once(model, probe)
    assert (logged["train/kl_divergence_loss"], logged["train/is_line_search_success"]) == (0.0, 0.0)
    assert logged["train/line_search_trials"] == model.line_search_max_iter
    assert logged["train/policy_objective"] == pytest.approx(0.0, abs=1e-6), "mean of standardized advantages"
    moved = differing(before, state_of(model.policy))
    assert probe.kl() == 0.0
    assert all("value_net" in name for name in moved) and "mlp_extractor.value_net.0.weight" in moved


def test_a_step_that_is_too_long_fails_in_earnest() -> None:
    """One trial at a radius where the quadratic model of the divergence is far off."""
    model = small_model(target_kl=1e6, line_search_max_iter=1, vf_steps=0)
    before = state_of(model.policy)
    logged = train_once(model)
    assert (logged["train/kl_divergence_loss"], logged["train/is_line_search_success"]) == (0.0, 0.0)
    assert all("value_net" in name for name in differing(before, state_of(model.policy)))


def test_a_value_search_that_fails_restores_the_values_and_logs_that_nothing_was_done(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    model = small_model(normalize_value=False)
    train_once(model)
    fail_searches(monkeypatch, sb3_gae.update.value_step, 1.0, 0.3)
    before = state_of(model.policy)
    logged = train_once(model)
    assert (logged["train/vf_steps"], logged["train/vf_kl_divergence"]) == (0, 0.0)
    # One from the rollout's own values, the other from those of the fit: the same function, added up in another order
    assert logged["train/explained_variance_after"] == pytest.approx(logged["train/explained_variance"], rel=1e-5)
    samples = model.rollout_buffer.batch()
    assert logged["train/value_loss"] == pytest.approx((samples.old_values - samples.returns).square().mean().item(), rel=1e-5)
    moved = differing(before, state_of(model.policy))
    assert "action_net.weight" in moved and not any("value_net" in name for name in moved)


def test_a_rollout_without_advantages_leaves_the_policy_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """A gradient of zero is no error."""
    model = small_model()
    real = type(model.rollout_buffer).compute_returns_and_advantage

    def without(self: Any, *args: Any) -> None:
        real(self, *args)
        self.advantages[:] = 0.5

    monkeypatch.setattr(type(model.rollout_buffer), "compute_returns_and_advantage", without)
    before = state_of(model.policy)
    logged = train_once(model)
    assert (logged["train/kl_divergence_loss"], logged["train/is_line_search_success"]) == (0.0, 0.0)
    assert all("value_net" in name for name in differing(before, state_of(model.policy)))
