"""What is found when a map is opened: rows that nobody named, damage."""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from core.storage.files.segment_files import HEADER_BYTES

from core.errors import MapQuarantined
from core.ledger.maps import places
from core.ledger.maps.places import token_of
from core.store import Directory
from tests.core.store.frames import (
    DESCRIPTOR_BYTES,
    DIMENSION,
    ENCODER,
    LOCAL_SHAPE,
    RECORD_BYTES,
    descriptor_of,
    frame,
    local_of,
)

PLACES = 10  # two full segments of four rows and a tail of two


@pytest.fixture
def folder(directory: Path) -> Path:
    """Of a map of ten places, closed; beside it a map that must always serve."""
    atlas = Directory(directory, rows_per_segment=4)
    atlas.create("hall", ENCODER, DIMENSION, local_shape=LOCAL_SHAPE).enrol([frame("h")])
    atlas.create("lab", ENCODER, DIMENSION, local_shape=LOCAL_SHAPE).enrol(
        [frame(f"p{i}", sequence="s" if i == PLACES - 1 else None) for i in range(PLACES)]
    )
    atlas.close()
    return directory / "maps" / "lab"


def check(directory: Path) -> None:
    """All places are there, and found."""
    atlas = Directory(directory)
    try:
        lab = atlas.get("lab")
        assert [place.id for place in lab.places(None, 100)[0]] == [f"p{i}" for i in range(PLACES)]
        for i in range(PLACES):
            rows, products = lab.snapshot().search(descriptor_of(f"p{i}"))
            assert (rows[0], rows.size) == (i, PLACES)
            assert products[0] == pytest.approx(1, abs=1e-3)
            np.testing.assert_array_equal(lab.snapshot().locals_at(rows[:1]), [local_of(f"p{i}")])
        report = lab.verify()
        assert (report.ok, report.problems, report.stale_caches) == (True, [], [])
    finally:
        atlas.close()


def flip(path: Path, offset: int) -> None:
    with path.open("r+b") as file:
        file.seek(offset)
        byte = file.read(1)[0]
        file.seek(offset)
        file.write(bytes([byte ^ 1]))


def remove(path: Path) -> None:
    path.unlink()


