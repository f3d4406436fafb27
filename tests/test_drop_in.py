"""The algorithm stands in for sb3-contrib's TRPO: arguments, logs, value fit, time limits, order of the update."""

import inspect
import warnings
from typing import Any

import numpy as np
import pytest
import sb3_contrib
import torch as th
from envs_for_tests import SMALL, AnySpacesEnv, differing, distribution_bits, state_of, train_once, vec_env, vec_env_of
from gymnasium.wrappers import TimeLimit
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.envs import (
    IdentityEnv,
    IdentityEnvBox,
    IdentityEnvMultiBinary,
    IdentityEnvMultiDiscrete,
)
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper

import sb3_gae.trpo_gae
from sb3_gae import TRPOGAE, GAERolloutBuffer

# Arguments


def test_arguments_of_contrib_come_first_in_the_same_order() -> None:
    theirs = list(inspect.signature(sb3_contrib.TRPO).parameters.values())
    ours = list(inspect.signature(TRPOGAE).parameters.values())
    assert [argument.name for argument in ours[: len(theirs)]] == [argument.name for argument in theirs]
    assert all(argument.kind is argument.POSITIONAL_OR_KEYWORD for argument in ours[: len(theirs)])
    assert all(argument.kind is not argument.POSITIONAL_OR_KEYWORD for argument in ours[len(theirs) :])


def test_defaults_are_contribs_but_for_those_of_the_solver_and_of_adam() -> None:
    theirs, ours = inspect.signature(sb3_contrib.TRPO).parameters, inspect.signature(TRPOGAE).parameters
    changed = {name for name in theirs if theirs[name].default != ours[name].default}
    assert changed == {"learning_rate", "batch_size", "n_critic_updates", "cg_max_steps"}
    model = TRPOGAE("MlpPolicy", vec_env(), vf_optimizer="adam")
    assert [model.learning_rate, model.batch_size, model.n_critic_updates] == [
        theirs[name].default for name in ("learning_rate", "batch_size", "n_critic_updates")
    ]


@pytest.mark.parametrize("method", ["learn", "predict", "save", "set_parameters", "get_parameters", "set_env", "train"])
def test_methods_take_contribs_arguments(method: str) -> None:
    theirs = inspect.signature(getattr(sb3_contrib.TRPO, method)).parameters
    ours = inspect.signature(getattr(TRPOGAE, method)).parameters
    assert list(theirs) == list(ours)
    assert {name: theirs[name].default for name in theirs if name != "tb_log_name"} == {
        name: ours[name].default for name in ours if name != "tb_log_name"
    }


def test_every_argument_of_contrib_is_read_and_kept(tmp_path: Any) -> None:
    class OwnBuffer(GAERolloutBuffer):
        pass

    arguments: dict[str, Any] = {
        **dict(learning_rate=2e-3, n_steps=12, batch_size=6, gamma=0.9, cg_max_steps=3, cg_damping=0.2),
        **dict(line_search_shrinking_factor=0.7, line_search_max_iter=4, n_critic_updates=2, gae_lambda=0.8),
        **dict(use_sde=True, sde_sample_freq=3, rollout_buffer_class=OwnBuffer, rollout_buffer_kwargs={}),
        **dict(normalize_advantage=False, target_kl=0.02, sub_sampling_factor=2, stats_window_size=7),
        **dict(tensorboard_log=str(tmp_path), policy_kwargs=SMALL, verbose=0, seed=5, device="cpu"),
    }
    model = TRPOGAE("MlpPolicy", vec_env(), *arguments.values(), vf_optimizer="adam")
    renamed = {"stats_window_size": "_stats_window_size"}
    kept = {name: getattr(model, renamed.get(name, name)) for name in arguments}
    assert kept.pop("device") == th.device(arguments.pop("device"))
    assert kept == arguments
    assert type(model.rollout_buffer) is OwnBuffer
    train_once(model)


def test_buffer_arguments_reach_the_buffer() -> None:
    class Labelled(GAERolloutBuffer):
        def __init__(self, *args: Any, label: str, **kwargs: Any):
            super().__init__(*args, **kwargs)
            self.label = label

    buffer: dict[str, Any] = {"rollout_buffer_class": Labelled, "rollout_buffer_kwargs": {"label": "mine"}}
    model = TRPOGAE("MlpPolicy", vec_env(), n_steps=8, policy_kwargs=SMALL, **buffer)
    train_once(model)
    assert isinstance(model.rollout_buffer, Labelled) and model.rollout_buffer.label == "mine"


