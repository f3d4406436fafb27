"""The algorithm takes the arguments of sb3-contrib's TRPO, and says which ones have no effect."""

import inspect
import warnings
from typing import Any

import pytest
import sb3_contrib
import torch as th
from envs_for_tests import SMALL, train_once, vec_env
from stable_baselines3 import A2C, PPO

import sb3_gae.trpo_gae
from sb3_gae import TRPOGAE, GAERolloutBuffer
from sb3_gae.hyperparameters import FOREIGN_ARGUMENTS


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
    known = {*inspect.signature(TRPOGAE).parameters, *FOREIGN_ARGUMENTS}
    assert theirs <= known


def test_foreign_arguments_are_not_kept() -> None:
    with pytest.warns(UserWarning):
        model = TRPOGAE("MlpPolicy", vec_env(), n_epochs=3)
    assert "n_epochs" in FOREIGN_ARGUMENTS and not hasattr(model, "n_epochs")


def test_an_unknown_argument_is_a_type_error_that_names_it() -> None:
    with pytest.raises(TypeError, match="unexpected keyword argument 'gae_lamda'"):
        TRPOGAE("MlpPolicy", vec_env(), gae_lamda=0.9)


def test_an_unknown_argument_is_found_before_workers_are_started(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sb3_gae.trpo_gae, "env_on_workers", lambda env, n_workers: pytest.fail("started"))
    with pytest.raises(TypeError, match="gae_lamda"):
        TRPOGAE("MlpPolicy", "CartPole-v1", rollout_workers=2, gae_lamda=0.9)


def test_environments_can_be_named_and_policies_are_found_by_contribs_aliases() -> None:
    model = TRPOGAE("MlpPolicy", "CartPole-v1", n_steps=16, policy_kwargs=SMALL, seed=0)
    assert 0.0 < train_once(model)["train/kl_divergence_loss"] <= model.target_kl
    assert TRPOGAE.policy_aliases.keys() == sb3_contrib.TRPO.policy_aliases.keys() | {"SharedMlpPolicy"}
