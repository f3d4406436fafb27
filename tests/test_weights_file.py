"""Weights and settings travel without pickle."""

import json
import struct
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from envs_for_tests import CHANNEL_FIRST, SMALL, VECTOR, AnySpacesEnv, differing, state_of, train_once, vec_env
from gymnasium import spaces
from stable_baselines3 import A2C, PPO
from weights_files import load, trained, written

from sb3_gae import TRPOGAE, MlpPolicy


@pytest.fixture(scope="module")
def model() -> TRPOGAE:
    return trained()


@pytest.fixture(scope="module")
def content(model: TRPOGAE) -> bytes:
    return written(model.save_weights)


SETTINGS: dict[str, Any] = {
    **dict(gamma=0.9, gae_lambda=0.8, value_lambda=0.7, target_kl=0.02, vf_trust_region=0.1, vf_steps=2, n_steps=16),
    **dict(cg_max_steps=3, vf_cg_max_steps=4, cg_damping=0.2, vf_cg_damping=0.3, curvature_samples=20, n_episodes=3),
    **dict(sub_sampling_factor=2, normalize_advantage=False, normalize_value=False, line_search_max_iter=5),
}


@pytest.mark.parametrize("by", ["save_weights", "save"])
def test_weights_and_settings_come_back(by: str, tmp_path: Path) -> None:
    policy_kwargs = {"net_arch": dict(pi=[8], vf=[4, 4]), "activation_fn": th.nn.ReLU, "log_std_init": -0.5}
    model = trained(**SETTINGS, policy_kwargs=policy_kwargs)
    path = tmp_path / "model.zip"
    getattr(model, by)(path)
    loaded = TRPOGAE.load_weights(path, vec_env())
    assert differing(state_of(model.policy), state_of(loaded.policy)) == []
    assert {name: getattr(loaded, name) for name in SETTINGS} == SETTINGS
    assert loaded.policy_kwargs == policy_kwargs and isinstance(loaded.policy.mlp_extractor.policy_net[1], th.nn.ReLU)
    assert loaded.policy.value_net.scale != 1.0 or not model.normalize_value
    train_once(loaded)


def test_adam_gsde_and_a_rule_for_lambda_come_back_as_far_as_they_are_settings(tmp_path: Path) -> None:
    model = trained(vf_optimizer="adam", batch_size=8, n_critic_updates=2, use_sde=True, gae_lambda="auto")
    model.save_weights(tmp_path / "model")
    loaded = TRPOGAE.load_weights(tmp_path / "model", vec_env())
    assert (loaded.batch_size, loaded.n_critic_updates, loaded.use_sde) == (8, 2, True)
    assert loaded.gae_lambda == model.gae_lambda
    assert differing(state_of(model.policy), state_of(loaded.policy)) == []


@pytest.mark.parametrize("by", ["save_weights", "save"])
def test_the_learning_rate_of_adam_comes_back(by: str, tmp_path: Path) -> None:
    model = trained(vf_optimizer="adam", learning_rate=1e-4)
    getattr(model, by)(tmp_path / "model.zip")
    loaded = TRPOGAE.load_weights(tmp_path / "model.zip", vec_env())
    assert loaded.learning_rate == 1e-4 and loaded.policy.optimizer.param_groups[0]["lr"] == 1e-4
    assert TRPOGAE.load_weights(tmp_path / "model.zip", vec_env(), learning_rate=0.5).learning_rate == 0.5


def test_a_schedule_of_the_learning_rate_is_refused_where_it_has_an_effect(tmp_path: Path) -> None:
    schedule = lambda progress: 1e-3 * progress  # noqa: E731
    model = trained(vf_optimizer="adam", learning_rate=schedule)
    with pytest.raises(ValueError, match=r"`learning_rate` is a schedule.*or set `model\.learning_rate` to a number"):
        model.save_weights(tmp_path / "model")
    assert list(tmp_path.iterdir()) == []
    model.learning_rate = 2e-4
    model.save_weights(tmp_path / "model")
    assert TRPOGAE.load_weights(tmp_path / "model", vec_env()).learning_rate == 2e-4
    with pytest.warns(UserWarning, match="`learning_rate` has no effect here"):
        trained(learning_rate=schedule).save_weights(tmp_path / "model")
    TRPOGAE.load_weights(tmp_path / "model", vec_env())


def test_numbers_of_numpy_come_back_as_numbers(tmp_path: Path) -> None:
    settings: Any = dict(n_steps=np.int64(16), target_kl=np.float32(0.5), normalize_advantage=np.bool_(False))
    policy_kwargs = {"net_arch": dict(pi=[np.int64(8)], vf=[4]), "log_std_init": np.float32(-0.5)}
    model = trained(**settings, policy_kwargs=policy_kwargs, vf_optimizer="adam", learning_rate=0.25)
    model.save_weights(tmp_path / "model")
    loaded = TRPOGAE.load_weights(tmp_path / "model", vec_env())
    assert {name: getattr(loaded, name) for name in settings} == settings
    assert type(loaded.n_steps) is int and loaded.learning_rate == 0.25
    assert loaded.policy_kwargs == policy_kwargs
    assert differing(state_of(model.policy), state_of(loaded.policy)) == []