@pytest.mark.parametrize(
    ("name", "value", "advice"),
    [
        ("learning_rate", 3e-4, "`target_kl` and `vf_trust_region`"),
        ("learning_rate", lambda remaining: 3e-4 * remaining, "`target_kl` and `vf_trust_region`"),
        ("batch_size", 64, "`n_steps`"),
        ("n_critic_updates", 5, "`vf_steps`"),
    ],
)
def test_arguments_of_the_adam_fit_warn_with_the_trust_region_and_say_what_to_use(name: str, value: Any, advice: str) -> None:
    with pytest.warns(UserWarning, match=f"`{name}` has no effect here") as caught:
        TRPOGAE("MlpPolicy", vec_env(), **{name: value})
    assert len(caught) == 1
    assert advice in str(caught[0].message) and "vf_optimizer='adam'" in str(caught[0].message)
    assert caught[0].filename == __file__, "the warning points to the caller's line"


@pytest.mark.parametrize("optimizer", ["trust_region", "adam"])
def test_no_warning_where_every_argument_has_an_effect(optimizer: str) -> None:
    adam = {"learning_rate": 1e-4, "batch_size": 8, "n_critic_updates": 3} if optimizer == "adam" else {}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        train_once(TRPOGAE("MlpPolicy", vec_env(), n_steps=8, vf_optimizer=optimizer, policy_kwargs=SMALL, seed=0, **adam))


@pytest.mark.parametrize(
    ("name", "value", "advice"),
    [
        ("ent_coef", 0.01, "log_std_init"),
        ("vf_coef", 0.5, "`vf_trust_region`"),
        ("max_grad_norm", 0.5, "`target_kl`"),
        ("n_epochs", 10, "`vf_steps`"),
        ("clip_range", 0.2, "`target_kl`"),
        ("clip_range_vf", None, "`vf_trust_region`"),
        ("use_rms_prop", True, "`target_kl`"),
        ("rms_prop_eps", 1e-5, "`target_kl`"),
    ],
)
def test_arguments_of_ppo_and_a2c_are_accepted_with_a_warning_that_says_what_to_use(
    name: str, value: Any, advice: str
) -> None:
    with pytest.warns(UserWarning, match=f"`{name}` has no effect here") as caught:
        TRPOGAE("MlpPolicy", vec_env(), **{name: value})
    assert len(caught) == 1 and advice in str(caught[0].message)


def test_every_argument_of_ppo_and_a2c_is_known() -> None:
    theirs = {*inspect.signature(PPO).parameters, *inspect.signature(A2C).parameters}
    known = {*inspect.signature(TRPOGAE).parameters, *sb3_gae.hyperparameters.FOREIGN_ARGUMENTS}
    assert theirs <= known


def test_an_unknown_argument_is_a_type_error_that_names_it() -> None:
    with pytest.raises(TypeError, match="unexpected keyword argument 'gae_lamda'"):
        TRPOGAE("MlpPolicy", vec_env(), gae_lamda=0.9)


def test_environments_can_be_named_and_policies_are_found_by_contribs_aliases() -> None:
    model = TRPOGAE("MlpPolicy", "CartPole-v1", n_steps=16, policy_kwargs=SMALL, seed=0)
    assert 0.0 < train_once(model)["train/kl_divergence_loss"] <= model.target_kl
    assert TRPOGAE.policy_aliases.keys() == sb3_contrib.TRPO.policy_aliases.keys() | {"SharedMlpPolicy"}


# Logs


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


# Value fit


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


# Time limits


class NoTerminalObservations(VecEnvWrapper):
    """Does not tell what was seen when a time limit struck."""

    def reset(self) -> Any:
        return self.venv.reset()

    def step_wait(self) -> Any:
        observations, rewards, dones, infos = self.venv.step_wait()
        for info in infos:
            info.pop("terminal_observation", None)
        return observations, rewards, dones, infos


class Endings(BaseCallback):
    """What the environments said at each step."""

    def __init__(self) -> None:
        super().__init__()
        self.rewards: list[np.ndarray] = []
        self.terminal: dict[tuple[int, int], np.ndarray] = {}
        self.terminated: list[tuple[int, int]] = []

    def _on_step(self) -> bool:
        step = len(self.rewards)
        self.rewards.append(self.locals["rewards"].copy())
        for env, (done, info) in enumerate(zip(self.locals["dones"], self.locals["infos"], strict=True)):
            if done and info["TimeLimit.truncated"]:
                self.terminal[step, env] = info["terminal_observation"]
            elif done:
                self.terminated.append((step, env))
        return True


