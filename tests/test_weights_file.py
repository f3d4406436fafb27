"""Weights and settings travel without pickle, and no file of a stranger does anything but fit or be refused."""

import base64
import io
import json
import pickle
import struct
import zipfile
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from envs_for_tests import CHANNEL_FIRST, SMALL, VECTOR, AnySpacesEnv, differing, state_of, train_once, vec_env
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st
from stable_baselines3 import A2C, PPO

from sb3_gae import TRPOGAE, MlpPolicy
from sb3_gae.saving.weights_file import _FORMAT, _digest, read_weights, weights_content


def trained(**kwargs: Any) -> TRPOGAE:
    model = TRPOGAE("MlpPolicy", vec_env(), **({"n_steps": 16, "policy_kwargs": SMALL, "seed": 0} | kwargs))
    train_once(model)
    return model


@pytest.fixture(scope="module")
def model() -> TRPOGAE:
    return trained()


@pytest.fixture(scope="module")
def content(model: TRPOGAE, tmp_path_factory: pytest.TempPathFactory) -> bytes:
    path = tmp_path_factory.mktemp("weights") / "model.safetensors"
    model.save_weights(path)
    return path.read_bytes()


@pytest.fixture(scope="module")
def archive(model: TRPOGAE) -> bytes:
    memory = io.BytesIO()
    model.save(memory)
    return memory.getvalue()


def load(content: bytes, folder: Path, **kwargs: Any) -> TRPOGAE:
    (folder / "file").write_bytes(content)
    return TRPOGAE.load_weights(folder / "file", vec_env(), **kwargs)


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


# Strangers


def resealed(content: bytes, **changes: Any) -> bytes:
    """With other settings and a right checksum, as somebody could write it."""
    file = read_weights(content)
    return weights_content(file.tensors, file.settings | changes)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"gamma": 2.0}, "`gamma` must be"),
        ({"n_steps": -1}, "`n_steps` must be"),
        ({"n_steps": 10**15}, r"The settings in \S+ make no model"),
        ({"vf_optimizer": "adam", "learning_rate": "fast"}, "`learning_rate` must be a number"),
        ({"vf_optimizer": "adam", "learning_rate": -1.0}, "`learning_rate` must be a number"),
        ({"vf_optimizer": "os.system"}, "`vf_optimizer` must be"),
        ({"gae_lambda": "auto"}, "`gae_lambda` in the file must be a number"),
        ({"policy": "subprocess.Popen"}, "`policy` must be one of"),
        ({"policy_kwargs": ["net_arch"]}, "must be a dictionary"),
        ({"policy_kwargs": {"net_arch": [10**9, 10**9]}}, "more weights than there are"),
        ({"policy_kwargs": {"net_arch": ["os"]}}, "cannot be kept without pickle"),
        ({"policy_kwargs": {"features_extractor_class": "os.system"}}, "cannot be kept without pickle"),
        ({"policy_kwargs": {"activation_fn": "os.system"}}, "`activation_fn` must be one of"),
        ({"policy_kwargs": {"net_arch": [7]}}, "do not fit"),
    ],
)
def test_settings_of_a_stranger_are_checked(changes: Any, message: str, content: bytes, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=message):
        load(resealed(content, **changes), tmp_path)


def test_unknown_settings_have_no_effect(content: bytes, tmp_path: Path) -> None:
    loaded = load(resealed(content, __class__="os", env="other", device="cuda:7", seed=5), tmp_path)
    assert loaded.seed is None and loaded.device.type == "cpu"


