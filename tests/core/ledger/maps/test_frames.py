"""Pictures and keypoints: they are those of the frame in their row, and damaged ones are not given out."""

from __future__ import annotations

import hashlib
import logging
from dataclasses import replace

import pytest
from sqlalchemy import bindparam, delete, update

from core.errors import StorageFailure
from core.ledger import Statement
from core.ledger.maps import frames
from core.ledger.maps.schema import KEYPOINTS, PICTURES, PLACES
from tests.core.ledger.maps.memory import MemoryMap
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
def two(lab: MemoryMap) -> MemoryMap:
    lab.enrol([frame("a"), frame("b"), replace(frame("bare"), keypoints=None)])
    return lab


def test_they_go_with_the_frame(two: MemoryMap) -> None:
    a, b = keypoints_of("a").record(), keypoints_of("b").record()
    with two._reading() as connection:
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
    with two._reading() as connection:
        assert frames.records_at(connection, range(9)) == {3: keypoints_of("other").record()}
        assert frames.pictures_at(connection, range(9)) == {2: b"thumbnail of bare", 3: b"thumbnail of other"}
        assert frames.rows_of_no_place(connection) == []


def test_those_of_no_place_are_found(two: MemoryMap) -> None:
    gone = Statement(delete(PLACES).where(PLACES.c.map == bindparam("map"), PLACES.c.id == "a"))
    with two._reading() as connection:
        connection.change(gone)
        assert frames.rows_of_no_place(connection) == [0]
        frames.delete_frames(connection, [0])
        assert frames.rows_of_no_place(connection) == []


def flipped(record: bytes) -> bytes:
    return bytes([record[0] ^ 1]) + record[1:]


@pytest.mark.parametrize(
    "damage", ["a bit of the record", "a shorter record", "no record", "the checksum", "another's"]
)
def test_damaged_keypoints_are_not_given_out(two: MemoryMap, damage: str, caplog: pytest.LogCaptureFixture) -> None:
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
    with two._reading() as connection:
        assert frames.damaged_keypoints(connection) == []
        assert connection.change(PUT, which=0, changed=changed, sum=of) == 1
        assert frames.damaged_keypoints(connection) == ["a"] and frames.damaged_keypoints_at(connection, [0, 1]) == {0}
        with caplog.at_level(logging.ERROR):
            assert list(frames.keypoints_at(connection, [0, 1])) == [1]
        assert "stored keypoints of place 'a'" in caplog.text
        assert not frames.has_keypoints(connection, 0) and frames.has_keypoints(connection, 1)
        with pytest.raises(StorageFailure, match="place 'a' do not match their checksum"):
            frames.records_at(connection, [0])
        assert [place.id for place in frames.without_keypoints(connection, 0, 9)] == ["a", "bare"]
    two.enrol([frame("a")])
    with two._reading() as connection:
        assert frames.records_at(connection, [0]) == {0: record}


def test_keypoints_in_the_row_of_another_frame_are_damaged(two: MemoryMap) -> None:
    with two._reading() as connection:
        for row, other in ((0, 77), (1, 0), (77, 1)):
            connection.change(SWAP, which=row, other=other)
        assert frames.damaged_keypoints(connection) == ["a", "b"]


def test_a_damaged_picture_is_not_given_out(two: MemoryMap) -> None:
    with two._reading() as connection:
        assert connection.change(PUT_PICTURE, which=0, changed=b"thumbnail of b") == 1
        with pytest.raises(StorageFailure, match="damaged"):
            frames.pictures_at(connection, [0, 1])
        damaged: set[int] = set()
        assert frames.pictures_at(connection, [0, 1], damaged) == {1: b"thumbnail of b"} and damaged == {0}
        digest = hashlib.sha256(b"thumbnail of a").digest()
        assert frames.stored_pictures_at(connection, [0]) == {0: (b"thumbnail of b", digest)}
    for read in (two.picture, two.thumbnail):
        with pytest.raises(StorageFailure, match="The stored picture of place 'a' is damaged"):
            read("a")