def mixed_endings() -> VecEnv:
    """Episodes terminated and truncated by turns, episodes always cut by a time limit, and episodes never cut by it."""
    return vec_env_of([AnySpacesEnv(), AnySpacesEnv(length=4), TimeLimit(AnySpacesEnv(), 3), TimeLimit(AnySpacesEnv(), 8)])


@pytest.mark.parametrize("policy", ["MlpPolicy", ActorCriticPolicy])
def test_the_buffer_keeps_rewards_endings_and_terminal_values_apart(policy: Any) -> None:
    model = TRPOGAE(policy, mixed_endings(), n_steps=16, policy_kwargs=SMALL, seed=0)
    train_once(model)
    endings = Endings()
    values = {}

    class Values(BaseCallback):
        def _on_step(self) -> bool:
            return True

        def _on_rollout_end(self) -> None:
            for where, observation in endings.terminal.items():
                values[where] = self.model.policy.predict_values(th.as_tensor(observation)[None]).item()

    model.learn(16 * 4, callback=[endings, Values()], reset_num_timesteps=False)
    buffer = model.rollout_buffer
    np.testing.assert_array_equal(buffer.rewards, np.array(endings.rewards))
    assert sorted(zip(*np.nonzero(buffer.truncated), strict=True)) == sorted(endings.terminal)
    assert sorted(zip(*np.nonzero(buffer.terminated), strict=True)) == sorted(endings.terminated)
    assert len(endings.terminal) > 5 and len(endings.terminated) > 3
    for where, value in values.items():
        assert buffer.bootstrap_values[where] == pytest.approx(value, rel=1e-5, abs=1e-6)
    assert np.count_nonzero(buffer.bootstrap_values) == len(values)


def same_rollout(env: Any, **kwargs: Any) -> tuple[TRPOGAE, PPO]:
    """Ours and SB3's, after both collected with the same networks and the same random numbers."""
    settings: dict[str, Any] = {"n_steps": 16, "gamma": 0.9, "gae_lambda": 0.8, "policy_kwargs": SMALL, "seed": 1}

    def collect(model: Any) -> Any:
        model.train = lambda: None
        return model.learn(model.n_steps * model.n_envs)

    # One after the other: the constructor seeds the random numbers that the rollout then uses
    ours = collect(TRPOGAE(ActorCriticPolicy, env(), **settings, **kwargs))
    return ours, collect(PPO("MlpPolicy", env(), batch_size=32, **settings))


@pytest.mark.parametrize("hidden", [False, True], ids=["terminal observations", "no terminal observations"])
def test_a_rollout_is_sb3s_but_for_the_rewards_at_time_limits(hidden: bool) -> None:
    ours, theirs = same_rollout(lambda: NoTerminalObservations(mixed_endings()) if hidden else mixed_endings())
    buffer, expected = ours.rollout_buffer, theirs.rollout_buffer
    for name in ("observations", "actions", "episode_starts"):
        np.testing.assert_array_equal(getattr(buffer, name), getattr(expected, name), err_msg=name)
    for name in ("values", "log_probs", "advantages", "returns"):
        np.testing.assert_allclose(getattr(buffer, name), getattr(expected, name), rtol=1e-4, atol=1e-5, err_msg=name)
    bootstrapped = buffer.rewards + 0.9 * buffer.bootstrap_values
    np.testing.assert_allclose(bootstrapped, expected.rewards, atol=1e-5)
    assert buffer.truncated.any() != hidden
    assert (np.abs(bootstrapped - buffer.rewards) > 1e-3).any() != hidden


def test_value_lambda_changes_the_targets_and_not_the_advantages() -> None:
    ours, theirs = same_rollout(mixed_endings, value_lambda=1.0)
    np.testing.assert_allclose(ours.rollout_buffer.advantages, theirs.rollout_buffer.advantages, rtol=1e-4, atol=1e-5)
    assert np.abs(ours.rollout_buffer.returns - theirs.rollout_buffer.returns).max() > 1e-2


# Learning


