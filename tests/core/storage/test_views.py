"""The positions of frames in their sequence, which count views."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import pytest

from core.maps import History, MapSettings
from core.storage import Atlas, Map
from tests.core.storage.frames import DIMENSION, ENCODER, LOCAL_SHAPE, frame


@pytest.fixture
def lab(tmp_path: Path) -> Map:
    return Atlas(tmp_path, rows_per_segment=4).create("lab", ENCODER, DIMENSION, MapSettings(keep="none"), LOCAL_SHAPE)


def ordinals(lab: Map) -> dict[str, int]:
    return {place.id: place.ordinal for place in lab.transfer.outline()}


def enrol(lab: Map, *pictures: str, together: bool = True, sequence: str = "walk") -> None:
    """Enrol places p0, p1 … further; each shows the picture of its letter."""
    begin = lab.count_places()
    items = [frame(f"p{begin + n}", picture, sequence=sequence) for n, picture in enumerate(pictures)]
    for some in [items] if together else [[item] for item in items]:
        lab.enrol(some)


@pytest.mark.parametrize("together", [True, False])
def test_frames_of_one_view_are_at_one_position(lab: Map, together: bool) -> None:
    enrol(lab, *"abbbbbcbd", together=together)
    assert list(ordinals(lab).values()) == [0, 1, 1, 1, 1, 1, 2, 1, 3]
    assert lab.snapshot().whereabouts.ordinal.tolist() == [0, 1, 1, 1, 1, 1, 2, 1, 3]
    assert lab.transfer.sequence_ends()["walk"] == 4


def test_the_same_view_later_in_the_traverse_or_in_another_one_is_apart(lab: Map) -> None:
    enrol(lab, *"abcdefa")
    enrol(lab, *"a", sequence="other")
    assert list(ordinals(lab).values()) == [0, 1, 2, 3, 4, 5, 6, 0]


def test_a_frame_that_is_replaced_by_another_view_leaves_the_others(lab: Map) -> None:
    enrol(lab, *"abbbc")
    lab.enrol([frame("p2", "x", sequence="walk"), frame("p0", "y", sequence="walk")])
    assert ordinals(lab) == {"p0": 0, "p1": 1, "p2": 3, "p3": 1, "p4": 2}


def test_deleted_frames_change_no_position(lab: Map) -> None:
    enrol(lab, *"abbbc")
    lab.forget("p1")
    lab.forget("p4")
    lab.enrol([frame("p5", "b", sequence="walk"), frame("p6", "d", sequence="walk")])
    assert [place.ordinal for place in lab.transfer.outline()] == [0, 1, 1, 1, 3]


def test_a_frame_joins_the_view_of_another_sequence_that_it_moves_to(lab: Map) -> None:
    enrol(lab, *"ab")
    enrol(lab, "b", sequence="other")
    lab.patch("p2", {"sequence": "walk"})
    assert ordinals(lab) == {"p0": 0, "p1": 1, "p2": 1}


def test_a_place_of_another_map_keeps_its_position(lab: Map) -> None:
    now = datetime.now(UTC)
    lab.transfer.adopt([
        (frame(f"p{n}", "b", sequence="walk"), History("none", at, now, now)) for n, at in enumerate([0, 0, 7])
    ])  # fmt: skip
    assert list(ordinals(lab).values()) == [0, 0, 7]
    assert lab.transfer.sequence_ends()["walk"] == 8


def test_without_a_sequence_every_place_is_one_of_its_own(lab: Map) -> None:
    lab.enrol([frame("a", "same"), frame("b", "same")])
    assert sorted(ordinals(lab).values()) == [0, 1]


def test_no_view_is_hidden_where_neighbours_in_time_are_not_the_same_place(lab: Map) -> None:
    lab.edit({"same_place_frames": 0})
    enrol(lab, *"abba")
    assert list(ordinals(lab).values()) == [0, 1, 1, 2]
