"""A saved model comes back whole, and a file that is not one changes nothing."""

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
from envs_for_tests import (
    SMALL,
    VECTOR,
    AnySpacesEnv,
    KLProbe,
    differing,
    optimizer_state,
    state_of,
    train_once,
    vec_env,
)
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.vec_env import VecNormalize

from sb3_gae import TRPOGAE, GAERolloutBuffer, MlpPolicy
from sb3_gae.hyperparameters import FOREIGN_ARGUMENTS

OBSERVATIONS = np.random.default_rng(0).uniform(-1, 1, (64, 3)).astype(np.float32)


def trained_model(**kwargs: Any) -> TRPOGAE:
    model = TRPOGAE("MlpPolicy", vec_env(), **({"n_steps": 16, "policy_kwargs": SMALL, "seed": 0} | kwargs))
    train_once(model)
    train_once(model)
    return model


def fresh_model(**kwargs: Any) -> TRPOGAE:
    return TRPOGAE("MlpPolicy", vec_env(), **({"n_steps": 16, "policy_kwargs": SMALL, "seed": 1} | kwargs))


def saved(model: BaseAlgorithm) -> bytes:
    file = io.BytesIO()
    model.save(file)
    return file.getvalue()


@pytest.fixture(scope="module")
def model() -> TRPOGAE:
    """Trained; tests leave it as it is."""
    return trained_model()


@pytest.fixture(scope="module")
def file(model: TRPOGAE) -> bytes:
    return saved(model)


def values_and_actions(model: Any) -> tuple[np.ndarray, np.ndarray]:
    values = model.policy.predict_values(th.as_tensor(OBSERVATIONS)).detach().numpy()
    return values, model.predict(OBSERVATIONS, deterministic=True)[0]


def check_same(loaded: TRPOGAE, model: TRPOGAE) -> None:
    assert differing(state_of(model.policy), state_of(loaded.policy)) == []
    for mine, theirs in zip(values_and_actions(model), values_and_actions(loaded), strict=True):
        np.testing.assert_array_equal(mine, theirs)


# There and back


