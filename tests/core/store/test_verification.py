from __future__ import annotations

import shutil
from dataclasses import replace
from hashlib import sha256
from pathlib import Path

import pytest

from core.errors import MapQuarantined
from core.index.flat import vectors
from core.ledger.maps import rows
from core.maps import MapSettings
from core.maps.forms import Form
from core.store import Directory, Map, verification
from tests.core.store.edits import edit
from tests.core.store.frames import DIMENSION, ENCODER, LOCAL_SHAPE, frame
from tests.faults.damage import flip


@pytest.fixture
def hall(atlas: Directory) -> Map:
    """Ten places, one of them forgotten, in segments of four rows; images are kept."""
    hall = atlas.create("hall", ENCODER, DIMENSION, MapSettings(keep="image"), local_shape=LOCAL_SHAPE)
    images = [f"image {i}".encode() for i in range(10)]
    hall.enrol(
        [
            replace(frame(f"p{i}", sequence="s"), image=image, digest=sha256(image).digest())
            for i, image in enumerate(images)
        ]
    )
    hall.forget("p6")
    return hall


def test_a_good_map(hall: Map) -> None:
    report = hall.verify()
    assert (report.ok, report.places, report.rows) == (True, 9, 10)
    assert (report.problems, report.stale_caches) == ([], [])
    form = Form.of(hall.record).frame.itemsize
    assert report.checked_bytes == 9 * (form + len("image 0"))


@pytest.mark.parametrize("table", ["descriptors", "locals"])
def test_every_damaged_row_is_named(hall: Map, table: str) -> None:
    edit(hall, *(f"UPDATE {table} SET bytes = zeroblob(length(bytes)) WHERE row = {row}" for row in (1, 9)))
    problems = hall.verify().problems
    for name in ("p1", "p9"):
        assert f"map.sqlite: place {name!r} has descriptors that do not match their checksum" in problems


def test_many_damaged_rows_are_counted(atlas: Directory) -> None:
    lab = atlas.create("lab", ENCODER, DIMENSION, local_shape=LOCAL_SHAPE)
    lab.enrol([frame(f"p{i}") for i in range(30)])
    edit(lab, "UPDATE descriptors SET bytes = zeroblob(length(bytes))")
    problems = lab.verify().problems
    assert len([problem for problem in problems if "do not match" in problem]) == 10
    assert "map.sqlite: the same is true of 20 more places" in problems


def test_an_image_that_is_not_the_one_enrolled_is_named(hall: Map) -> None:
    digest = sha256(b"x").hexdigest()
    edit(hall, f"UPDATE pictures SET bytes = x'78', digest = x'{digest}' WHERE row = 2")
    assert hall.verify().problems == ["map.sqlite: place 'p2' has an image that does not match its digest"]


def test_what_is_searched_must_be_what_is_stored(hall: Map) -> None:
    held = hall.snapshot().segments[1].held
    assert held is not None
    vectors(held.index)[0, 0] += 1
    assert hall.verify().problems == ["map.sqlite: place 'p4' is not what is searched"]


def test_what_is_compared_after_the_search_must_be_what_is_stored(hall: Map) -> None:
    held = hall.snapshot().segments[2].held
    assert held is not None
    held.local[1, 2, 4] ^= 1
    assert hall.verify().problems == ["map.sqlite: place 'p9' is not what is searched"]


