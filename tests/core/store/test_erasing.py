"""What deleted places leave, by a search of the bytes of the whole data directory."""

from __future__ import annotations

import random
import shutil
import threading
from hashlib import sha256
from pathlib import Path

import numpy as np
import pytest

from core.errors import MapBusy
from core.index import Coder
from core.ledger.maps import rows
from core.ledger.maps.places import tokens_of
from core.maps import MapSettings, PlaceFilter, ReviewSetting
from core.maps.forms import pack_descriptors, pack_local
from core.maps.records import Enrolment
from core.store import Directory, Map
from tests.core.store.frames import DIMENSION, ENCODER, LOCAL_SHAPE, frame, keypoints_of

SETTING = ReviewSetting(most_frames=100, most_bytes=1 << 24)


def picture_of(place_id: str) -> bytes:
    """Some kilobytes, of which no part stands in another picture."""
    chance = random.Random(place_id)
    return chance.randbytes(chance.choice([300, 3_000, 6_000, 40_000]))


def metadata_of(place_id: str) -> dict[str, str]:
    """Two values, of which one has the id between marks, which stand nowhere else."""
    return {"note": f"<{place_id}>", "drawn": random.Random(f"drawn {place_id}").randbytes(8).hex()}


def pictured(place_id: str, **fields: object) -> Enrolment:
    made = frame(place_id, metadata=metadata_of(place_id), **fields)  # type: ignore[arg-type]
    image = picture_of(place_id)
    return Enrolment(**{**vars(made), "image": image, "digest": sha256(image).digest()})


@pytest.fixture(autouse=True)
def at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nobody needs a row any more when its place is gone."""
    monkeypatch.setattr(rows, "LEFT_SECONDS", 0)


def traces(place_id: str) -> dict[str, list[bytes]]:
    """Bytes by which a file is found out to have something of a place."""
    made, picture = pictured(place_id), picture_of(place_id)
    stored = pack_descriptors(made.descriptor[np.newaxis], "half")
    return {
        "id": [f"<{place_id}>".encode()],
        "digest": [made.digest],
        "token": [token.encode() for token in tokens_of(metadata_of(place_id))],
        "code": [Coder.of(DIMENSION).encode(stored.astype(np.float32))[0].tobytes()],
        "descriptor": [stored.tobytes()],
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
    """Forty places with whole images."""
    made = atlas.create("lab", ENCODER, DIMENSION, MapSettings(keep="image"), local_shape=LOCAL_SHAPE)
    made.edit({"index": "compact"})  # with codes, too
    made.enrol([pictured(f"p{i}", sequence="monday" if i % 4 else "tuesday") for i in range(40)])
    return made


def test_nothing_of_a_deleted_place_is_left_in_any_file(pictures: Map, atlas: Directory, directory: Path) -> None:
    everything = {"id", "digest", "token", "code", "descriptor", "cells", "keypoints", "picture"}
    assert {one.split()[0] for one in found(directory, "p7")} == everything
    pictures.forget("p7")
    assert {one.split()[0] for one in found(directory, "p7")} == everything  # of the log
    pictures.erase()
    assert found(directory, "p7") == set()
    assert pictures.erase().rows == 0
    for beside in ("p6", "p8"):
        assert {one.split()[0] for one in found(directory, beside)} == everything
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


def test_a_traverse_is_erased(pictures: Map, directory: Path) -> None:
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
        answer = {"verdict": "unknown", "text": f"answer about {i}"}
        assert pictures.review.keep(picture_of(f"asked {i}"), answer, SETTING)
    pictures.review.discard(3)
    pictures.erase()
    content = (directory / "maps/lab/map.sqlite").read_bytes()
    assert b"answer about 2" not in content and b"answer about 3" in content
    assert found(directory, "asked 2") == set()
    assert found(directory, "asked 3") == {"digest in map.sqlite", "picture in map.sqlite"}
    assert pictures.review.picture(4) == picture_of("asked 3") and pictures.verify().ok


def test_a_row_that_is_still_needed_is_waited_for(
    pictures: Map, directory: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A query that began before the deletion reads its rows to the end."""
    monkeypatch.setattr(rows, "LEFT_SECONDS", 3600)
    snapshot = pictures.snapshot()
    pictures.forget("p7")
    looked = threading.Event()

    def erase() -> None:
        pictures.erase(lambda _done, _total: looked.set())

    thread = threading.Thread(target=erase)
    thread.start()
    assert looked.wait(60)
    assert any("descriptor" in one for one in found(directory, "p7"))
    assert snapshot.descriptors_at(np.array([7])).any()
    monkeypatch.setattr(rows, "LEFT_SECONDS", 0)
    thread.join(60)
    assert not thread.is_alive() and found(directory, "p7") == set()


def test_a_reader_keeps_the_log_from_being_emptied(pictures: Map, directory: Path) -> None:
    pictures.forget("p7")
    with pictures.viewing(), pytest.raises(MapBusy):
        pictures.erase()
    assert (pictures.erase().rows, pictures.erase().rows) == (1, 0)
    assert found(directory, "p7") == set() and pictures.verify().ok


def test_an_erasure_that_is_broken_off_harms_nothing(
    pictures: Map, directory: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By its caller, or by a crash right before the file is rewritten; the next one ends it."""
    monkeypatch.setattr(rows, "LEFT_SECONDS", 3600)
    searched = pictures.snapshot()
    pictures.forget("p7")

    def stop(_done: int, _total: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        pictures.erase(stop)
    assert len(searched) == 40
    monkeypatch.setattr(rows, "LEFT_SECONDS", 0)
    pictures.enrol([pictured("next")])  # deletes the rows, which leaves their bytes in the log
    crashed = directory.with_name("crashed")
    shutil.copytree(directory, crashed)
    assert found(crashed, "p7")
    again = Directory(crashed)
    try:
        lab = again.get("lab")
        assert lab.verify().ok and lab.count_places() == 40
        lab.erase()
        assert found(crashed, "p7") == set() and lab.verify().ok
    finally:
        again.close()


def test_places_by_time_are_chosen_as_a_deletion_chooses_them(pictures: Map, directory: Path) -> None:
    gone = pictures.forget_all(PlaceFilter(sequence="tuesday"), 100)
    pictures.erase()
    assert len(gone) == 10 and [one for one in gone if found(directory, one)] == []
