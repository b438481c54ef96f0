"""A map has one kind of coordinates, metres or degrees, in either database."""

from __future__ import annotations

import pytest

from core.errors import MixedCoordinates
from core.maps import SameFrame
from core.places import PlaceFields, Pose
from core.store import Map, Store
from tests.core.ledger.maps.conftest import content
from tests.core.maps.mixed import POSES, both_kinds, posed
from tests.core.store.frames import DIMENSION, ENCODER, LOCAL_SHAPE, digest_of, frame

METRES, DEGREES = POSES


@pytest.mark.parametrize(("first", "second"), [(METRES, DEGREES), (DEGREES, METRES)], ids=["degrees", "metres"])
def test_the_other_kind_is_refused_however_it_comes(lab: Map, first: Pose, second: Pose) -> None:
    lab.enrol([posed("p0", first), posed("p1", None), posed("p2", first)])
    before = content(lab)
    for write in (
        lambda: lab.enrol([posed("new", second)]),
        lambda: lab.enrol([posed("fine", first), posed("new", second)]),
        lambda: lab.enrol([posed("p1", second)]),
        lambda: lab.enrol([posed("p0", second, "another picture")]),
        lambda: lab.enrol([SameFrame("p1", PlaceFields(pose=second), digest_of("p1"))]),
        lambda: lab.set_fields("p1", PlaceFields(pose=second)),
        lambda: lab.patch("p1", {"pose": second.model_dump(exclude_none=True)}),
    ):
        with pytest.raises(MixedCoordinates, match=r"metric coordinates \(x and y.* geographic|geographic.* metric"):
            write()
        assert content(lab) == before


def test_an_item_of_the_other_kind_fails_alone_where_that_is_wanted(lab: Map) -> None:
    rejected: list[int] = []
    items = [posed("p0", METRES), posed("p1", DEGREES), posed("p2", None), posed("p3", METRES), posed("p4", DEGREES)]
    found = lab.enrol(items, lambda position, error: rejected.append(position))
    assert rejected == [1, 4] and [one is None for one in found] == [False, True, False, False, True]
    assert [place.id for place in lab.places(None, 9)[0]] == ["p0", "p2", "p3"]


def test_a_place_may_change_its_kind_where_no_other_has_a_pose(lab: Map) -> None:
    lab.enrol([posed("p0", METRES), posed("p1", None)])
    lab.enrol([posed("p0", METRES), posed("p0", DEGREES), posed("p1", DEGREES)])
    with pytest.raises(MixedCoordinates):
        lab.enrol([posed("p0", METRES)])
    lab.forget("p1")
    lab.set_fields("p0", PlaceFields(pose=METRES))
    lab.forget("p0")
    lab.enrol([posed("p0", DEGREES)])


def test_what_changes_within_a_write_counts(lab: Map) -> None:
    lab.enrol([posed("p0", METRES)])
    with pytest.raises(MixedCoordinates):
        lab.enrol([posed("p0", METRES), posed("p0", DEGREES), posed("p2", METRES)])


def test_a_map_of_old_that_has_both_kinds_takes_both(lab: Map) -> None:
    with both_kinds():
        lab.enrol([posed("p0", METRES), posed("p1", DEGREES)])
    lab.enrol([posed("p2", METRES), posed("p3", DEGREES)])
    lab.patch("p2", {"pose": {"x": 7}})
    assert {place.id: place.pose and place.pose.kind() for place in lab.places(None, 9)[0]} == {
        "p0": "metric", "p1": "geographic", "p2": "metric", "p3": "geographic",
    }  # fmt: skip


def test_maps_without_poses_and_other_maps_do_not_count(store: Store, lab: Map) -> None:
    store.create("yard", ENCODER, DIMENSION, local_shape=LOCAL_SHAPE).enrol([posed("p0", DEGREES)])
    lab.enrol([frame("p0"), posed("p1", METRES)])