@pytest.mark.parametrize("name", ["model", "model.zip", "with.dot", "folder/model"])
@pytest.mark.parametrize("kind", [str, Path])
def test_a_model_comes_back_from_a_path(kind: type, name: str, model: TRPOGAE, tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    path = kind(tmp_path / name)
    model.save(path)
    check_same(TRPOGAE.load(path), model)


def test_a_model_comes_back_from_memory_and_from_an_open_file(model: TRPOGAE, tmp_path: Path) -> None:
    memory = io.BytesIO()
    model.save(memory)
    memory.seek(0)
    check_same(TRPOGAE.load(memory), model)
    (tmp_path / "file").write_bytes(memory.getvalue())
    with (tmp_path / "file").open("rb") as opened:
        check_same(TRPOGAE.load(opened), model)
        assert not opened.closed


def test_settings_and_counters_come_back(file: bytes) -> None:
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


def test_the_file_holds_no_rollout_and_no_environment(file: bytes) -> None:
    data = json.loads(zipfile.ZipFile(io.BytesIO(file)).read("data"))
    assert not {"rollout_buffer", "env", "policy", "_logger", "device"} & data.keys()
    theirs = sb3_contrib.TRPO("MlpPolicy", vec_env(), n_steps=16, batch_size=32, policy_kwargs=SMALL)
    assert json.loads(zipfile.ZipFile(io.BytesIO(saved(theirs))).read("data")).keys() - data.keys() == set()


def test_save_leaves_out_and_takes_in_what_is_asked(model: TRPOGAE) -> None:
    file = io.BytesIO()
    model.save(file, exclude=["tensorboard_log"], include=["_custom_logger"])
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


def test_a_loaded_model_goes_through_pickle(file: bytes) -> None:
    loaded = TRPOGAE.load(io.BytesIO(file))
    again = pickle.loads(pickle.dumps(loaded))
    check_same(again, loaded)


def test_a_policy_comes_back_on_its_own(model: TRPOGAE, tmp_path: Path) -> None:
    model.policy.save(tmp_path / "policy")
    policy = MlpPolicy.load(tmp_path / "policy")
    assert differing(state_of(model.policy), state_of(policy)) == []
    np.testing.assert_array_equal(policy.predict(OBSERVATIONS, deterministic=True)[0], values_and_actions(model)[1])
    th.testing.assert_close(
        policy.predict_values(th.as_tensor(OBSERVATIONS)), th.as_tensor(values_and_actions(model)[0]), rtol=0, atol=0
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


def test_counting_starts_anew_if_asked(file: bytes) -> None:
    loaded = TRPOGAE.load(io.BytesIO(file), env=vec_env())
    loaded.learn(32, reset_num_timesteps=False)
    assert loaded.num_timesteps == 96
    loaded.learn(32)
    assert loaded.num_timesteps == 32


@pytest.mark.parametrize("n_envs", [1, 3])
def test_a_model_goes_on_with_another_number_of_environments(n_envs: int, file: bytes) -> None:
    loaded = TRPOGAE.load(io.BytesIO(file), env=vec_env(n_envs=n_envs))
    probe = KLProbe()
    logged = train_once(loaded, probe)
    assert loaded.rollout_buffer.rewards.shape == (16, n_envs)
    assert probe.kl() == pytest.approx(logged["train/kl_divergence_loss"], rel=1e-3)


def test_a_loaded_model_takes_an_environment_later(file: bytes) -> None:
    loaded = TRPOGAE.load(io.BytesIO(file))
    assert loaded.get_env() is None
    loaded.set_env(vec_env())
    train_once(loaded)


def test_an_environment_with_other_spaces_is_refused(file: bytes) -> None:
    other = vec_env(lambda: AnySpacesEnv(spaces.Box(-1, 1, (4,), np.float32)))
    with pytest.raises(ValueError, match="Observation spaces do not match"):
        TRPOGAE.load(io.BytesIO(file), env=other)
    with pytest.raises(ValueError, match="Observation spaces do not match"):
        TRPOGAE.load(io.BytesIO(file)).set_env(other)


def test_settings_can_be_replaced_while_loading(file: bytes) -> None:
    loaded = TRPOGAE.load(io.BytesIO(file), env=vec_env(), n_steps=8, target_kl=1e-4, vf_steps=1, gamma=0.5, gae_lambda=0.3)
    logged = train_once(loaded)
    assert loaded.rollout_buffer.rewards.shape == (8, 2)
    assert (loaded.rollout_buffer.gamma, loaded.rollout_buffer.gae_lambda) == (0.5, 0.3)
    assert 0.0 < logged["train/kl_divergence_loss"] <= 1e-4
    assert logged["train/vf_steps"] <= 1


def test_settings_that_replace_are_checked_too(file: bytes) -> None:
    with pytest.raises(ValueError, match="`target_kl`"):
        TRPOGAE.load(io.BytesIO(file), target_kl=-1.0)


def test_custom_objects_replace_what_was_saved(file: bytes) -> None:
    loaded = TRPOGAE.load(io.BytesIO(file), custom_objects={"gamma": 0.5, "learning_rate": 0.7})
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


# Parameters


def test_parameters_go_from_one_model_to_another(model: TRPOGAE) -> None:
    other = fresh_model()
    assert differing(state_of(other.policy), state_of(model.policy)) != []
    other.set_parameters(model.get_parameters())
    check_same(other, model)


def test_parameters_go_from_a_file_to_a_model(model: TRPOGAE, file: bytes, tmp_path: Path) -> None:
    (tmp_path / "model.zip").write_bytes(file)
    for source in (tmp_path / "model.zip", str(tmp_path / "model"), io.BytesIO(file)):
        other = fresh_model()
        other.set_parameters(source)  # type: ignore[arg-type]
        check_same(other, model)


def test_some_parameters_can_be_replaced() -> None:
    other = trained_model()
    assert other.policy.value_net.scale != 1.0
    before = state_of(other.policy)
    other.set_parameters({"policy": {"action_net.bias": th.ones(2)}}, exact_match=False)
    assert differing(before, state_of(other.policy)) == ["action_net.bias"]


@pytest.mark.parametrize("policy", ["MlpPolicy", ActorCriticPolicy])
@pytest.mark.parametrize("through_a_file", [False, True])
def test_weights_of_contribs_trpo_are_taken_over(through_a_file: bool, policy: Any) -> None:
    theirs = sb3_contrib.TRPO("MlpPolicy", vec_env(), n_steps=16, batch_size=32, policy_kwargs=SMALL, seed=3)
    theirs.learn(32)
    ours = TRPOGAE(policy, vec_env(), n_steps=16, policy_kwargs=SMALL, seed=0)
    train_once(ours)
    ours.set_parameters(io.BytesIO(saved(theirs)) if through_a_file else theirs.get_parameters())  # type: ignore[arg-type]
    for mine, expected in zip(values_and_actions(ours), values_and_actions(theirs), strict=True):
        np.testing.assert_array_equal(mine, expected)
    values = []
    probe = KLProbe()
    probe._on_rollout_end = lambda: values.append(values_and_actions(ours)[0])  # type: ignore[method-assign]
    train_once(ours, probe)
    np.testing.assert_array_equal(values[0], values_and_actions(theirs)[0], "the first rollout leaves the values as they were")


def mismatches() -> dict[str, dict[str, Any]]:
    good = fresh_model(seed=9, vf_optimizer="adam").get_parameters()
    policy, optimizer = good["policy"], good["policy.optimizer"]
    one_group_more = {"state": {}, "param_groups": optimizer["param_groups"] * 2}
    return {
        "a tensor is missing": good | {"policy": {name: policy[name] for name in policy if name != "value_net.bias"}},
        "a tensor too many": good | {"policy": policy | {"other": th.zeros(1)}},
        "the last tensor is of another shape": good | {"policy": policy | {"value_net.bias": th.zeros(3)}},
        "an object is missing": {"policy": policy},
        "an object too many": good | {"nobody": policy},
        "another optimiser": good | {"policy.optimizer": one_group_more},
        "numbers instead of tensors": good | {"policy": dict.fromkeys(policy, 0.0)},
    }


@pytest.mark.parametrize("what", mismatches())
def test_parameters_that_do_not_fit_change_nothing(what: str) -> None:
    model = trained_model(vf_optimizer="adam")
    before, optimizer = state_of(model.policy), optimizer_state(model)
    with pytest.raises((ValueError, RuntimeError, TypeError, AttributeError)):
        model.set_parameters(mismatches()[what])
    assert differing(before, state_of(model.policy)) == []
    assert len(optimizer) > 8 and differing(optimizer, optimizer_state(model)) == []


# Damaged and foreign files


def check_refused(damaged: bytes, model: TRPOGAE, tmp_path: Path) -> None:
    """By both ways of reading, from memory and from a path, and the model in memory does not notice."""
    before = state_of(model.policy)
    (tmp_path / "damaged.zip").write_bytes(damaged)
    for source in (io.BytesIO(damaged), tmp_path / "damaged.zip", str(tmp_path / "damaged.zip")):
        with pytest.raises(ValueError, match=r"damaged, or is not a model"):
            TRPOGAE.load(source)
        with pytest.raises(ValueError, match=r"damaged, or is not a model"):
            model.set_parameters(source)  # type: ignore[arg-type]
        assert differing(before, state_of(model.policy)) == []


@pytest.mark.parametrize("tenths", range(10))
def test_a_truncated_file_is_refused(tenths: int, file: bytes, tmp_path: Path) -> None:
    check_refused(file[: len(file) * tenths // 10], fresh_model(), tmp_path)


def test_a_file_that_lacks_its_last_byte_is_refused(file: bytes, tmp_path: Path) -> None:
    check_refused(file[:-1], fresh_model(), tmp_path)


@pytest.mark.parametrize("member", ["data", "policy.pth", "policy.optimizer.pth", "pytorch_variables.pth", "system_info.txt"])
@pytest.mark.parametrize("part", [0.0, 0.25, 0.5, 0.75, 1.0])
def test_a_flipped_byte_in_any_member_is_refused(part: float, member: str, file: bytes, tmp_path: Path) -> None:
    info = zipfile.ZipFile(io.BytesIO(file)).getinfo(member)
    start = info.header_offset + 30 + int.from_bytes(file[info.header_offset + 26 : info.header_offset + 28], "little")
    start += int.from_bytes(file[info.header_offset + 28 : info.header_offset + 30], "little")
    check_refused(flipped(file, start + int(part * (info.compress_size - 1))), fresh_model(), tmp_path)


def test_a_flipped_weight_is_refused(file: bytes, model: TRPOGAE, tmp_path: Path) -> None:
    """Also where only the numbers change and the file reads well in every other respect."""
    weights = model.policy.action_net.weight.detach().numpy().tobytes()
    assert file.count(weights) == 1
    check_refused(flipped(file, file.index(weights) + 5), fresh_model(), tmp_path)


def flipped(content: bytes, position: int) -> bytes:
    return content[:position] + bytes([content[position] ^ 0xFF]) + content[position + 1 :]


def test_a_flipped_byte_anywhere_is_refused_or_changes_nothing(file: bytes, model: TRPOGAE) -> None:
    """Some bytes of an archive mean nothing to a reader, such as dates."""
    refused = 0
    for position in np.linspace(0, len(file) - 1, 60, dtype=int):
        try:
            loaded = TRPOGAE.load(io.BytesIO(flipped(file, position)))
        except ValueError:
            refused += 1
        else:
            check_same(loaded, model)
    assert refused > 50


@pytest.mark.parametrize("content", [b"", b"PK", b"not a zip at all" * 100], ids=["empty", "two bytes", "text"])
def test_a_file_of_another_kind_is_refused(content: bytes, tmp_path: Path) -> None:
    check_refused(content, fresh_model(), tmp_path)


def test_an_archive_of_another_kind_is_refused(tmp_path: Path) -> None:
    memory = io.BytesIO()
    with zipfile.ZipFile(memory, "w") as archive:
        archive.writestr("readme.txt", "nothing to learn here")
    check_refused(memory.getvalue(), fresh_model(), tmp_path)


@pytest.mark.parametrize("data", ["[1, 2]", '[{"vf_trust_region": 1}]', "5", "no JSON"])
def test_an_archive_that_looks_like_a_model_is_refused(data: str, file: bytes, tmp_path: Path) -> None:
    memory = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(file)) as good, zipfile.ZipFile(memory, "w") as archive:
        for member in good.namelist():
            archive.writestr(member, data if member == "data" else good.read(member))
    check_refused(memory.getvalue(), fresh_model(), tmp_path)


@pytest.mark.parametrize("missing", ["data", "policy.pth", "policy.optimizer.pth"])
def test_an_archive_that_lacks_a_member_is_refused(missing: str, file: bytes, tmp_path: Path) -> None:
    memory = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(file)) as good, zipfile.ZipFile(memory, "w") as archive:
        for member in good.namelist():
            if member != missing:
                archive.writestr(member, good.read(member))
    check_refused(memory.getvalue(), fresh_model(), tmp_path)


@pytest.mark.parametrize("algorithm", [PPO, sb3_contrib.TRPO])
def test_a_model_of_another_algorithm_is_refused_and_the_message_says_what_to_do(algorithm: Any, tmp_path: Path) -> None:
    other = algorithm("MlpPolicy", vec_env(), n_steps=16, batch_size=32, policy_kwargs=SMALL)
    other.save(tmp_path / "other.zip")
    with pytest.raises(ValueError, match=r"other\.zip was saved by another algorithm than TRPOGAE.*set_parameters"):
        TRPOGAE.load(tmp_path / "other.zip")
    fresh_model().set_parameters(tmp_path / "other.zip")  # type: ignore[arg-type]


@pytest.mark.parametrize("kind", [str, Path])
def test_a_missing_file_is_a_file_not_found_error(kind: type, tmp_path: Path) -> None:
    missing = kind(tmp_path / "nothing")
    with pytest.raises(FileNotFoundError):
        TRPOGAE.load(missing)
    model = fresh_model()
    before = state_of(model.policy)
    with pytest.raises(FileNotFoundError):
        model.set_parameters(missing)  # type: ignore[arg-type]
    assert differing(before, state_of(model.policy)) == []


def test_foreign_arguments_are_not_kept() -> None:
    with pytest.warns(UserWarning):
        model = fresh_model(n_epochs=3)
    assert "n_epochs" in FOREIGN_ARGUMENTS and not hasattr(model, "n_epochs")