def test_another_environment_is_refused(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(content)
    with pytest.raises(ValueError, match="do not fit `env`"):
        TRPOGAE.load_weights(tmp_path / "file", gym.make("CartPole-v1"))


class Bomb:
    """Writes down that it went off."""

    def __init__(self, path: str):
        self.path = path

    def __reduce__(self) -> Any:
        return exec, (f"open({self.path!r}, 'w').write('executed')",)


def test_what_a_file_of_save_could_execute_is_not(archive: bytes, tmp_path: Path) -> None:
    """In the attributes, where SB3's own ``load`` does execute it, and among the tensors."""
    mark = tmp_path / "mark"
    for where in ("data", "policy.pth"):
        memory = io.BytesIO()
        with zipfile.ZipFile(io.BytesIO(archive)) as good, zipfile.ZipFile(memory, "w") as bad:
            for member in good.namelist():
                found = good.read(member)
                if member == where == "data":
                    pickled = base64.b64encode(pickle.dumps(Bomb(str(mark)))).decode()
                    found = json.dumps(json.loads(found) | {"extra": {":type:": "x", ":serialized:": pickled}}).encode()
                elif member == where:
                    tensors = io.BytesIO()
                    th.save({"weight": Bomb(str(mark))}, tensors)
                    found = tensors.getvalue()
                bad.writestr(member, found)
        if where == "data":
            load(memory.getvalue(), tmp_path)
            assert not mark.exists()
            TRPOGAE.load(io.BytesIO(memory.getvalue()))
            assert mark.exists(), "this is what the documentation warns of"
            mark.unlink()
        else:
            with pytest.raises(ValueError, match="damaged, or holds no weights"):
                load(memory.getvalue(), tmp_path)
            assert not mark.exists()


def test_an_archive_that_would_fill_the_memory_is_refused(archive: bytes, tmp_path: Path) -> None:
    memory = io.BytesIO()
    with zipfile.ZipFile(memory, "w", zipfile.ZIP_DEFLATED) as bad:
        bad.writestr("data", b" " * 2**24)
    with pytest.raises(ValueError, match="compressed suspiciously well"):
        load(memory.getvalue(), tmp_path)


# Fuzz


def check_refused_or_the_same(damaged: bytes, expected: Any) -> None:
    try:
        found = read_weights(damaged)
    except ValueError:
        return
    assert found.tensors.keys() == expected.tensors.keys()
    assert all(th.equal(found.tensors[name], tensor) for name, tensor in expected.tensors.items())
    assert found.settings == expected.settings


mutations = st.lists(st.tuples(st.floats(0.0, 1.0), st.integers(1, 255)), min_size=1, max_size=5)


def mutated(content: bytes, changes: list[tuple[float, int]]) -> bytes:
    changed = bytearray(content)
    for part, mask in changes:
        changed[int(part * (len(content) - 1))] ^= mask
    return bytes(changed)


@given(mutations)
def test_a_mutated_file_is_refused_or_is_the_same(content: bytes, changes: list[tuple[float, int]]) -> None:
    check_refused_or_the_same(mutated(content, changes), read_weights(content))


@given(mutations)
def test_a_mutated_header_is_refused_or_is_the_same(content: bytes, changes: list[tuple[float, int]]) -> None:
    length = struct.unpack("<Q", content[:8])[0]
    header = mutated(content[: 8 + length], changes)
    check_refused_or_the_same(header + content[8 + length :], read_weights(content))


@given(mutations)
def test_a_mutated_archive_is_refused_or_is_the_same(archive: bytes, changes: list[tuple[float, int]]) -> None:
    expected = read_weights(archive)
    try:
        found = read_weights(mutated(archive, changes))
    except ValueError:
        return
    assert all(th.equal(found.tensors[name], tensor) for name, tensor in expected.tensors.items())


@given(mutations, st.sampled_from(["data", "policy.pth"]))
def test_a_mutated_member_under_a_right_checksum_is_refused_or_read(
    archive: bytes, changes: list[tuple[float, int]], which: str
) -> None:
    """Behind the checksum of the archive, where a stranger would work: at the pickle that torch reads."""
    memory = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(archive)) as good, zipfile.ZipFile(memory, "w") as bad:
        for member in good.namelist():
            found = good.read(member)
            bad.writestr(member, _mutated_pickle(found, changes) if member == which else found)
    try:
        read_weights(memory.getvalue())
    except ValueError:
        return


def _mutated_pickle(member: bytes, changes: list[tuple[float, int]]) -> bytes:
    """torch's file is an archive in its turn; its pickle is what is interesting."""
    if member[:2] != b"PK":
        return mutated(member, changes)
    memory = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(member)) as good, zipfile.ZipFile(memory, "w") as bad:
        for name in good.namelist():
            found = good.read(name)
            bad.writestr(name, mutated(found, changes) if name.endswith("data.pkl") else found)
    return memory.getvalue()


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=5,
)


@given(
    st.sampled_from(["n_episodes", "gamma", "policy", "policy_kwargs", "vf_optimizer", "vf_steps", "use_sde", "value_lambda"]),
    json_values,
)
def test_any_setting_is_refused_or_makes_a_model(
    content: bytes, tmp_path_factory: pytest.TempPathFactory, name: str, value: Any
) -> None:
    try:
        loaded = load(resealed(content, **{name: value}), tmp_path_factory.getbasetemp())
    except ValueError:
        return
    assert isinstance(loaded.policy, MlpPolicy)


@given(st.binary(max_size=200), st.booleans())
def test_noise_is_refused(noise: bytes, as_archive: bool) -> None:
    with pytest.raises(ValueError):
        read_weights((b"PK\x03\x04" if as_archive else b"") + noise)


def test_a_deeply_nested_header_is_refused() -> None:
    header = b"[" * 100_000
    with pytest.raises(ValueError, match="damaged"):
        read_weights(struct.pack("<Q", len(header)) + header)


@pytest.mark.parametrize(
    "entry",
    [
        {"dtype": "F32", "shape": [2], "data_offsets": [0, 4]},
        {"dtype": "F32", "shape": [-1, -1], "data_offsets": [0, 4]},
        {"dtype": "F32", "shape": [1], "data_offsets": [-4, 0]},
        {"dtype": "F32", "shape": [1000], "data_offsets": [0, 4000]},
        {"dtype": "object", "shape": [1], "data_offsets": [0, 8]},
        {"dtype": "F32", "shape": [True], "data_offsets": [0, 4]},
        {"dtype": "F32", "shape": "1", "data_offsets": [0, 4]},
        {"dtype": "F32"},
        [],
    ],
)
def test_a_tensor_that_is_not_where_the_header_says_is_refused(entry: Any) -> None:
    data, settings = bytes(8), "{}"
    metadata = {"format": _FORMAT, "settings": settings, "sha256": _digest({"weight": entry}, settings, data)}
    header = json.dumps({"__metadata__": metadata, "weight": entry}).encode()
    with pytest.raises(ValueError, match="damaged"):
        read_weights(struct.pack("<Q", len(header)) + header + data)


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
