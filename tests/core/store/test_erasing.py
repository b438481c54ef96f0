"""What deleted places leave, by a search of the bytes of the whole data directory."""

from __future__ import annotations

import random
import threading
from hashlib import sha256
from pathlib import Path

import numpy as np
import pytest
from core.storage.files import segment_files
from core.storage.files.segment_files import ERASING, HEADER_BYTES
from core.storage.opening import open_map

from core.disk.files import write_at
from core.errors import MapBusy
from core.maps import MapSettings, PlaceFilter, ReviewSetting
from core.maps.forms import pack_descriptors, pack_local
from core.maps.records import Enrolment
from core.store import Directory, Map, erasing
from tests.core.storage.search.test_tier_memory import become
from tests.core.store.frames import DIMENSION, ENCODER, LOCAL_SHAPE, frame, keypoints_of

SETTING = ReviewSetting(most_frames=100, most_bytes=1 << 24)


def picture_of(place_id: str) -> bytes:
    """Some kilobytes, of which no part stands in another picture."""
    chance = random.Random(place_id)
    return chance.randbytes(chance.choice([300, 3_000, 6_000, 40_000]))


def pictured(place_id: str, **fields: object) -> Enrolment:
    made = frame(place_id, **fields)  # type: ignore[arg-type]
    image = picture_of(place_id)
    return Enrolment(**{**vars(made), "image": image, "digest": sha256(image).digest()})


def traces(place_id: str) -> dict[str, list[bytes]]:
    """Bytes by which a file is found out to have something of a place."""
    made, picture = pictured(place_id), picture_of(place_id)
    return {
        "descriptor": [pack_descriptors(made.descriptor[np.newaxis], "half").tobytes()],
        "cells": [pack_local(made.local[np.newaxis], "half").tobytes()],
        "keypoints": [keypoints_of(place_id).record()],
        "picture": [picture[at : at + 32] for at in range(0, len(picture) - 32, 100)],
    }


def found(directory: Path, place_id: str) -> set[str]:
    """Which traces of a place stand in which file."""
    contents = {path.name: path.read_bytes() for path in directory.rglob("*") if path.is_file()}
    return {
        f"{what} in {name}"
        for what, some in traces(place_id).items()
        for name, content in contents.items()
        if any(trace in content for trace in some)
    }


@pytest.fixture
def pictures(atlas: Directory) -> Map:
    """Forty places in segments of four rows, with whole images."""
    made = atlas.create("lab", ENCODER, DIMENSION, MapSettings(keep="image"), local_shape=LOCAL_SHAPE)
    made.enrol([pictured(f"p{i}", sequence="monday" if i % 4 else "tuesday") for i in range(40)])
    return made


def test_nothing_of_a_deleted_place_is_left_in_any_file(pictures: Map, atlas: Directory, directory: Path) -> None:
    assert any("descriptor" in one for one in found(directory, "p7"))
    assert any("picture" in one for one in found(directory, "p7"))
    pictures.forget("p7")
    assert any("descriptor" in one for one in found(directory, "p7"))  # it shares its file with others
    report = pictures.erase()
    assert (report.rows, found(directory, "p7")) == (1, set())
    assert pictures.erase().rows == 0
    for beside in ("p6", "p8"):
        assert {one.split()[0] for one in found(directory, beside)} == {"descriptor", "cells", "keypoints", "picture"}
    assert pictures.verify().ok and pictures.picture("p6") == picture_of("p6")
    atlas.close()
    again = Directory(directory)
    try:
        lab = again.get("lab")
        assert lab.verify().ok and lab.count_places() == 39
        lab.enrol([pictured("new")])
        assert found(directory, "p7") == set()
    finally:
        again.close()


def test_a_traverse_is_erased_with_its_files(pictures: Map, directory: Path) -> None:
    """Of ten segments each has one row of another traverse; then a segment goes whole."""
    gone = [f"p{i}" for i in range(40) if i % 4]
    pictures.forget_sequence("monday")
    pictures.forget("p4")
    pictures.erase()
    assert [one for one in [*gone, "p4"] if found(directory, one)] == []
    assert found(directory, "p8") and pictures.verify().ok