@pytest.mark.parametrize(
    ("env", "iterations"),
    [
        *[(IdentityEnv(dim=4), 6), (IdentityEnvMultiDiscrete(dim=3), 6), (IdentityEnvMultiBinary(dim=3), 6)],
        (IdentityEnvBox(eps=0.2), 15),
    ],
    ids=["Discrete", "MultiDiscrete", "MultiBinary", "Box"],
)
def test_an_easy_task_is_learnt(env: Any, iterations: int) -> None:
    """The tasks of SB3's own tests: the right action is the observation itself, and each is worth 1 in 100 steps."""
    model = TRPOGAE("MlpPolicy", env, n_steps=128, gamma=0.0, target_kl=0.1, policy_kwargs=SMALL, seed=0)
    before, _ = evaluate_policy(model, model.get_env(), n_eval_episodes=1, warn=False)
    model.learn(iterations * 128)
    after, _ = evaluate_policy(model, model.get_env(), n_eval_episodes=1, warn=False)
    assert before < 50.0 and after > 95.0


# The update


def test_the_policy_steps_on_advantages_of_the_old_values_and_the_value_function_is_fitted_last(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    model = TRPOGAE("MlpPolicy", vec_env(), n_steps=16, normalize_advantage=False, policy_kwargs=SMALL, seed=0)
    order = []
    at_collection: dict[str, Any] = {}

    class AtCollection(BaseCallback):
        def _on_step(self) -> bool:
            return True

        def _on_rollout_end(self) -> None:
            order.append("rollout")
            observations = self.locals["rollout_buffer"].batch().observations
            at_collection["values"] = self.model.policy.predict_values(observations).flatten()
            at_collection["policy"] = distribution_bits(self.model.policy, observations)

    def policy_step(policy: Any, parameters: Any, batch: Any, advantages: th.Tensor, *rest: Any) -> Any:
        order.append("policy")
        buffer = model.rollout_buffer
        th.testing.assert_close(th.as_tensor(buffer.values.flatten()), at_collection["values"])
        th.testing.assert_close(advantages, th.as_tensor(buffer.advantages.flatten()), rtol=0, atol=0)
        th.testing.assert_close(policy.predict_values(batch.observations).flatten(), at_collection["values"], rtol=0, atol=0)
        return real_policy_step(policy, parameters, batch, advantages, *rest)

    def value_steps(policy: Any, parameters: Any, batch: Any, *rest: Any) -> Any:
        order.append("value")
        now = distribution_bits(policy, batch.observations)
        assert not any(th.equal(old, new) for old, new in zip(at_collection["policy"], now, strict=True))
        th.testing.assert_close(policy.predict_values(batch.observations).flatten(), at_collection["values"])
        return real_value_steps(policy, parameters, batch, *rest)

    real_policy_step, real_value_steps = sb3_gae.trpo_gae.policy_step, sb3_gae.trpo_gae.value_steps
    monkeypatch.setattr(sb3_gae.trpo_gae, "policy_step", policy_step)
    monkeypatch.setattr(sb3_gae.trpo_gae, "value_steps", value_steps)
    for _ in range(3):
        train_once(model, AtCollection())
    assert order == ["rollout", "policy", "value"] * 3


@pytest.mark.parametrize("normalize", [True, False])
def test_advantages_are_standardized_only_if_asked_and_never_in_the_buffer(
    normalize: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = TRPOGAE("MlpPolicy", vec_env(), n_steps=16, normalize_advantage=normalize, policy_kwargs=SMALL, seed=0)
    seen = []
    real = sb3_gae.trpo_gae.policy_step
    monkeypatch.setattr(sb3_gae.trpo_gae, "policy_step", lambda *args: (seen.append(args[3]), real(*args))[1])
    train_once(model)
    raw = th.as_tensor(model.rollout_buffer.advantages.flatten())
    assert abs(raw.mean()) > 1e-2
    expected = (raw - raw.mean()) / raw.std() if normalize else raw
    th.testing.assert_close(seen[0], expected, rtol=1e-4, atol=1e-5)


def test_no_value_steps_leave_the_value_function_alone() -> None:
    model = TRPOGAE("MlpPolicy", vec_env(), n_steps=16, vf_steps=0, normalize_value=False, policy_kwargs=SMALL, seed=0)
    before = state_of(model.policy)
    train_once(model)
    moved = differing(before, state_of(model.policy))
    assert "action_net.weight" in moved and not any("value" in name for name in moved)
