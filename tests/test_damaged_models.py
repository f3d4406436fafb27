"""A file that is damaged, foreign or missing is refused and changes nothing."""

import io
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sb3_contrib
from envs_for_tests import SMALL, differing, state_of, vec_env
from saved_models import check_same, fresh_model
from stable_baselines3 import PPO

from sb3_gae import TRPOGAE


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
def test_a_truncated_file_is_refused(tenths: int, model_file: bytes, tmp_path: Path) -> None:
    check_refused(model_file[: len(model_file) * tenths // 10], fresh_model(), tmp_path)


def test_a_file_that_lacks_its_last_byte_is_refused(model_file: bytes, tmp_path: Path) -> None:
    check_refused(model_file[:-1], fresh_model(), tmp_path)


@pytest.mark.parametrize("member", ["data", "policy.pth", "policy.optimizer.pth", "pytorch_variables.pth", "system_info.txt"])
@pytest.mark.parametrize("part", [0.0, 0.25, 0.5, 0.75, 1.0])
def test_a_flipped_byte_in_any_member_is_refused(part: float, member: str, model_file: bytes, tmp_path: Path) -> None:
    info = zipfile.ZipFile(io.BytesIO(model_file)).getinfo(member)
    start = info.header_offset + 30 + int.from_bytes(model_file[info.header_offset + 26 : info.header_offset + 28], "little")
    start += int.from_bytes(model_file[info.header_offset + 28 : info.header_offset + 30], "little")
    check_refused(flipped(model_file, start + int(part * (info.compress_size - 1))), fresh_model(), tmp_path)


def test_a_flipped_weight_is_refused(model_file: bytes, some_model: TRPOGAE, tmp_path: Path) -> None:
    """Also where only the numbers change and the file reads well in every other respect."""
    weights = some_model.policy.action_net.weight.detach().numpy().tobytes()
    assert model_file.count(weights) == 1
    check_refused(flipped(model_file, model_file.index(weights) + 5), fresh_model(), tmp_path)


def flipped(content: bytes, position: int) -> bytes:
    return content[:position] + bytes([content[position] ^ 0xFF]) + content[position + 1 :]


def test_a_flipped_byte_anywhere_is_refused_or_changes_nothing(model_file: bytes, some_model: TRPOGAE) -> None:
    """Some bytes of an archive mean nothing to a reader, such as dates."""
    refused = 0
    for position in np.linspace(0, len(model_file) - 1, 60, dtype=int):
        try:
            loaded = TRPOGAE.load(io.BytesIO(flipped(model_file, position)))
        except ValueError:
            refused += 1
        else:
            check_same(loaded, some_model)
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
def test_an_archive_that_looks_like_a_model_is_refused(data: str, model_file: bytes, tmp_path: Path) -> None:
    memory = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(model_file)) as good, zipfile.ZipFile(memory, "w") as archive:
        for member in good.namelist():
            archive.writestr(member, data if member == "data" else good.read(member))
    check_refused(memory.getvalue(), fresh_model(), tmp_path)


@pytest.mark.parametrize("missing", ["data", "policy.pth", "policy.optimizer.pth"])
def test_an_archive_that_lacks_a_member_is_refused(missing: str, model_file: bytes, tmp_path: Path) -> None:
    memory = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(model_file)) as good, zipfile.ZipFile(memory, "w") as archive:
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
