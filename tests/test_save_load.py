"""A saved model comes back whole, and goes on."""

import io
import json
import pickle
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sb3_contrib
import torch as th
from envs_for_tests import SMALL, VECTOR, AnySpacesEnv, KLProbe, differing, state_of, train_once, vec_env
from gymnasium import spaces
from saved_models import OBSERVATIONS, check_same, saved, trained_model, values_and_actions
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.vec_env import VecNormalize

from sb3_gae import TRPOGAE, GAERolloutBuffer, MlpPolicy

# There and back


@pytest.mark.parametrize("name", ["model", "model.zip", "with.dot", "folder/model"])
@pytest.mark.parametrize("kind", [str, Path])
def test_a_model_comes_back_from_a_path(kind: type, name: str, some_model: TRPOGAE, tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    path = kind(tmp_path / name)
    some_model.save(path)
    check_same(TRPOGAE.load(path), some_model)


def test_a_model_comes_back_from_memory_and_from_an_open_file(some_model: TRPOGAE, tmp_path: Path) -> None:
    memory = io.BytesIO()
    some_model.save(memory)
    memory.seek(0)
    check_same(TRPOGAE.load(memory), some_model)
    (tmp_path / "file").write_bytes(memory.getvalue())
    with (tmp_path / "file").open("rb") as opened:
        check_same(TRPOGAE.load(opened), some_model)
        assert not opened.closed


def test_settings_and_counters_come_back(model_file: bytes) -> None:
    settings: dict[str, Any] = {
        **dict(gamma=0.9, gae_lambda=0.8, value_lambda=0.7, target_kl=0.02, vf_trust_region=0.1, vf_steps=2, n_steps=16),
        **dict(cg_max_steps=3, vf_cg_max_steps=4, cg_damping=0.2, vf_cg_damping=0.3, curvature_samples=20),
        **dict(sub_sampling_factor=2, normalize_advantage=False, normalize_value=False, vf_optimizer="adam"),
        **dict(batch_size=8, n_critic_updates=1, learning_rate=0.01, line_search_max_iter=5),
    }
    model = trained_model(**settings)
    loaded = TRPOGAE.load(io.BytesIO(saved(model)))
    assert {name: getattr(loaded, name) for name in settings} == settings
    assert loaded.num_timesteps == model.num_timesteps == 64
    assert loaded._n_updates == model._n_updates == 2
    assert loaded.rollout_buffer.gamma == 0.9 and loaded.rollout_buffer_class is GAERolloutBuffer


def test_the_file_holds_no_rollout_and_no_environment(model_file: bytes) -> None:
    data = json.loads(zipfile.ZipFile(io.BytesIO(model_file)).read("data"))
    assert not {"rollout_buffer", "env", "policy", "_logger", "device"} & data.keys()
    theirs = sb3_contrib.TRPO("MlpPolicy", vec_env(), n_steps=16, batch_size=32, policy_kwargs=SMALL)
    assert json.loads(zipfile.ZipFile(io.BytesIO(saved(theirs))).read("data")).keys() - data.keys() == set()


def test_save_leaves_out_and_takes_in_what_is_asked(some_model: TRPOGAE) -> None:
    file = io.BytesIO()
    some_model.save(file, exclude=["tensorboard_log"], include=["_custom_logger"])
    data = json.loads(zipfile.ZipFile(file).read("data"))
    assert "tensorboard_log" not in data and "_custom_logger" in data


@pytest.mark.parametrize("policy", [MlpPolicy, ActorCriticPolicy])
def test_policies_given_as_classes_come_back(policy: Any) -> None:
    model = TRPOGAE(policy, vec_env(), n_steps=16, policy_kwargs=SMALL | {"activation_fn": th.nn.ReLU}, seed=0)
    train_once(model)
    loaded = TRPOGAE.load(io.BytesIO(saved(model)))
    assert type(loaded.policy) is policy
    check_same(loaded, model)


def test_a_gsde_model_comes_back() -> None:
    model = trained_model(use_sde=True, policy_kwargs=SMALL | {"squash_output": True})
    loaded = TRPOGAE.load(io.BytesIO(saved(model)), env=vec_env())
    check_same(loaded, model)
    train_once(loaded)


def test_a_model_of_dict_observations_comes_back() -> None:
    make = lambda: AnySpacesEnv(spaces.Dict({"one": VECTOR, "two": spaces.Discrete(3)}))  # noqa: E731
    model = TRPOGAE("MultiInputPolicy", vec_env(make), n_steps=16, policy_kwargs=SMALL, seed=0)
    train_once(model)
    loaded = TRPOGAE.load(io.BytesIO(saved(model)), env=vec_env(make))
    assert differing(state_of(model.policy), state_of(loaded.policy)) == []
    train_once(loaded)


def test_a_loaded_model_goes_through_pickle(model_file: bytes) -> None:
    loaded = TRPOGAE.load(io.BytesIO(model_file))
    again = pickle.loads(pickle.dumps(loaded))
    check_same(again, loaded)


def test_a_policy_comes_back_on_its_own(some_model: TRPOGAE, tmp_path: Path) -> None:
    some_model.policy.save(tmp_path / "policy")
    policy = MlpPolicy.load(tmp_path / "policy")
    assert differing(state_of(some_model.policy), state_of(policy)) == []
    np.testing.assert_array_equal(policy.predict(OBSERVATIONS, deterministic=True)[0], values_and_actions(some_model)[1])
    th.testing.assert_close(
        policy.predict_values(th.as_tensor(OBSERVATIONS)), th.as_tensor(values_and_actions(some_model)[0]), rtol=0, atol=0
    )


# To go on with


@pytest.mark.parametrize("vf_optimizer", ["trust_region", "adam"])
def test_training_after_loading_is_training_without_having_stopped(vf_optimizer: str) -> None:
    """Parameters, value scale, optimiser state and counters all count: the next update is the same bit for bit."""
    model = trained_model(vf_optimizer=vf_optimizer)
    memory = io.BytesIO(saved(model))

    def go_on(model: TRPOGAE) -> dict[str, th.Tensor]:
        model.set_env(vec_env())
        model.set_random_seed(7)
        train_once(model)
        return state_of(model.policy)

    expected = go_on(model)
    loaded = TRPOGAE.load(memory)
    assert differing(expected, go_on(loaded)) == []
    assert loaded.num_timesteps == model.num_timesteps == 96
    assert loaded._n_updates == 3


def test_counting_starts_anew_if_asked(model_file: bytes) -> None:
    loaded = TRPOGAE.load(io.BytesIO(model_file), env=vec_env())
    loaded.learn(32, reset_num_timesteps=False)
    assert loaded.num_timesteps == 96
    loaded.learn(32)
    assert loaded.num_timesteps == 32


@pytest.mark.parametrize("n_envs", [1, 3])
def test_a_model_goes_on_with_another_number_of_environments(n_envs: int, model_file: bytes) -> None:
    loaded = TRPOGAE.load(io.BytesIO(model_file), env=vec_env(n_envs=n_envs))
    probe = KLProbe()
    logged = train_once(loaded, probe)
    assert loaded.rollout_buffer.rewards.shape == (16, n_envs)
    assert probe.kl() == pytest.approx(logged["train/kl_divergence_loss"], rel=1e-3)


def test_a_loaded_model_takes_an_environment_later(model_file: bytes) -> None:
    loaded = TRPOGAE.load(io.BytesIO(model_file))
    assert loaded.get_env() is None
    loaded.set_env(vec_env())
    train_once(loaded)


def test_an_environment_with_other_spaces_is_refused(model_file: bytes) -> None:
    other = vec_env(lambda: AnySpacesEnv(spaces.Box(-1, 1, (4,), np.float32)))
    with pytest.raises(ValueError, match="Observation spaces do not match"):
        TRPOGAE.load(io.BytesIO(model_file), env=other)
    with pytest.raises(ValueError, match="Observation spaces do not match"):
        TRPOGAE.load(io.BytesIO(model_file)).set_env(other)


def test_settings_can_be_replaced_while_loading(model_file: bytes) -> None:
    loaded = TRPOGAE.load(
        io.BytesIO(model_file), env=vec_env(), n_steps=8, target_kl=1e-4, vf_steps=1, gamma=0.5, gae_lambda=0.3
    )
    logged = train_once(loaded)
    assert loaded.rollout_buffer.rewards.shape == (8, 2)
    assert (loaded.rollout_buffer.gamma, loaded.rollout_buffer.gae_lambda) == (0.5, 0.3)
    assert 0.0 < logged["train/kl_divergence_loss"] <= 1e-4
    assert logged["train/vf_steps"] <= 1


def test_settings_that_replace_are_checked_too(model_file: bytes) -> None:
    with pytest.raises(ValueError, match="`target_kl`"):
        TRPOGAE.load(io.BytesIO(model_file), target_kl=-1.0)


def test_custom_objects_replace_what_was_saved(model_file: bytes) -> None:
    loaded = TRPOGAE.load(io.BytesIO(model_file), custom_objects={"gamma": 0.5, "learning_rate": 0.7})
    assert loaded.gamma == loaded.rollout_buffer.gamma == 0.5
    assert loaded.lr_schedule(1.0) == 0.7


def test_a_normalized_environment_is_found_again(tmp_path: Path) -> None:
    env = VecNormalize(vec_env())
    model = TRPOGAE("MlpPolicy", env, n_steps=16, policy_kwargs=SMALL, seed=0)
    train_once(model)
    model.save(tmp_path / "model")
    env.save(str(tmp_path / "env.pkl"))
    restored = VecNormalize.load(str(tmp_path / "env.pkl"), vec_env())
    loaded = TRPOGAE.load(tmp_path / "model", env=restored)
    assert loaded.get_vec_normalize_env() is restored
    np.testing.assert_array_equal(restored.obs_rms.mean, env.obs_rms.mean)
    train_once(loaded)