def cut(path: Path) -> None:
    os.truncate(path, path.stat().st_size // 2)


def flip_middle(path: Path) -> None:
    flip(path, path.stat().st_size // 2)


def garbage(path: Path) -> None:
    path.write_bytes(os.urandom(path.stat().st_size))


def test_rows_that_nobody_named_are_cut_off(directory: Path, folder: Path) -> None:
    tail = folder / "descriptors-000003.seg"
    size = tail.stat().st_size
    with tail.open("ab") as file:
        file.write(os.urandom(RECORD_BYTES + 17))
    (folder / "descriptors-000004.seg").write_bytes(b"a segment begun")
    check(directory)
    assert tail.stat().st_size == size
    assert not (folder / "descriptors-000004.seg").exists()


def test_a_write_that_ended_before_its_commit_is_as_if_it_had_not_been(directory: Path, folder: Path) -> None:
    names = ("map.sqlite", "descriptors-000003.seg")
    before = {name: (folder / name).read_bytes() for name in names}
    atlas = Directory(directory)
    atlas.get("lab").enrol([frame(f"q{i}") for i in range(5)])  # fills the third segment, begins a fourth
    atlas.close()
    (folder / "map.sqlite").write_bytes(before["map.sqlite"])
    check(directory)
    assert (folder / "descriptors-000003.seg").read_bytes() == before["descriptors-000003.seg"]
    assert not (folder / "descriptors-000004.seg").exists()
    atlas = Directory(directory)
    atlas.get("lab").enrol([frame(f"r{i}") for i in range(3)])
    atlas.close()
    atlas = Directory(directory)
    assert atlas.get("lab").verify().stale_caches == []
    assert [place and place.id for place in atlas.get("lab").places_at([10, 11, 12])] == ["r0", "r1", "r2"]
    atlas.close()


def damage_row(folder: Path) -> None:
    flip(folder / "descriptors-000003.seg", HEADER_BYTES + RECORD_BYTES + 7)


def damage_local(folder: Path) -> None:
    flip(folder / "descriptors-000003.seg", HEADER_BYTES + RECORD_BYTES + DESCRIPTOR_BYTES + 24 + 7)


def damage_header(folder: Path) -> None:
    flip(folder / "descriptors-000003.seg", 20)


def cut_tail(folder: Path) -> None:
    tail = folder / "descriptors-000003.seg"
    os.truncate(tail, tail.stat().st_size - 1)


def remove_tail(folder: Path) -> None:
    (folder / "descriptors-000003.seg").unlink()


def damage_full_segment(folder: Path) -> None:
    flip(folder / "descriptors-000001.seg", HEADER_BYTES)


def restore_an_older_tail(folder: Path) -> None:
    """As good as the one there was, but of other frames."""
    other = folder.parent / "hall"
    (folder / "descriptors-000003.seg").write_bytes((other / "descriptors-000001.seg").read_bytes())


def run(folder: Path, statement: str) -> None:
    connection = sqlite3.connect(folder / "map.sqlite", isolation_level=None)
    connection.execute(statement)
    connection.close()


def name_a_row_there_is_not(folder: Path) -> None:
    run(folder, "UPDATE places SET row = 4711 WHERE id = 'p3'")


def name_another_checksum(folder: Path) -> None:
    run(folder, "UPDATE places SET checksum = 1 WHERE id = 'p9'")


def lose_a_segment(folder: Path) -> None:
    run(folder, "DELETE FROM segments WHERE number = 1")


def count_another_place(folder: Path) -> None:
    run(folder, "UPDATE maps SET places = places + 1")


def count_a_row_less(folder: Path) -> None:
    run(folder, "UPDATE maps SET rows = rows - 1")


def count_numbers_again(folder: Path) -> None:
    run(folder, "UPDATE maps SET numbers = 10")


def count_codes_again(folder: Path) -> None:
    run(folder, "UPDATE maps SET codes = 0")


def lose_a_sequence(folder: Path) -> None:
    run(folder, "DELETE FROM sequences WHERE name = 's'")


def spoil_a_pose(folder: Path) -> None:
    run(folder, "UPDATE places SET x = 1 WHERE id = 'p3'")


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (damage_row, r"descriptors-000003\.seg: row 9 does not match"),
        (damage_local, r"descriptors-000003\.seg: row 9 does not match"),
        (damage_header, r"descriptors-000003\.seg: the header"),
        (cut_tail, r"descriptors-000003\.seg: the file ends after 1 of 2 rows"),
        (remove_tail, r"descriptors-000003\.seg: the file is missing"),
        (damage_full_segment, r"descriptors-000001\.seg: row 0"),
        (restore_an_older_tail, r"descriptors-000003\.seg: the header is that of another"),
        (name_a_row_there_is_not, r"map\.sqlite: a place has row 4711, but there are 10"),
        (name_another_checksum, r"descriptors-000003\.seg: row 9 is of another frame"),
        (lose_a_segment, r"map\.sqlite: segment 2 is not as long"),
        (count_another_place, r"map\.sqlite: its record counts 11 places and looks in 10 rows, but there are 10 in 10"),
        (count_a_row_less, r"map\.sqlite: its record counts 10 places and looks in 9 rows, but there are 10 in 10"),
        (count_numbers_again, r"map\.sqlite: the next number of a place, 10, is not above those there are"),
        (count_codes_again, r"map\.sqlite: the next code of a sequence, 0, is not above those there are"),
        (lose_a_sequence, r"map\.sqlite: place 'p9' is of a sequence that is missing"),
        (spoil_a_pose, r"map\.sqlite: .*a pose in metres needs x and y"),
    ],
    ids=lambda value: getattr(value, "__name__", ""),
)
def test_a_damaged_map_is_quarantined_and_the_others_serve(
    directory: Path, folder: Path, spoil: Callable[[Path], None], reason: str
) -> None:
    spoil(folder)
    atlas = Directory(directory)
    try:
        assert atlas.quarantined() == {}  # it is read on first use
        for _ in range(2):
            with pytest.raises(MapQuarantined, match=reason):
                atlas.get("lab")
        assert list(atlas.quarantined()) == ["lab"]
        assert [record.id for record in atlas.records(None, 10)[0]] == ["hall"]
        np.testing.assert_array_equal(atlas.get("hall").snapshot().search(descriptor_of("h"))[0], [0])
        report = atlas.verify("lab")
        assert not report.ok
        assert report.problems
        assert atlas.verify("hall").ok
    finally:
        atlas.close()


def test_an_index_of_metadata_that_is_wrong_is_rebuilt(directory: Path, caplog: pytest.LogCaptureFixture) -> None:
    """What places are found by follows from the places, and another SQLite may make it otherwise."""
    atlas = Directory(directory)
    lab = atlas.create("lab", ENCODER, DIMENSION, local_shape=LOCAL_SHAPE)
    lab.enrol([frame(f"p{i}", metadata={"floor": i, "note": "a"}) for i in range(3)])
    atlas.close()
    folder = directory / "maps" / "lab"
    run(folder, f"UPDATE tokens SET token = '{token_of('floor', 7)}' WHERE token = '{token_of('floor', 1)}'")
    run(folder, f"DELETE FROM tokens WHERE token = '{token_of('note', 'a')}' AND row = 2")
    atlas = Directory(directory)
    lab = atlas.get("lab")
    assert "is rebuilt" in caplog.text and "map lab" in caplog.text.lower()
    with lab._reading() as connection:
        assert places.rows_with(connection, {"floor": 1}).tolist() == [1]
        assert places.rows_with(connection, {"floor": 7}).tolist() == []
        assert places.rows_with(connection, {"note": "a"}).tolist() == [0, 1, 2]
    assert lab.verify().ok
    atlas.close()
    caplog.clear()
    atlas = Directory(directory)
    atlas.get("lab")
    assert "is rebuilt" not in caplog.text
    atlas.close()
