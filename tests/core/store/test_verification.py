from __future__ import annotations

import shutil
from dataclasses import replace
from hashlib import sha256
from pathlib import Path

import pytest
from core.storage.database.schema import driver_of
from core.storage.files.segment_files import HEADER_BYTES

from core.errors import MapQuarantined
from core.index.flat import vectors
from core.ledger.maps import frames
from core.maps import MapSettings
from core.store import Directory, Map
from tests.core.storage.test_opening import flip
from tests.core.store.frames import DESCRIPTOR_BYTES, DIMENSION, ENCODER, LOCAL_SHAPE, RECORD_BYTES, frame


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


@pytest.fixture
def folder(directory: Path) -> Path:
    return directory / "maps" / "hall"


def execute(hall: Map, statement: str) -> None:
    """Behind the back of everything that keeps the map in order."""
    with hall._writing() as write:
        driver_of(write.connection).execute(statement)


def test_a_good_map(hall: Map, folder: Path) -> None:
    report = hall.verify()
    assert (report.ok, report.places, report.rows) == (True, 9, 10)
    assert (report.problems, report.stale_caches) == ([], [])
    with hall._reading() as connection:
        _, of_keypoints, of_pictures = frames.room(connection)
    assert of_keypoints > 9 * 68
    assert report.checked_bytes == 10 * RECORD_BYTES + 9 * len("image 0") + of_keypoints
    assert of_pictures == 9 * len("image 0")


def test_every_damaged_row_is_named(hall: Map, folder: Path) -> None:
    for row, name in ((1, "descriptors-000001.seg"), (6, "descriptors-000002.seg"), (9, "descriptors-000003.seg")):
        flip(folder / name, HEADER_BYTES + (row % 4) * RECORD_BYTES)
    problems = "\n".join(hall.verify().problems)
    assert "descriptors-000001.seg: row 1 (place 'p1') does not match its checksum" in problems
    assert "descriptors-000002.seg: row 6 (of no place) does not match its checksum" in problems
    assert "descriptors-000003.seg: row 9 (place 'p9') does not match its checksum" in problems


def test_a_flipped_bit_of_any_part_of_a_row_is_found(hall: Map, folder: Path) -> None:
    path, start = folder / "descriptors-000003.seg", HEADER_BYTES + RECORD_BYTES
    row, local = DESCRIPTOR_BYTES, DESCRIPTOR_BYTES + 24
    for offset in (0, row - 1, row, row + 8, row + 12, row + 16, local, local + 7, local + 14):
        flip(path, start + offset)
        assert "descriptors-000003.seg: row 9 (place 'p9') does not match its checksum" in hall.verify().problems
        flip(path, start + offset)
    assert hall.verify().ok


def test_many_damaged_rows_are_counted(atlas: Directory, directory: Path) -> None:
    atlas._rows_per_segment = 64
    lab = atlas.create("lab", ENCODER, DIMENSION, local_shape=LOCAL_SHAPE)
    lab.enrol([frame(f"p{i}") for i in range(30)])
    for row in range(30):
        flip(directory / "maps" / "lab" / "descriptors-000001.seg", HEADER_BYTES + row * RECORD_BYTES)
    problems = lab.verify().problems
    assert len([problem for problem in problems if "does not match" in problem]) == 10
    assert "descriptors-000001.seg: the same is true of 20 more rows" in problems


def test_a_missing_segment_does_not_hide_the_others(hall: Map, folder: Path) -> None:
    (folder / "descriptors-000001.seg").unlink()
    flip(folder / "descriptors-000002.seg", HEADER_BYTES)
    problems = hall.verify().problems
    assert "descriptors-000001.seg: the file is missing" in problems
    assert "descriptors-000002.seg: row 4 (place 'p4') does not match its checksum" in problems


def test_a_damaged_picture_is_named(hall: Map) -> None:
    execute(hall, "UPDATE pictures SET bytes = x'00' WHERE row = 2")
    assert hall.verify().problems == ["map.sqlite: the image of place 'p2' does not match its digest"]


def test_an_image_that_is_not_the_one_enrolled_is_named(hall: Map) -> None:
    digest = sha256(b"x").hexdigest()
    execute(hall, f"UPDATE pictures SET bytes = x'78', digest = x'{digest}' WHERE row = 2")
    assert hall.verify().problems == ["map.sqlite: the image of place 'p2' does not match its digest"]


def test_a_picture_that_is_missing_is_named(hall: Map) -> None:
    execute(hall, "DELETE FROM pictures WHERE row = 2")
    assert hall.verify().problems == ["map.sqlite: place 'p2' is recorded to keep image, which is not true"]


def test_what_is_searched_must_be_what_is_stored(hall: Map) -> None:
    vectors(hall.snapshot().segments[1].index)[0, 0] += 1
    assert hall.verify().problems == ["descriptors-000002.seg: row 4 (place 'p4') is not what is searched"]


def test_what_is_compared_after_the_search_must_be_what_is_stored(hall: Map) -> None:
    hall.snapshot().segments[2].local[1, 2, 4] ^= 1
    assert hall.verify().problems == ["descriptors-000003.seg: row 9 (place 'p9') is not what is searched"]


