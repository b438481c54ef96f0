"""Pictures and keypoints: they are those of the frame in their row, and damaged ones are not given out."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable, Sequence
from dataclasses import replace

import pytest
from sqlalchemy import bindparam, delete, update

from core.errors import StorageFailure
from core.geometry.keypoints import Keypoints
from core.ledger import Statement
from core.ledger.maps import frames, rows
from core.ledger.maps.schema import KEYPOINTS, PICTURES, PLACES
from core.maps import Enrolment, SameFrame
from core.places import PlaceFields
from core.store import Map
from tests.core.store.frames import frame, keypoints_of

_K, _P = KEYPOINTS.c, PICTURES.c
PUT = Statement(
    update(KEYPOINTS)
    .where(_K.map == bindparam("map"), _K.row == bindparam("which"))
    .values(record=bindparam("changed"), checksum=bindparam("sum"))
)
PUT_PICTURE = Statement(
    update(PICTURES).where(_P.map == bindparam("map"), _P.row == bindparam("which")).values(bytes=bindparam("changed"))
)
SWAP = Statement(
    update(KEYPOINTS).where(_K.map == bindparam("map"), _K.row == bindparam("which")).values(row=bindparam("other"))
)


@pytest.fixture
def two(lab: Map) -> Map:
    lab.enrol([frame("a"), frame("b"), replace(frame("bare"), keypoints=None)])
    return lab


@pytest.mark.usefixtures("at_once")
def test_they_go_with_the_frame(two: Map) -> None:
    a, b = keypoints_of("a").record(), keypoints_of("b").record()
    with two._transaction() as connection:
        pictures = sum(len(f"thumbnail of {name}") for name in ("a", "b", "bare"))
        assert frames.room(connection) == (2, len(a) + len(b), pictures)
        assert frames.records_at(connection, [1, 0, 2, 7]) == {0: a, 1: b}
        sizes, records = frames.sizes_at(connection, [0, 2])
        assert sizes == {
            0: (14, hashlib.sha256(b"thumbnail of a").digest()), 2: (17, hashlib.sha256(b"thumbnail of bare").digest()),
        } and records == {0: len(a)}  # fmt: skip
        assert [place.id for place in frames.without_keypoints(connection, 0, 9)] == ["bare"]
    two.enrol([frame("a", "other")])
    two.forget("b")
    with two._transaction() as connection:
        assert frames.records_at(connection, range(9)) == {3: keypoints_of("other").record()}
        assert frames.pictures_at(connection, range(9)) == {2: b"thumbnail of bare", 3: b"thumbnail of other"}
        assert rows.of_no_place(connection) == []


def test_those_of_no_place_are_found(two: Map) -> None:
    gone = Statement(delete(PLACES).where(PLACES.c.map == bindparam("map"), PLACES.c.id == "a"))
    with two._transaction() as connection:
        connection.change(gone)
        assert rows.of_no_place(connection) == [0]
        rows.leave(connection, 0, 1)  # as a write does, so that they are deleted later
        assert rows.of_no_place(connection) == []


def flipped(record: bytes) -> bytes:
    return bytes([record[0] ^ 1]) + record[1:]


@pytest.mark.parametrize(
    "damage", ["a bit of the record", "a shorter record", "no record", "the checksum", "another's"]
)
def test_damaged_keypoints_are_not_given_out(two: Map, damage: str, caplog: pytest.LogCaptureFixture) -> None:
    record, digest = keypoints_of("a").record(), frame("a").digest
    checksum = frames.checksum_of(record, digest)
    other = keypoints_of("b").record()
    changed, of = {
        "a bit of the record": (flipped(record), checksum),
        "a shorter record": (record[:30], checksum),
        "no record": (b"", checksum),
        "the checksum": (record, checksum ^ 1),
        "another's": (other, frames.checksum_of(other, frame("b").digest)),
    }[damage]
    with two._transaction() as connection:
        assert connection.change(PUT, which=0, changed=changed, sum=of) == 1
        assert frames.damaged_keypoints_at(connection, [0, 1]) == {0}
        with caplog.at_level(logging.ERROR):
            assert list(frames.keypoints_at(connection, [0, 1])) == [1]
        assert "stored keypoints of place 'a'" in caplog.text
        assert not frames.has_keypoints(connection, 0) and frames.has_keypoints(connection, 1)
        with pytest.raises(StorageFailure, match="place 'a' do not match their checksum"):
            frames.records_at(connection, [0])
        assert [place.id for place in frames.without_keypoints(connection, 0, 9)] == ["a", "bare"]
    report = two.verify()
    assert not report.ok and any("place 'a' has keypoints that do not match" in one for one in report.problems)
    two.enrol([frame("a")])
    with two._transaction() as connection:
        assert frames.records_at(connection, [0]) == {0: record}
    assert two.verify().ok


def test_keypoints_in_the_row_of_another_frame_are_damaged(two: Map) -> None:
    with two._transaction() as connection:
        for row, other in ((0, 77), (1, 0), (77, 1)):
            connection.change(SWAP, which=row, other=other)
        assert frames.damaged_keypoints_at(connection, [0, 1]) == {0, 1}


def test_a_damaged_picture_is_not_given_out(two: Map) -> None:
    with two._transaction() as connection:
        assert connection.change(PUT_PICTURE, which=0, changed=b"thumbnail of b") == 1
        with pytest.raises(StorageFailure, match="damaged"):
            frames.pictures_at(connection, [0, 1])
        damaged: set[int] = set()
        assert frames.pictures_at(connection, [0, 1], damaged) == {1: b"thumbnail of b"} and damaged == {0}
    for read in (two.picture, two.thumbnail):
        with pytest.raises(StorageFailure, match="The stored picture of place 'a' is damaged"):
            read("a")


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


def test_they_are_read_in_the_order_of_the_rows(lab: Map) -> None:
    lab.enrol([frame("a"), bare("b"), frame("c")])
    for _ in range(2):  # from the database, and from the cache
        lab.snapshot()
        found = lab.keypoints_at([2, 1, 0, 7])
        expected = [keypoints_of("c"), None, keypoints_of("a"), None]
        assert all(same(one, other) for one, other in zip(found, expected, strict=True))


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
@pytest.mark.usefixtures("at_once")
def test_they_are_those_of_the_frame(lab: Map, steps: Sequence[Step], expected: str | None) -> None:
    lab.enrol([frame("a")])
    for step in steps:
        step(lab)
    assert same(kept(lab, "a"), None if expected is None else keypoints_of(expected))
    with lab._transaction() as connection:
        assert frames.room(connection)[0] == (expected is not None)
    assert lab.verify().ok


def test_the_former_row_of_a_frame_has_none(lab: Map) -> None:
    lab.enrol([frame("a")])
    lab.enrol([frame("a", "other")])
    assert lab.keypoints_at([0]) == [None]


@pytest.mark.usefixtures("at_once")
def test_a_sequence_takes_them_with_it_and_the_status_of_a_map_counts_them(lab: Map) -> None:
    lab.enrol([frame(name, sequence="s") for name in "abc"] + [frame("d"), bare("e")])
    sizes = {name: len(keypoints_of(name).record()) for name in "abcd"}
    for count, expected in ((4, sum(sizes.values())), (1, sizes["d"])):
        found = lab.storage_status().keypoints
        assert found is not None and (found.places, found.bytes) == (count, expected)
        if count == 4:
            lab.forget_sequence("s")


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
