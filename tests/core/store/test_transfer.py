"""Copying places from one map to another, and deleting many at once."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest

from core.maps import Enrolment, History, MapSettings
from core.maps.records import MOST_LOOKS
from core.places import PlaceFields, look_address
from core.store import Map, Store
from tests.core.store.conftest import OpenStore, on_both
from tests.core.store.frames import DIMENSION, ENCODER, LOCAL_SHAPE, digest_of, frame

EARLIER = datetime(2026, 1, 2, 3, 4, 5, 678, tzinfo=UTC)
LATER = datetime(2026, 2, 3, tzinfo=UTC)


pytestmark = on_both


@pytest.fixture
def hall(store: Store) -> Map:
    return store.create("hall", ENCODER, DIMENSION, MapSettings(keep="none"), local_shape=LOCAL_SHAPE)


def history(ordinal: int | None = None, picture: str = "none") -> History:
    return History(picture, ordinal, EARLIER, LATER)  # type: ignore[arg-type]


def test_a_place_comes_with_its_history(lab: Map, hall: Map) -> None:
    item = frame("a", x=3.0, sequence="monday", metadata={"n": 1})
    item = Enrolment(item.id, item.fields, item.descriptor, 7, item.digest, item.local, thumbnail=b"small")
    hall.transfer.adopt([(item, history(41, "thumbnail"))])
    place = hall.place("a")
    assert (place.created_at, place.updated_at, place.regions) == (EARLIER, LATER, 7)
    assert place.picture == "thumbnail", "although this map keeps none of its own"
    assert hall.picture("a") == b"small"
    (outline,) = hall.transfer.outline()
    assert (outline.id, outline.sequence, outline.ordinal, outline.digest) == ("a", "monday", 41, item.digest)
    assert hall.snapshot().whereabouts.ordinal.tolist() == [41]
    assert hall.transfer.sequence_ends()["monday"] == 42
    hall.enrol([frame("b", sequence="monday")])
    assert hall.snapshot().whereabouts.ordinal.tolist() == [41, 42], "the next one comes behind"
    assert hall.verify().ok


def test_what_is_searched_is_what_is_stored(open_store: OpenStore, store: Store, hall: Map) -> None:
    items = [(frame(name, x=float(n), sequence="monday"), history(n * 10)) for n, name in enumerate("abcdefg")]
    hall.transfer.adopt(items)
    before = hall.snapshot().whereabouts
    assert before.ordinal.tolist() == [0, 10, 20, 30, 40, 50, 60]
    assert hall.verify().ok
    store.close()
    after = open_store().get("hall").snapshot().whereabouts
    assert np.array_equal(after.ordinal, before.ordinal) and np.array_equal(after.position, before.position)


def test_the_same_frame_again_only_takes_fields_and_history(hall: Map) -> None:
    hall.transfer.adopt([(frame("a", sequence="monday"), history(5))])
    nothing = np.empty(0, np.float32)
    moved = Enrolment("a", PlaceFields(sequence="tuesday"), nothing, 0, digest_of("a"))
    hall.transfer.adopt([(moved, history(9))])
    (place,) = hall.transfer.outline()
    assert (place.row, place.sequence, place.ordinal) == (0, "tuesday", 9)
    assert hall.snapshot().whereabouts.ordinal.tolist() == [9]
    assert hall.verify().ok


def test_a_look_whose_place_cannot_have_it_is_left_out(hall: Map) -> None:
    def look(place_id: str, shown: str) -> Enrolment:
        return replace(frame(place_id, shown), id=look_address(place_id, digest_of(shown).hex()[:16]))

    hall.enrol([frame("full"), *(look("full", f"look {number}") for number in range(MOST_LOOKS))])
    items = [frame("a"), look("a", "a"), look("a", "by night"), look("gone", "by night"), look("full", "by night")]
    refused = hall.transfer.adopt([(item, history()) for item in items])
    assert refused == [items[at].id for at in (1, 3, 4)]
    assert [look.name for look in hall.looks("a")] == [digest_of("by night").hex()[:16]]
    assert hall.transfer.adopt([(item, history()) for item in items]) == refused, "again"
    assert hall.verify().ok


def test_a_new_frame_of_a_place_takes_the_look_that_shows_it(hall: Map) -> None:
    night = look_address("a", digest_of("night").hex()[:16])
    hall.enrol([frame("a"), replace(frame("a", "night"), id=night)])
    hall.enrol([frame("a", "night")])
    assert hall.looks("a") == [] and hall.place("a").looks == 0
    assert hall.verify().ok


def test_all_or_none(hall: Map) -> None:
    bad = Enrolment(
        "b", PlaceFields(metadata={"x": float("nan")}), frame("b").descriptor, 1, digest_of("b"), frame("b").local
    )
    with pytest.raises(Exception, match="JSON"):
        hall.transfer.adopt([(frame("a"), history()), (bad, history())])
    assert hall.transfer.outline() == [] and len(hall.snapshot()) == 0
    assert hall.verify().ok


def test_many_are_forgotten_at_once_but_not_what_changed(lab: Map) -> None:
    lab.enrol([frame(name, sequence="monday") for name in "abcde"])
    listed = {place.id: place.digest for place in lab.transfer.outline()}
    lab.enrol([frame("c", "another picture")])
    lab.forget("d")
    assert lab.transfer.forget(listed) == 3
    assert [place.id for place in lab.transfer.outline()] == ["c"]
    assert lab.transfer.forget({}) == lab.transfer.forget(listed) == 0
    assert len(lab.snapshot()) == 1 and lab.verify().ok


def test_what_a_map_can_tell(lab: Map) -> None:
    keeping = lab.edit({"keep": "image"})
    assert keeping.keep == "image"
    item = frame("a")
    content = b"the very bytes"
    for name, image in (("a", content), ("b", None)):
        lab.enrol([Enrolment(name, item.fields, item.descriptor, 1, item.digest, item.local, image=image)])
    assert lab.transfer.count_without_image() == 1
    assert lab.picture("a") == content and lab.picture("none") is None
    found = lab.transfer.find(["a", "none", "b"])
    assert {name: row for name, (_, row) in found.items()} == {"a": 0, "b": 1}
