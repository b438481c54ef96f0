"""The positions of frames in their sequence, which count views."""

from __future__ import annotations

import dataclasses
from datetime import UTC, datetime

import numpy as np
import pytest

from core.maps import History
from core.store import Map
from tests.core.store.frames import digest_of, frame


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


def enrol_again(lab: Map, *pictures: str, first: int = 0, together: bool = True) -> None:
    """Enrol places from p0, or another one, on again; each shows the picture of its letter now."""
    items = [frame(f"p{first + n}", picture, sequence="walk") for n, picture in enumerate(pictures)]
    for some in [items] if together else [[item] for item in items]:
        lab.enrol(some)


@pytest.mark.parametrize("together", [True, False])
def test_a_stop_that_is_enrolled_again_in_other_light_stays_one_view(lab: Map, together: bool) -> None:
    enrol(lab, *"abbbbbcd")
    before = ordinals(lab)
    enrol_again(lab, *"ABBBBBCD", together=together)
    assert ordinals(lab) == before
    enrol_again(lab, *"xyyyyyzw", together=together)
    assert ordinals(lab) == before


@pytest.mark.parametrize("which", range(5))
def test_a_single_frame_that_is_replaced_keeps_its_position(lab: Map, which: int) -> None:
    enrol(lab, *"abbbc")
    enrol_again(lab, "x", first=which)
    assert list(ordinals(lab).values()) == [0, 1, 1, 1, 2]


@pytest.mark.parametrize("together", [True, False])
def test_a_stop_in_whose_place_a_walk_is_enrolled_is_several_views(lab: Map, together: bool) -> None:
    enrol(lab, *"abbbbbc")
    enrol_again(lab, *"vvwwx", first=1, together=together)
    assert list(ordinals(lab).values()) == [0, 1, 1, 3, 3, 4, 2]
    enrol_again(lab, *"yyyyy", first=1, together=together)
    assert list(ordinals(lab).values()) == [0, 1, 1, 3, 3, 4, 2], "what has left stays where it is"


def test_a_frame_shows_what_others_beside_it_show_though_one_was_replaced_by_something_else(lab: Map) -> None:
    enrol(lab, *"abbbc")
    enrol_again(lab, "x", first=1)
    lab.enrol([dataclasses.replace(frame("p2", "b", sequence="walk"), digest=digest_of("another file"))])
    assert list(ordinals(lab).values()) == [0, 1, 1, 1, 2]


def test_equal_pictures_that_are_apart_by_pose_are_several_views(lab: Map) -> None:
    doors = [frame(f"p{n}", "door", x=x, sequence="walk") for n, x in enumerate([0.0, 14.0, 400.0, 410.0, 3.0])]
    lab.enrol(doors[:3])
    lab.enrol(doors[3:])
    assert list(ordinals(lab).values()) == [0, 0, 1, 1, 0]


@pytest.mark.parametrize("step", [0.0, 10.0])
def test_the_poses_of_a_stop_may_be_inexact_or_coarse(lab: Map, step: float) -> None:
    random = np.random.default_rng(3)
    xs = 44.8 + random.normal(0, 0.5, 30)
    xs = step * np.rint(xs / step) if step else xs
    lab.enrol([frame(f"p{n}", "b", x=x, sequence="walk") for n, x in enumerate(xs.tolist())])
    assert set(ordinals(lab).values()) == {0} and len(set(xs.tolist())) > 1


def test_a_frame_leaves_its_view_for_another_pose(lab: Map) -> None:
    enrol(lab, *"bbb", "c")
    for n, x in enumerate([0.0, 400.0, 4.0]):
        lab.patch(f"p{n}", {"pose": {"x": x, "y": 0.0}})
    assert list(ordinals(lab).values()) == [0, 2, 0, 1]
    assert lab.snapshot().whereabouts.ordinal.tolist() == [0, 2, 0, 1]
    lab.enrol([frame("p2", "B", x=390.0, sequence="walk")])
    assert list(ordinals(lab).values()) == [0, 2, 3, 1]


def test_a_stop_whose_poses_are_all_moved_stays_one_view(lab: Map) -> None:
    lab.enrol([frame(f"p{n}", "b", x=0.0, sequence="walk") for n in range(4)])
    for n in range(4):
        lab.patch(f"p{n}", {"pose": {"x": 5000.0, "y": 1.0}})
    assert set(ordinals(lab).values()) == {0}


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
