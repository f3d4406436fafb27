"""The rooms of the package: imports go one way, and the picture in the docs is true."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "docs"))

from house import COMMANDS, PICTURE, WIDTH, floors, house, places, rooms, without_shortcuts


def test_the_picture_is_that_of_the_imports() -> None:
    assert PICTURE.read_text() == house(), "draw it again: python docs/house.py"


def test_imports_go_one_way_and_mathematics_lies_below_what_uses_it() -> None:
    edges = rooms()
    floor_of = {room: number for number, row in enumerate(floors(edges)) for room in row}
    assert all(floor_of[upper] < floor_of[lower] for upper, lowers in edges.items() for lower in lowers)
    assert floor_of[COMMANDS] == 0
    # Nothing but its own arguments' checks: estimators can be read, and used, by themselves
    assert edges["estimators"] <= {"checks", "errors"}
    assert not edges["update"] & {"trpo_gae", "callbacks", "saving", "workers", "zoo", "sweep"}


def test_arrows_that_follow_from_others_are_left_out() -> None:
    edges = {"door": {"hall", "cellar"}, "hall": {"cellar"}, "cellar": set[str]()}
    assert without_shortcuts(edges) == {"door": {"hall"}, "hall": {"cellar"}, "cellar": set()}
    assert floors(edges) == [["door"], ["hall"], ["cellar"]]


def test_no_arrow_passes_behind_a_box() -> None:
    where = places(without_shortcuts(rooms()))
    boxes = [place for node, place in where.items() if node[1] == ""]
    passages = [place for node, place in where.items() if node[1] != ""]
    assert passages
    assert all(abs(x - across) > WIDTH / 2 for x, y in boxes for across, down in passages if y == down)


def test_a_ring_is_an_error() -> None:
    with pytest.raises(ValueError, match="cycle"):
        floors({"a": {"b"}, "b": {"a"}})
