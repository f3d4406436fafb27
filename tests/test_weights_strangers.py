"""No file of a stranger does anything but fit or be refused."""

import base64
import io
import json
import pickle
import struct
import zipfile
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest
import torch as th
from hypothesis import given
from hypothesis import strategies as st
from weights_files import load, trained, written

from sb3_gae import TRPOGAE, MlpPolicy
from sb3_gae.saving.weights_file import _FORMAT, _digest, read_weights, weights_content


@pytest.fixture(scope="module")
def content() -> bytes:
    return written(trained().save_weights)


@pytest.fixture(scope="module")
def archive() -> bytes:
    return written(trained().save)


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
