"""What is found when a map is opened: unfinished writes, damage, another index of metadata."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from core.errors import MapQuarantined, StorageFailure
from core.ledger.maps import places
from core.ledger.maps.places import token_of
from core.store import Directory
from tests.core.store.edits import edit
from tests.core.store.frames import DIMENSION, ENCODER, LOCAL_SHAPE, descriptor_of, frame, local_of

PLACES = 10


@pytest.fixture
def folder(directory: Path) -> Path:
    """The folder of a closed map of ten places; beside it lies a map that must always serve."""
    atlas = Directory(directory, rows_per_segment=4)
    atlas.create("hall", ENCODER, DIMENSION, local_shape=LOCAL_SHAPE).enrol([frame("h")])
    atlas.create("lab", ENCODER, DIMENSION, local_shape=LOCAL_SHAPE).enrol(
        [frame(f"p{i}", sequence="s" if i == PLACES - 1 else None) for i in range(PLACES)]
    )
    atlas.close()
    return directory / "maps" / "lab"


def check(directory: Path, more: int = 0) -> None:
    """All places are there, and found."""
    atlas = Directory(directory, rows_per_segment=4)
    try:
        lab = atlas.get("lab")
        assert [place.id for place in lab.places(None, 100)[0]] == [f"p{i}" for i in range(PLACES + more)]
        for i in range(PLACES):
            rows, products = lab.snapshot().search(descriptor_of(f"p{i}"))
            assert (rows[0], rows.size) == (i, PLACES + more)
            assert products[0] == pytest.approx(1, abs=1e-3)
            np.testing.assert_array_equal(lab.snapshot().locals_at(rows[:1]), [local_of(f"p{i}")])
        report = lab.verify()
        assert (report.ok, report.problems, report.stale_caches) == (True, [], [])
    finally:
        atlas.close()


def test_a_copy_that_is_taken_at_any_moment_shows_an_acknowledged_state(directory: Path, folder: Path) -> None:
    """A live copy, file by file in either order while writes go on: an acknowledged state, or none."""
    atlas, outcomes = Directory(directory, rows_per_segment=4), set[str]()
    lab = atlas.get("lab")
    for number in range(12):
        copied = directory.with_name(f"copy-{number}")
        shutil.copytree(directory, copied, ignore=lambda _, names: [name for name in names if name.startswith("map.s")])
        names = ["map.sqlite", "map.sqlite-wal"]
        first, second = names if number % 2 else names[::-1]
        for name, between in ((first, True), (second, False)):
            shutil.copyfile(folder / name, copied / "maps" / "lab" / name)
            if between:
                for _ in range(1 + number % 3):
                    lab.enrol([frame(f"p{len(lab.snapshot())}")])
                if number % 4 > 1:
                    lab.erase()  # moves the log into the file, and empties it
        shutil.copyfile(directory / "maps/hall/map.sqlite", copied / "maps/hall/map.sqlite")
        again = Directory(copied)
        try:
            found = again.get("lab")
            ids = [place.id for place in found.places(None, 100)[0]]
            assert ids == [f"p{i}" for i in range(len(ids))] and PLACES <= len(ids) <= len(lab.snapshot())
            assert len(found.snapshot()) == len(ids) and found.verify().ok
            outcomes.add("taken")
        except (MapQuarantined, StorageFailure):
            outcomes.add("refused")
        finally:
            again.close()
    atlas.close()
    assert "taken" in outcomes


def test_a_write_that_ended_before_its_commit_is_as_if_it_had_not_been(directory: Path, folder: Path) -> None:
    """What a crash leaves: the log of a write without its end."""
    atlas = Directory(directory, rows_per_segment=4)
    atlas.get("lab").enrol([frame("p10")])
    log = folder / "map.sqlite-wal"
    before = log.stat().st_size
    atlas.get("lab").enrol([frame(f"q{i}") for i in range(5)])
    crashed = directory.with_name("crashed")
    shutil.copytree(directory, crashed)
    atlas.close()
    path = crashed / "maps/lab/map.sqlite-wal"
    path.write_bytes(path.read_bytes()[: (before + path.stat().st_size) // 2])
    check(crashed, 1)
    atlas = Directory(crashed)
    atlas.get("lab").enrol([frame(f"r{i}") for i in range(3)])
    assert [place and place.id for place in atlas.get("lab").places_at([11, 12, 13])] == ["r0", "r1", "r2"]
    atlas.close()


def spoil(statement: str) -> Callable[[Path], object]:
    return lambda folder: edit(folder, statement)


def take_the_other(folder: Path) -> None:
    shutil.copyfile(folder.parent / "hall" / "map.sqlite", folder / "map.sqlite")


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (spoil("UPDATE descriptors SET bytes = zeroblob(36) WHERE row = 9"), "row 9 of descriptors does not match"),
        (spoil("UPDATE locals SET bytes = zeroblob(19) WHERE row = 9"), "row 9 of locals does not match"),
        (spoil("DELETE FROM descriptors WHERE row = 9"), "row 9 has a place and no descriptors"),
        (spoil("DELETE FROM maps"), "the map's own record is missing"),
        (spoil("UPDATE maps SET record = replace(record, 'lab', 'hal')"), "own record .* does not match its checksum"),
        (take_the_other, r"map\.sqlite: it belongs to the map 'hall'"),
        (lambda folder: (folder / "map.sqlite").unlink(), r"map\.sqlite is missing"),
        (spoil("UPDATE places SET row = 4711 WHERE id = 'p3'"), "place 'p3' does not match its checksum"),
        (spoil("UPDATE places SET x = 1 WHERE id = 'p3'"), "place 'p3' does not match its checksum"),
        (spoil("UPDATE maps SET places = places + 1"), "its record counts 11 places and looks, but there are 10"),
        (spoil("UPDATE maps SET rows = rows - 1"), "a place has row 9, but there are 9"),
        (spoil("UPDATE maps SET numbers = 10"), "the next number of a place, 10, is not above those there are"),
        (spoil("UPDATE maps SET codes = 0"), "the next code of a sequence, 0, is not above those there are"),
        (spoil("DELETE FROM sequences WHERE name = 's'"), "place 'p9' is of a sequence that is missing"),
        (spoil("UPDATE sequences SET next_ordinal = 0, negative = 0"), "is empty, or ends before its last place"),
    ],
)  # fmt: skip
def test_a_damaged_map_is_quarantined_and_the_others_serve(
    directory: Path, folder: Path, spoil: Callable[[Path], object], reason: str
) -> None:
    spoil(folder)
    atlas = Directory(directory)
    try:
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
    run = partial(edit, directory / "maps" / "lab")
    run(f"UPDATE tokens SET token = '{token_of('floor', 7)}' WHERE token = '{token_of('floor', 1)}'")
    run(f"DELETE FROM tokens WHERE token = '{token_of('note', 'a')}' AND row = 2")
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
