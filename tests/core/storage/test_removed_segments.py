"""Segments of which no place is left: gone from memory and disk, and nothing else with them."""

from __future__ import annotations

import shutil
import sqlite3
from pathlib import Path

import numpy as np
import pytest

from core.errors import MapQuarantined, UnknownPlace
from core.store import Directory, Map
from core.storage.database.connections import FILE
from core.storage.database.schema import driver_of
from core.storage.files.segment_files import segment_name
from core.storage.opening import open_map
from core.storage.removed_segments import RemovedSegments
from core.store.snapshot import Snapshot
from tests.core.store.frames import frame
from tests.core.storage.search.test_tier_memory import become


def files(directory: Path) -> list[str]:
    return sorted(path.name for path in (directory / "maps/lab").glob("*.seg"))


def names(*numbers: int) -> list[str]:
    return [segment_name(number) for number in numbers]


def answers(snapshot: Snapshot) -> list[int]:
    return [int(row) for row in snapshot.search(frame("question").descriptor)[0]]


@pytest.fixture
def three(lab: Map) -> Map:
    """A map with segments of four rows: two full ones and one of two."""
    lab.enrol([frame(f"p{i}") for i in range(10)])
    return lab


def forget(lab: Map, *numbers: int) -> None:
    for number in numbers:
        lab.forget(f"p{number}")


def test_the_file_of_a_dead_segment_goes_and_the_rest_stays(three: Map, atlas: Directory, directory: Path) -> None:
    forget(three, 4, 5, 6)
    assert files(directory) == names(0, 1, 2)
    before = three.storage_status().descriptors
    forget(three, 7)
    assert files(directory) == names(0, 2)
    three.enrol([frame("new")])
    assert three.storage_status().descriptors < before
    assert three.snapshot().segments[1].memory < 4 * 100
    assert sorted(answers(three.snapshot())) == [0, 1, 2, 3, 8, 9, 10]
    report = three.verify()
    assert report.ok and (report.places, report.rows) == (7, 11), report.problems
    with pytest.raises(UnknownPlace):
        three.snapshot().descriptors_at(np.array([5]))

    found = answers(three.snapshot())
    atlas.close()
    again = Directory(directory)
    assert answers(again.get("lab").snapshot()) == found
    assert again.get("lab").verify().ok
    again.get("lab").enrol([frame("newer"), frame("newest")])
    assert again.get("lab").verify().ok
    again.close()


def test_the_last_segment_stays_until_another_follows(three: Map, directory: Path) -> None:
    three.enrol([frame("p10"), frame("p11")])
    forget(three, 8, 9, 10, 11)
    three.edit({"description": "as before"})
    assert files(directory) == names(0, 1, 2)
    three.enrol([frame("p12")])
    three.edit({"description": "another"})
    assert files(directory) == names(0, 1, 3)
    assert three.verify().ok


def test_frames_that_were_replaced_count_as_dead(three: Map, directory: Path) -> None:
    three.enrol([frame(f"p{i}", "another view") for i in range(4)])
    three.edit({"description": "another"})
    assert files(directory) == names(1, 2, 3)
    assert three.count_places() == 10 and three.verify().ok


@pytest.mark.parametrize("tier", ["exact", "compact"])
def test_who_began_to_read_reads_to_the_end(three: Map, directory: Path, tier: str) -> None:
    become(three, tier)
    old = three.snapshot()
    expected, kept = answers(old), old.descriptors_at(np.arange(10))
    forget(three, 0, 1, 2, 3)
    three.enrol([frame("new")])
    assert files(directory) == names(0, 1, 2)
    assert answers(old) == expected
    np.testing.assert_array_equal(old.descriptors_at(np.arange(10)), kept)
    del old
    three.enrol([frame("newer")])
    assert files(directory) == names(1, 2)
    assert sorted(answers(three.snapshot())) == [4, 5, 6, 7, 8, 9, 10, 11]