@pytest.mark.parametrize(
    ("statement", "problem"),
    [
        ("UPDATE places SET x = 1, y = 2 WHERE id = 'p1'", "row 1 differs between what is searched and map.sqlite"),
        ("UPDATE places SET ordinal = 77 WHERE id = 'p1'", "row 1 differs between what is searched and map.sqlite"),
        ("DELETE FROM places WHERE id = 'p1'", "9 places in 10 rows are searched, 8 in 10 are stored"),
        ("UPDATE places SET row = 6 WHERE id = 'p1'", "row 6 differs between what is searched and map.sqlite"),
        ("UPDATE places SET row = 99 WHERE id = 'p1'", "map.sqlite: place 'p1' has row 99, but there are 10"),
        ("UPDATE places SET checksum = 5 WHERE id = 'p1'", "row 1 (place 'p1') is not the one that map.sqlite records"),
        (
            "UPDATE segments SET checksum = 5 WHERE number = 2",
            "its rows are not those in map.sqlite",
        ),
    ],
)
def test_disagreement_of_store_and_snapshot(hall: Map, statement: str, problem: str) -> None:
    execute(hall, statement)
    report = hall.verify()
    assert not report.ok
    assert any(problem in found for found in report.problems), report.problems


@pytest.mark.parametrize(
    ("statement", "problem"),
    [
        ("DELETE FROM sequences WHERE name = 's'", "place 'p0' is of a sequence that is missing"),
        ("UPDATE sequences SET next_ordinal = 9 WHERE name = 's'", "sequence 's' is empty, or ends before its last"),
        ("INSERT INTO sequences VALUES (1, 77, 't', 3)", "sequence 't' is empty, or ends before its last place"),
        ("UPDATE maps SET places = 8", "its record counts 8 places and 0 looks in 10 rows, but there are 9 and 0"),
        ("UPDATE maps SET rows = 11", "its record counts 9 places and 0 looks in 11 rows, but there are 9 and 0"),
        ("UPDATE maps SET numbers = 10", "the next number of a place, 10, is not above those there are"),
        ("UPDATE maps SET codes = 0", "the next code of a sequence, 0, is not above those there are"),
        ("UPDATE maps SET revision = 0", "the revision, 0, is below those of places"),
        ("UPDATE maps SET record = replace(record, 'image', 'none')", "it does not match its checksum"),
        ("UPDATE layout SET seal = seal + 1", "it does not say how many rows a segment has"),
        ("INSERT INTO cameras VALUES (1, 'front', NULL, NULL, '', 0)", "camera 'front' does not match its checksum"),
        ("DELETE FROM tokens", "row 9 is not indexed correctly by its metadata"),
        ("INSERT INTO tokens VALUES (1, 'feed', 3)", "row 3 is not indexed correctly by its metadata"),
        ("DELETE FROM keypoints WHERE row = 3; UPDATE keypoints SET row = 3 WHERE row = 4", "keypoints of place 'p3'"),
        ("UPDATE pictures SET row = 6 WHERE row = 5", "the pictures or keypoints of 1 rows belong to no place"),
    ],
)
def test_rows_that_contradict_one_another(hall: Map, statement: str, problem: str) -> None:
    hall.patch("p9", {"metadata": {"floor": 1}})
    assert hall.verify().ok
    for one in statement.split("; "):
        execute(hall, one)
    assert any(problem in found for found in hall.verify().problems)


def test_places_enrolled_meanwhile_are_not_in_the_report(hall: Map, monkeypatch: pytest.MonkeyPatch) -> None:
    """The report is of the moment of the call, although writes go on."""
    from core.store import verification

    check_tables = verification._check_tables

    def enrol_first(*arguments: object) -> None:
        hall.enrol([frame(f"late{i}") for i in range(5)])
        hall.forget("p1")
        check_tables(*arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(verification, "_check_tables", enrol_first)
    report = hall.verify()
    assert (report.problems, report.places, report.rows) == ([], 9, 10)
    assert hall.count_places() == 13


def test_the_log_can_be_emptied_while_descriptors_are_read(hall: Map, folder: Path) -> None:
    """What is deleted meanwhile is no damage, and what is reclaimed waits until it is read."""
    log = folder / "map.sqlite-wal"
    told: list[int] = []

    def write(done: int, total: int) -> None:
        opened = hall._opened
        assert opened is not None
        if not told:
            hall.forget("p9")
            hall.enrol([frame("late")])
            for i in range(4):
                hall.forget(f"p{i}")
            opened.database.empty_log()
            assert log.stat().st_size == 0
        told.append(done)

    report = hall.verify(write)
    assert (report.problems, report.places, report.rows) == ([], 9, 10)
    assert told and hall.count_places() == 5
    hall.edit({"description": "another"})
    assert not (folder / "descriptors-000001.seg").exists() and hall.verify().ok


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
        assert not report.ok and any(line.startswith("map.sqlite-wal: frame 1 ") for line in report.problems)
        again.close()
        assert {name: path.read_bytes() for name, path in kept.items()} == before
    flip(kept["map.sqlite-wal"], 32 + 24 + 5)  # as if put back from a backup
    mended = Directory(crashed)
    assert [place.id for place in mended.get("lab").places(None, 9)[0]] == ["a", "b", "c"]
    mended.close()