def test_the_file_is_one_of_safetensors(content: bytes, model: TRPOGAE) -> None:
    """By its documented layout."""
    length = struct.unpack("<Q", content[:8])[0]
    header = json.loads(content[8 : 8 + length])
    assert length % 8 == 0 and all(isinstance(value, str) for value in header.pop("__metadata__").values())
    for name, tensor in model.policy.state_dict().items():
        begin, end = header[name]["data_offsets"]
        found = np.frombuffer(content[8 + length :][begin:end], {"F32": np.float32, "I64": np.int64}[header[name]["dtype"]])
        np.testing.assert_array_equal(found.reshape(header[name]["shape"]), tensor)


def test_arguments_replace_what_is_in_the_file(content: bytes, tmp_path: Path) -> None:
    assert load(content, tmp_path, gamma=0.5, n_steps=8).gamma == 0.5


def test_what_is_wrong_with_an_argument_is_not_put_down_to_the_file(content: bytes, tmp_path: Path) -> None:
    with pytest.raises(TypeError, match=r"got an unexpected keyword argument 'gama'$"):
        load(content, tmp_path, gama=0.5)
    with pytest.raises(ValueError, match=r"The settings in \S+ with your 'n_steps' make no model"):
        load(content, tmp_path, n_steps=10**15)


def test_weights_of_another_algorithm_are_taken(tmp_path: Path) -> None:
    theirs = PPO("MlpPolicy", vec_env(), n_steps=16, batch_size=16, policy_kwargs=SMALL)
    theirs.save(tmp_path / "theirs.zip")
    ours = TRPOGAE.load_weights(tmp_path / "theirs.zip", vec_env(), n_steps=16)
    observations = vec_env().reset()
    np.testing.assert_array_equal(*(one.predict(observations, deterministic=True)[0] for one in (ours, theirs)))


@pytest.mark.parametrize("kind", [A2C, TRPOGAE])
def test_the_optimiser_of_a_file_of_save_begins_anew(kind: Any, tmp_path: Path) -> None:
    """A2C's own default has a class of optimiser among the policy's arguments."""
    of_ours = {} if kind is A2C else {"policy_kwargs": {"optimizer_class": th.optim.AdamW}}
    theirs = kind("MlpPolicy", vec_env(), n_steps=16, **of_ours)
    theirs.save(tmp_path / "theirs.zip")
    ours = TRPOGAE.load_weights(tmp_path / "theirs.zip", vec_env(), n_steps=16)
    observations = vec_env().reset()
    np.testing.assert_array_equal(*(one.predict(observations, deterministic=True)[0] for one in (ours, theirs)))
    assert type(ours.policy.optimizer) is th.optim.Adam


def test_arguments_of_the_policy_stand_for_those_that_cannot_be_read(tmp_path: Path) -> None:
    kwargs = SMALL | {"activation_fn": th.nn.Hardtanh}
    model = trained(policy_kwargs=kwargs)
    model.save(tmp_path / "model.zip")
    with pytest.raises(ValueError, match="`activation_fn` must be one of"):
        TRPOGAE.load_weights(tmp_path / "model.zip", vec_env())
    loaded = TRPOGAE.load_weights(tmp_path / "model.zip", vec_env(), policy_kwargs=kwargs)
    assert differing(state_of(model.policy), state_of(loaded.policy)) == []


@pytest.mark.parametrize("by", ["save", "save_weights"])
@pytest.mark.parametrize("name", ["value_lambda", "curvature_samples", "n_episodes"])
def test_none_comes_back_as_none(by: str, name: str, tmp_path: Path) -> None:
    getattr(trained(**{name: None}), by)(tmp_path / "model.zip")
    assert getattr(TRPOGAE.load_weights(tmp_path / "model.zip", vec_env()), name) is None


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"policy_kwargs": SMALL | {"features_extractor_kwargs": {}}}, "cannot be kept without pickle"),
        ({"policy_kwargs": SMALL | {"activation_fn": th.nn.Hardtanh}}, "`activation_fn` must be one of"),
    ],
)
def test_what_needs_pickle_is_not_written(changes: Any, message: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=message):
        trained(**changes).save_weights(tmp_path / "model")
    assert list(tmp_path.iterdir()) == []


def test_a_policy_of_ones_own_is_not_written(tmp_path: Path) -> None:
    class Own(MlpPolicy):
        pass

    with pytest.raises(ValueError, match="Own is no policy of TRPOGAE with a name"):
        TRPOGAE(Own, vec_env(), n_steps=16).save_weights(tmp_path / "model")


def test_a_dictionary_of_observations_and_pictures_find_their_policy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for space, policy in ((spaces.Dict({"one": VECTOR}), "MultiInputPolicy"), (CHANNEL_FIRST, "CnnPolicy")):
        spec = gym.envs.registration.EnvSpec("AnySpaces-v0", lambda space=space: AnySpacesEnv(space))
        monkeypatch.setitem(gym.registry, "AnySpaces-v0", spec)
        env = vec_env(lambda space=space: AnySpacesEnv(space))
        model = TRPOGAE(policy, env, n_steps=16, policy_kwargs=SMALL)
        for by in (model.save, model.save_weights):
            by(tmp_path / "model.zip")
            for of in (env, "AnySpaces-v0"):
                loaded = TRPOGAE.load_weights(tmp_path / "model.zip", of)
                assert differing(state_of(model.policy), state_of(loaded.policy)) == []