def test_other_tiers_do_without_the_rows(three: Map, atlas: Directory, directory: Path) -> None:
    forget(three, 0, 1, 2, 3)
    three.enrol([frame("new")])
    expected = answers(three.snapshot())
    for tier in ("compact", "exact", "compact"):
        become(three, tier)
        assert answers(three.snapshot()) == expected
        assert three.verify().ok
    atlas.close()
    for cache in (directory / "maps/lab").glob("*.index"):
        cache.unlink()
    again = Directory(directory)
    become(again.get("lab"), "compact")
    assert answers(again.get("lab").snapshot()) == expected
    again.close()


def test_a_crash_before_the_file_goes_leaves_work_for_the_start(three: Map, directory: Path, tmp_path: Path) -> None:
    reading = three.snapshot()
    forget(three, 0, 1, 2, 3)
    crashed = tmp_path / "crashed"
    shutil.copytree(directory, crashed)
    assert len(reading) == 10
    assert files(crashed) == names(0, 1, 2)
    atlas = Directory(crashed)
    assert sorted(answers(atlas.get("lab").snapshot())) == [4, 5, 6, 7, 8, 9]
    assert files(crashed) == names(1, 2)
    assert atlas.get("lab").verify().ok
    atlas.close()


def test_a_transaction_that_fails_takes_no_file(three: Map, atlas: Directory, directory: Path) -> None:
    atlas.close()
    folder = directory / "maps/lab"
    opened, before = open_map(folder)
    removed_segments = RemovedSegments(folder, opened.layout)
    with pytest.raises(ZeroDivisionError), opened.database.transaction() as connection:
        driver_of(connection).execute("DELETE FROM places WHERE row < 4")
        assert removed_segments.remove(connection, before.without([0, 1, 2, 3])).segments[0].removed
        raise ZeroDivisionError
    removed_segments.clear(before)
    opened.database.close()
    assert files(directory) == names(0, 1, 2)
    again = Directory(directory)
    assert len(again.get("lab").snapshot()) == 10 and again.get("lab").verify().ok
    again.close()


def test_places_are_never_given_up_for_a_flipped_bit(three: Map, atlas: Directory, directory: Path) -> None:
    atlas.close()
    connection = sqlite3.connect(directory / "maps/lab" / FILE)
    connection.execute("UPDATE segments SET removed = 1 WHERE number = 1")
    connection.commit()
    connection.close()
    again = Directory(directory)
    with pytest.raises(MapQuarantined):
        again.get("lab").open()
    assert files(directory) == names(0, 1, 2)
    report = again.verify("lab")
    assert not report.ok and any("recorded as removed" in problem for problem in report.problems)
    again.close()


def test_no_file_goes_while_somebody_links_them(three: Map, directory: Path) -> None:
    opened = three._opened
    assert opened is not None
    with opened.removed_segments.retained():
        forget(three, 0, 1, 2, 3)
        three.enrol([frame("new")])
        assert files(directory) == names(0, 1, 2)
    three.enrol([frame("newer")])
    assert files(directory) == names(1, 2)


def test_the_room_is_there_before_a_write_begins(three: Map, directory: Path) -> None:
    """Also one that comes to nothing: on a full disk it may be this room that it needs."""
    reading = three.snapshot()
    forget(three, 0, 1, 2, 3)
    assert files(directory) == names(0, 1, 2)
    del reading
    with pytest.raises(UnknownPlace):
        three.forget("nobody")
    assert files(directory) == names(1, 2)


def test_a_write_that_fails_leaves_what_died_before_to_the_next(three: Map, directory: Path) -> None:
    """Its own segments are not there any more, and what it would have removed is looked at again."""
    with pytest.raises(ZeroDivisionError), three._writing() as write:
        for i in range(12):
            write.enrol(frame("p0", f"view {i}"))
        for i in range(1, 4):
            write.enrol(frame(f"p{i}", "another view"))
        write.finish()
        removed = [segment.removed for segment in write.after.segments]
        assert removed == [True, False, False, True, True, False, False]
        raise ZeroDivisionError
    assert files(directory) == names(0, 1, 2) and three.count_places() == 10
    three.edit({"description": "another"})
    assert files(directory) == names(0, 1, 2) and three.verify().ok
    forget(three, 0, 1, 2, 3)
    assert files(directory) == names(1, 2) and three.verify().ok
