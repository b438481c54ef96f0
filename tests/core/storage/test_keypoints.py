"""The keypoints of places: they are kept with the frame, go with it, and are never those of another."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import replace

import pytest

from core.geometry.keypoints import Keypoints
from core.ledger.maps import frames
from core.maps import Enrolment, SameFrame
from core.places import PlaceFields
from core.store import Directory, Map
from core.storage.database.schema import driver_of
from tests.core.storage.conftest import ROWS
from tests.core.store.frames import frame, keypoints_of


def same(found: Keypoints | None, expected: Keypoints | None) -> bool:
    if found is None or expected is None:
        return found is expected
    return found.record() == expected.record()


def kept(map_: Map, place_id: str) -> Keypoints | None:
    (row,) = map_.rows_of([place_id])
    assert row is not None
    return map_.keypoints_at([row])[0]


def bare(place_id: str, picture: str | None = None) -> Enrolment:
    return replace(frame(place_id, picture), keypoints=None)


def records(map_: Map) -> int:
    with map_._reading() as connection:
        return frames.room(connection)[0]


def test_they_are_read_in_the_order_of_the_rows_also_after_a_restart(atlas: Directory, lab: Map) -> None:
    lab.enrol([frame("a"), bare("b"), frame("c")])
    for map_ in (lab, None):
        if map_ is None:
            atlas.close()
            atlas = Directory(atlas._directory, rows_per_segment=ROWS)
            map_ = atlas.get("lab")
        found = map_.keypoints_at([2, 1, 0, 7])
        expected = [keypoints_of("c"), None, keypoints_of("a"), None]
        assert all(same(one, other) for one, other in zip(found, expected, strict=True))
        assert map_.verify().ok
    atlas.close()


Step = Callable[[Map], object]


@pytest.mark.parametrize(
    ("steps", "expected"),
    [
        ([lambda m: m.enrol([frame("a", "other")])], "other"),
        ([lambda m: m.enrol([bare("a", "other")])], None),
        ([lambda m: m.enrol([bare("a")])], "a"),
        ([lambda m: m.enrol([bare("a", "other")]), lambda m: m.enrol([frame("a", "other")])], "other"),
        ([lambda m: m.enrol([replace(frame("a"), keypoints=keypoints_of("else"))])], "a"),
        ([lambda m: m.enrol([SameFrame("a", PlaceFields(metadata={"n": 1}), frame("a").digest)])], "a"),
        ([lambda m: m.patch("a", {"metadata": {"n": 1}, "sequence": "s"})], "a"),
        ([lambda m: m.forget("a"), lambda m: m.enrol([bare("a")])], None),
        ([lambda m: m.edit({"verification": False})], "a"),
        ([lambda m: m.edit({"verification": False}), lambda m: m.enrol([frame("a", "other")])], None),
    ],
    ids=[
        "another frame", "another frame without", "the same frame without", "the same frame again with", "found again",
        "new fields", "patched", "forgotten and enrolled again", "setting off", "setting off and another frame",
    ],
)  # fmt: skip
def test_they_are_those_of_the_frame(lab: Map, steps: Sequence[Step], expected: str | None) -> None:
    lab.enrol([frame("a")])
    for step in steps:
        step(lab)
    assert same(kept(lab, "a"), None if expected is None else keypoints_of(expected))
    assert records(lab) == (expected is not None)
    assert lab.verify().ok


def test_the_former_row_of_a_frame_has_none(lab: Map) -> None:
    lab.enrol([frame("a")])
    lab.enrol([frame("a", "other")])
    assert lab.keypoints_at([0]) == [None]


def test_a_sequence_takes_them_with_it(lab: Map) -> None:
    lab.enrol([frame(name, sequence="s") for name in "abc"])
    lab.forget_sequence("s")
    assert records(lab) == 0


def test_places_without_are_listed_a_page_at_a_time_and_filled_in(lab: Map) -> None:
    lab.enrol([frame("a"), bare("b"), bare("c"), replace(bare("d"), image=None, thumbnail=None), bare("e")])
    first = lab.without_keypoints(0, 2)
    second = lab.without_keypoints(first[-1].number, 2)
    assert [place.id for place in (*first, *second)] == ["b", "c", "e"], "nothing is kept of d"
    assert (first[0].picture, first[0].digest, first[0].camera) == ("thumbnail", bare("b").digest, None)
    lab.forget("c")
    lab.enrol([bare("e", "other")])
    found = [(place, keypoints_of(place.id)) for place in (*first, *second)]
    assert lab.add_keypoints(found) == 1, "c is gone, and e shows another frame"
    assert same(kept(lab, "b"), keypoints_of("b")) and kept(lab, "e") is None
    assert lab.add_keypoints(found) == 0
    assert [place.id for place in lab.without_keypoints(0, 9)] == ["e"]
    lab.edit({"verification": False})
    assert lab.add_keypoints([(lab.without_keypoints(0, 9)[0], keypoints_of("other"))]) == 0


DAMAGES = {
    "a bit of the record": "UPDATE keypoints SET record = CAST(x'ff' || substr(record, 2) AS BLOB)",
    "a shorter record": "UPDATE keypoints SET record = substr(record, 1, 30)",
    "an empty record": "UPDATE keypoints SET record = x''",
    "the checksum": "UPDATE keypoints SET checksum = checksum + 1",
    "the record of another frame": "UPDATE keypoints SET (checksum, record) ="
    " (SELECT checksum, record FROM keypoints WHERE row = 1) WHERE row = 0",
}


@pytest.mark.parametrize("damage", DAMAGES.values(), ids=DAMAGES)
def test_damaged_ones_are_not_used_but_reported_and_found_again(
    lab: Map, damage: str, caplog: pytest.LogCaptureFixture
) -> None:
    lab.enrol([frame("a"), frame("b")])
    with lab._writing() as write:
        driver_of(write.connection).execute(damage.replace("WHERE row = 0", "") + " WHERE row = 0")
    with caplog.at_level(logging.ERROR):
        assert kept(lab, "a") is None
    assert "stored keypoints of place 'a'" in caplog.text
    assert same(kept(lab, "b"), keypoints_of("b"))
    report = lab.verify()
    assert not report.ok and any("the keypoints of place 'a'" in problem for problem in report.problems)
    assert [place.id for place in lab.without_keypoints(0, 9)] == ["a"]
    lab.enrol([frame("a")])
    assert same(kept(lab, "a"), keypoints_of("a")) and lab.verify().ok


def test_those_of_no_place_are_reported(lab: Map) -> None:
    lab.enrol([frame("a"), frame("b")])
    with lab._writing() as write:
        driver_of(write.connection).execute("DELETE FROM places WHERE id = 'b'")
        driver_of(write.connection).execute("DELETE FROM pictures WHERE row = 1")
    assert any("pictures or keypoints of 1 rows belong to no place" in problem for problem in lab.verify().problems)


def test_the_status_of_a_map_counts_them(atlas: Directory, lab: Map) -> None:
    assert lab.storage_status().keypoints is None, "the map was not read from disk"
    lab.enrol([frame("a"), frame("b"), bare("c")])
    size = sum(len(keypoints_of(name).record()) for name in "ab")
    for places, expected in ((2, size), (1, len(keypoints_of("b").record()))):
        found = lab.storage_status().keypoints
        assert found is not None and (found.places, found.bytes) == (places, expected)
        if places == 2:
            lab.forget("a")
