"""Infos of a batch, which are made only when they are read."""

import numpy as np
import pytest

from sb3_gae.vec_env import StepInfos


@pytest.fixture
def infos() -> StepInfos:
    return StepInfos(3, {"speed": np.array([1.0, 2.0, 3.0]), "over": np.array([False, True, False])})


def test_infos_read_like_a_list(infos: StepInfos) -> None:
    expected = [{"speed": 1.0, "over": False}, {"speed": 2.0, "over": True}, {"speed": 3.0, "over": False}]
    assert len(infos) == 3
    assert list(infos) == expected
    assert [infos[i] for i in range(-3, 3)] == expected * 2
    assert infos[1:] == expected[1:]
    assert infos[::-1] == expected[::-1]
    assert infos.copy() == expected
    assert list(reversed(infos)) == expected[::-1]
    assert expected[1] in infos
    assert infos.index(expected[2]) == 2
    assert type(infos[0]["speed"]) is float
    assert type(infos[0]["over"]) is bool


@pytest.mark.parametrize("index", [3, -4])
def test_there_are_no_more_infos_than_environments(infos: StepInfos, index: int) -> None:
    with pytest.raises(IndexError):
        infos[index]
    with pytest.raises(IndexError):
        infos[index] = {}


def test_what_is_written_into_infos_is_kept(infos: StepInfos) -> None:
    infos[1]["mark"] = "here"
    infos[-1] = {"new": 1}
    assert infos[1] == {"speed": 2.0, "over": True, "mark": "here"}
    assert infos[2] == {"new": 1}
    assert "mark" not in infos[0]
    assert [info.get("mark") for info in infos] == [None, "here", None]
