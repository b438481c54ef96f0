"""Stations of places, which go with their places to other maps."""

from __future__ import annotations

from datetime import UTC, datetime

import numpy as np
import pytest

from core.maps import Correspondence, History, MapSettings
from core.places import Neighborhood
from core.store import Map, Store
from tests.core.store.conftest import OpenStore, on_both
from tests.core.store.frames import DIMENSION, ENCODER, LOCAL_SHAPE, frame

pytestmark = on_both


def row(map_: Map, place_id: str) -> int:
    (found,) = map_.rows_of([place_id])
    assert found is not None
    return found


def code(map_: Map, sequence: str) -> int:
    where = map_.snapshot().whereabouts
    return int(next(where.sequence[row(map_, p.id)] for p in map_.places(None, 100)[0] if p.sequence == sequence))


def same_place(map_: Map, place_id: str) -> str:
    """The ids of the places at the same station or beside it."""
    snapshot = map_.snapshot()
    near = np.flatnonzero(snapshot.whereabouts.near(row(map_, place_id), Neighborhood(0, 1)) & snapshot.alive)
    return " ".join(sorted(place.id for place in map_.places_at(near.tolist()) if place is not None))


@pytest.fixture
def aligned(lab: Map) -> Map:
    """Of traverse b the frames show what a2 to a4 show, and so does the second of c.  x and y met on a lost track."""
    for name in "abc":
        lab.enrol([frame(f"{name}{i}", sequence=name) for i in range(6 if name == "a" else 3)])
    lab.enrol([frame("gone", sequence="lost"), frame("x", sequence="x"), frame("y")])
    track, lost = code(lab, "a"), code(lab, "lost")
    stations = {row(lab, f"b{i}"): (track, 2 + i) for i in range(3)} | {row(lab, "c1"): (track, 3)}
    lab.counterparts.store(Correspondence(stations | {row(lab, "x"): (lost, 7), row(lab, "y"): (lost, 8)}))
    lab.forget_sequence("lost")
    return lab


EXPECTED = {
    "a2": "a1 a2 a3 b0 b1 c1",
    "b0": "a1 a2 a3 b0 b1 c1",
    "c1": "a2 a3 a4 b0 b1 b2 c0 c1 c2",
    "x": "x y",
    "y": "x y",
}


def test_places_at_one_station_are_the_same_also_after_a_restart(
    open_store: OpenStore, store: Store, aligned: Map
) -> None:
    assert {name: same_place(aligned, name) for name in EXPECTED} == EXPECTED
    assert aligned.verify().ok
    store.close()
    again = open_store().get("lab")
    assert {name: same_place(again, name) for name in EXPECTED} == EXPECTED


@pytest.fixture
def hall(store: Store) -> Map:
    return store.create("hall", ENCODER, DIMENSION, MapSettings(), local_shape=LOCAL_SHAPE)


def copy(source: Map, target: Map, without: str = "", prefix: str = "") -> None:
    """Copy the places of a map, but for some, to another, where they get other ids."""
    places = [place for place in source.transfer.outline() if place.id not in without.split()]
    names = {place.id: prefix + place.id for place in places}
    target.transfer.adopt([
        (
            frame(names[place.id], place.id, sequence=place.sequence),
            History("none", place.ordinal, datetime.now(UTC), datetime.now(UTC)),
        )
        for place in places
    ])  # fmt: skip
    target.counterparts.copy(source.counterparts, names)


@pytest.mark.parametrize(
    ("without", "prefix", "expected"),
    [
        ("", "", EXPECTED),
        ("", "h.", {f"h.{name}": " ".join(f"h.{one}" for one in same.split()) for name, same in EXPECTED.items()}),
        ("a3", "", {"b0": "a1 a2 b0 b1 c1", "c1": "a2 a4 b0 b1 b2 c0 c1 c2"}),
        ("a0 a1 a2 a3 a4 a5", "", {"b0": "b0 b1 c1", "c0": "c0 c1", "x": "x y"}),
        ("x", "", {"y": "y"}),
    ],
    ids=["all", "renamed", "a frame of the track less", "no frame of the track", "nothing else on a lost track"],
)
def test_copies_are_at_the_same_stations(
    aligned: Map, hall: Map, without: str, prefix: str, expected: dict[str, str]
) -> None:
    if without == "a3":
        aligned.forget("a3")
    hall.enrol([frame("before", sequence="elsewhere")])
    copy(aligned, hall, without, prefix)
    assert {name: same_place(hall, name) for name in expected} == expected
    for map_ in (hall, aligned):
        assert map_.verify().ok
    again = hall.snapshot().whereabouts
    copy(aligned, hall, without, prefix)
    assert {name: same_place(hall, name) for name in expected} == expected, "a copy that is made again changes nothing"
    assert len(again) == len(hall.snapshot().whereabouts)


def test_a_track_that_is_here_already_is_found_by_its_frames(aligned: Map, hall: Map) -> None:
    hall.enrol([frame(f"z{i}", sequence="walk") for i in range(4)])
    hall.enrol([frame(f"a{i}", sequence="walk") for i in range(6)])
    hall.enrol([frame("a2", "another picture", sequence="walk")])
    copy(aligned, hall, without="a0 a1 a2 a3 a4 a5")
    assert same_place(hall, "b1") == "a2 a3 a4 b0 b1 b2 c1", "by the frames beside that which differs"


def test_a_pose_that_was_handed_over_says_from_whom(lab: Map, hall: Map) -> None:
    lab.enrol([frame("a", x=1.0, sequence="a"), frame("b", sequence="b"), frame("c", sequence="c")])
    lab.counterparts.store(Correspondence(poses={row(lab, "b"): row(lab, "a"), row(lab, "c"): row(lab, "a")}))
    for name in ("p.a", "p.b"):
        hall.enrol([frame(name, name[2:], x=1.0)])
    hall.counterparts.copy(lab.counterparts, {"a": "p.a", "b": "p.b"})
    assert [hall.place(name).pose_of for name in ("p.a", "p.b")] == [None, "p.a"]
    lab.forget("a")
    hall.enrol([frame("c", x=1.0)])
    hall.counterparts.copy(lab.counterparts, {"c": "c"})
    assert lab.place("c").pose_of == "a" and hall.place("c").pose_of is None
    assert lab.verify().ok and hall.verify().ok


def test_another_frame_is_at_its_own_station(aligned: Map) -> None:
    aligned.enrol([frame("b0", "other", sequence="b")])
    assert same_place(aligned, "b0") == "b0 b1" and aligned.verify().ok