@pytest.mark.thorough
def test_former_frames_and_splits_of_pages_leave_nothing(pictures: Map, directory: Path) -> None:
    """Rows are written between others, so that SQLite splits pages and copies what is on them."""
    for i in range(40):
        pictures.enrol([pictured(f"p{i}x")])
        pictures.forget(f"p{(i * 7) % 40}")
    again = [Enrolment(**{**vars(pictured(f"other{i}")), "id": f"p{i}x"}) for i in range(20)]
    pictures.enrol(again)
    pictures.erase()
    left = {one: found(directory, one) for one in [*(f"p{i}" for i in range(40)), *(f"p{i}x" for i in range(20))]}
    assert {one: where for one, where in left.items() if where} == {}
    assert found(directory, "other3") and found(directory, "p30x")


def test_frames_for_review_that_were_dropped_are_erased(pictures: Map, directory: Path) -> None:
    for i in range(12):
        assert pictures.review.keep(picture_of(f"asked {i}"), {"verdict": "unknown"}, SETTING)
    pictures.review.discard(3)
    pictures.erase()
    assert found(directory, "asked 2") == set()
    assert found(directory, "asked 3") == {"picture in review.sqlite"}
    assert pictures.review.picture(4) == picture_of("asked 3") and pictures.verify().ok


def test_codes_of_deleted_places_are_erased(pictures: Map, directory: Path) -> None:
    become(pictures, "compact")
    indexer = pictures.indexer
    assert indexer is not None
    coder = indexer._files.coder
    code = coder.encode(pictures.snapshot().descriptors_at(np.array([5])))[0].tobytes()
    pictures.forget("p5")
    pictures.erase()
    pictures.close()
    assert not [path for path in directory.rglob("codes-*.index") if code in path.read_bytes()]


def test_a_reader_is_waited_for(pictures: Map, directory: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    snapshot = pictures.snapshot()
    pictures.forget("p7")
    looked = threading.Event()
    monkeypatch.setattr(erasing, "PATIENCE_SECONDS", 0.0)
    with pytest.raises(MapBusy):
        pictures.erase()
    assert any("descriptor" in one for one in found(directory, "p7"))
    monkeypatch.setattr(erasing, "PATIENCE_SECONDS", 600.0)

    def erase() -> None:
        pictures.erase(lambda _done, _total: looked.set())

    thread = threading.Thread(target=erase)
    thread.start()
    assert looked.wait(60)
    assert any("descriptor" in one for one in found(directory, "p7"))
    assert snapshot.descriptors_at(np.array([7])).any()
    del snapshot
    thread.join(60)
    assert found(directory, "p7") == set()


@pytest.mark.parametrize("stop_after", ["mark", "half"])
def test_an_erasure_that_a_crash_ends_harms_nothing(
    pictures: Map, atlas: Directory, directory: Path, monkeypatch: pytest.MonkeyPatch, stop_after: str
) -> None:
    """The record is marked and, in the second case, half of it is overwritten; the next erasure ends it."""
    pictures.forget("p7")

    class Crash(BaseException):
        pass

    def write(file: int, content: bytes, at: int) -> None:
        if len(content) > 4:
            if stop_after == "half":
                write_at(file, content[: len(content) // 2], at)
            raise Crash
        write_at(file, content, at)

    monkeypatch.setattr(segment_files, "write_at", write)
    with pytest.raises(Crash):
        pictures.erase()
    monkeypatch.undo()
    atlas.close()
    again = Directory(directory)
    try:
        lab = again.get("lab")
        assert lab.verify().ok and lab.count_places() == 39
        assert lab.erase().rows == 1
        assert found(directory, "p7") == set()
    finally:
        again.close()


def test_a_living_place_whose_record_is_marked_is_damage(pictures: Map, atlas: Directory, directory: Path) -> None:
    layout = pictures._expect_open().layout
    atlas.close()
    assert layout.record.fields is not None
    path = directory / "maps/lab" / segment_files.segment_name(1)
    content = bytearray(path.read_bytes())
    at = HEADER_BYTES + 2 * layout.record.itemsize + layout.record.fields["reserved"][1]
    content[at : at + 4] = ERASING.to_bytes(4, "little")
    path.write_bytes(content)
    with pytest.raises(Exception, match="row 6 has a place and is erased"):
        open_map(directory / "maps/lab")


def test_places_by_time_are_chosen_as_a_deletion_chooses_them(pictures: Map, directory: Path) -> None:
    gone = pictures.forget_all(PlaceFilter(sequence="tuesday"), 100)
    pictures.erase()
    assert len(gone) == 10 and [one for one in gone if found(directory, one)] == []