@pytest.mark.parametrize(
    ("statement", "problem"),
    [
        ("UPDATE pictures SET bytes = x'00' WHERE row = 2", "place 'p2' has a stored image that does not match"),
        ("DELETE FROM pictures WHERE row = 2", "place 'p2' is recorded to keep image, which is not true"),
        ("UPDATE places SET x = 1, y = 2 WHERE id = 'p1'", "row 1 is searched elsewhere than it is"),
        ("UPDATE places SET ordinal = 77 WHERE id = 'p1'", "row 1 is searched elsewhere than it is"),
        ("DELETE FROM places WHERE id = 'p1'", "9 places and looks are searched, 8 are stored"),
        ("UPDATE places SET row = 6 WHERE id = 'p1'", "row 6 is searched elsewhere than it is"),
        ("UPDATE places SET row = 99 WHERE id = 'p1'", "a place has row 99, but there are 10"),
        ("UPDATE descriptors SET row = 77 WHERE row = 1", "place 'p1' has no descriptors"),
        ("DELETE FROM sequences WHERE name = 's'", "place 'p0' is of a sequence that is missing"),
        ("UPDATE sequences SET next_ordinal = 9, negative = -9 WHERE name = 's'", "'s' is empty, or ends before its"),
        ("INSERT INTO sequences VALUES (1, 77, 't', 3, -3)", "sequence 't' is empty, or ends before its last place"),
        ("UPDATE maps SET places = 8", "its record counts 8 places and 0 looks, but there are 9 and 0"),
        ("UPDATE maps SET numbers = 10", "the next number of a place, 10, is not above those there are"),
        ("UPDATE maps SET codes = 0", "the next code of a sequence, 0, is not above those there are"),
        ("UPDATE maps SET revision = 0", "the revision, 0, is below those of places"),
        ("UPDATE maps SET record = replace(record, 'image', 'none')", "it does not match its checksum"),
        ("INSERT INTO cameras VALUES (1, 'front', NULL, NULL, '', 0)", "camera 'front' does not match its checksum"),
        ("DELETE FROM tokens", "row 9 is not indexed correctly by its metadata"),
        ("INSERT INTO tokens VALUES (1, 'feed', 3)", "row 3 is not indexed correctly by its metadata"),
        ("DELETE FROM keypoints WHERE row = 3; UPDATE keypoints SET row = 3 WHERE row = 4", "'p3' has keypoints that"),
        ("UPDATE pictures SET row = 66 WHERE row = 5", "the descriptors, pictures or keypoints of 1 rows belong to no"),
        ("INSERT INTO dead_rows VALUES (1, 3, 1, 0, 0)", "row 3 has a place and is noted as dead"),
    ],
)
def test_rows_that_contradict_one_another(hall: Map, statement: str, problem: str) -> None:
    hall.patch("p9", {"metadata": {"floor": 1}})
    assert len(hall.snapshot()) == 9 and hall.verify().ok
    edit(hall, *statement.split("; "))
    assert any(problem in found for found in hall.verify().problems), hall.verify().problems


def test_a_damaged_note_of_a_dead_row_deletes_nothing_of_a_place(hall: Map) -> None:
    edit(hall, "INSERT INTO dead_rows VALUES (1, 3, 1, 0, 0)")
    hall.edit({"description": "another"})
    assert hall.picture("p3") == b"image 3" and hall.verify().problems == [
        "map.sqlite: row 3 has a place and is noted as dead"
    ]


def test_places_that_change_meanwhile_are_no_damage(hall: Map, monkeypatch: pytest.MonkeyPatch) -> None:
    """Writes go on, and so does what deletes behind them."""
    monkeypatch.setattr(rows, "LEFT_SECONDS", 0)
    monkeypatch.setattr(verification, "AT_ONCE", 2)
    seen: list[int] = []

    def write(done: int, _total: int) -> None:
        if not seen:
            hall.enrol([frame(f"late{i}") for i in range(5)] + [frame("p9", "another")])
            hall.forget("p7")
            hall.forget("p1")
        seen.append(done)

    report = hall.verify(write)
    assert (report.problems, report.places, report.rows) == ([], 9, 10)
    assert len(seen) > 2 and hall.count_places() == 12 and hall.verify().ok


def test_a_damaged_log_is_kept_as_it_is(directory: Path, tmp_path: Path) -> None:
    """Verifying must not let SQLite take what is left of it: what was acknowledged would be gone at the next start."""
    atlas = Directory(directory, rows_per_segment=4)
    lab = atlas.create("lab", ENCODER, DIMENSION, MapSettings(keep="image"), local_shape=LOCAL_SHAPE)
    for name in ("a", "b", "c"):
        lab.enrol([frame(name)])
    crashed = tmp_path / "crashed"
    shutil.copytree(directory, crashed)
    atlas.close()
    kept = {path.name: path for path in (crashed / "maps" / "lab").iterdir() if not path.name.endswith("-shm")}
    flip(kept["map.sqlite-wal"], 32 + 24 + 5)
    before = {name: path.read_bytes() for name, path in kept.items()}
    for _ in range(2):
        again = Directory(crashed)
        with pytest.raises(MapQuarantined):
            again.get("lab")
        report = again.verify("lab")
        assert not report.ok and any("map.sqlite-wal: frame 1 " in line for line in report.problems)
        again.close()
        assert {name: path.read_bytes() for name, path in kept.items()} == before
    flip(kept["map.sqlite-wal"], 32 + 24 + 5)  # as if put back from a backup
    mended = Directory(crashed)
    assert [place.id for place in mended.get("lab").places(None, 9)[0]] == ["a", "b", "c"]
    mended.close()
