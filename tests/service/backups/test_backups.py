"""The job that saves all maps: when it is due, what it leaves, and what becomes of maps and disks that refuse."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from core.maps.archives.reading import Archive, check
from core.store import Map
from service.app.runtime import Runtime
from service.backups.backups import AGAIN, PATIENCE, SETTLED, Backups
from service.backups.index import INDEX
from service.backups.shelf import BackupSchedule, Shelf, moment_of, name_of
from service.errors.faults import BackupFolderMissing
from service.jobs.job import Job
from tests.service.engines import ENCODER, end_of, enrolments, runtime_at, state_of

SAVED = "backups"


@pytest.fixture
def runtime(tmp_path: Path) -> Iterator[Runtime]:
    with runtime_at(tmp_path, backup_dir=tmp_path / SAVED) as running:
        yield running


def fill(runtime: Runtime, *names: str) -> list[Map]:
    """Make maps of three places each."""
    maps = []
    for number, name in enumerate(names):
        maps.append(runtime.engine.maps.create(name, ENCODER, 8))
        maps[-1].enrol(enrolments(10 * number, 3, "p", "monday"))
    return maps


def backed_up(runtime: Runtime) -> Job:
    return end_of(runtime, runtime.backups.submit())


def files_of(folder: Path) -> dict[str, Path]:
    """The files of a backup by their maps; each is whole, and what the index says."""
    (backup,) = [one for one in Shelf(folder.parent).backups() if one.name == folder.name]
    found = {}
    for entry in backup.index.maps:
        with Archive(folder / entry.file) as archive:
            check(archive)
        assert (archive.tag, archive.manifest.places) == (entry.manifest_sha256, entry.places)
        found[entry.id] = folder / entry.file
    assert {path.name for path in folder.iterdir()} == {INDEX, *(path.name for path in found.values())}
    return found


@pytest.mark.thorough
def test_what_has_not_changed_takes_no_room_again_and_the_oldest_go(runtime: Runtime, tmp_path: Path) -> None:
    shelf = Shelf(tmp_path / SAVED)
    shelf.set_schedule(BackupSchedule(keep=2))
    hall, _ = fill(runtime, "hall", "lab")
    first, second = backed_up(runtime), backed_up(runtime)
    hall.enrol(enrolments(50, 1, "q", "tuesday"))
    third = backed_up(runtime)
    assert [one.result and one.result["unchanged"] for one in (first, second, third)] == [0, 2, 1]
    assert third.result and (third.result["maps"], third.result["deleted"]) == (2, 1)
    kept = shelf.backups()
    assert [one.name for one in kept] == [one.result["backup"] for one in (third, second) if one.result]
    new, old = (files_of(shelf.folder / one.name) for one in kept)
    assert new["lab"].samefile(old["lab"]) and not new["hall"].samefile(old["hall"])
    assert kept[0].index.find("hall").places == 4 and kept[1].index.find("hall").places == 3  # type: ignore[union-attr]


def test_what_was_saved_by_another_process_is_linked_too(runtime: Runtime, tmp_path: Path) -> None:
    fill(runtime, "hall")
    backed_up(runtime)
    again = Backups(runtime.settings, runtime.engine, runtime.jobs)  # it does not know the state of the map
    job = end_of(runtime, again.submit())
    assert job.result and job.result["unchanged"] == 1
    new, old = (files_of(tmp_path / SAVED / one.name) for one in Shelf(tmp_path / SAVED).backups())
    assert new["hall"].samefile(old["hall"])
    old["hall"].write_bytes(b"torn")  # another size: it is written again
    (whole,) = files_of(tmp_path / SAVED / str(backed_up(runtime).result["backup"])).values()  # type: ignore[index]
    assert whole.stat().st_size > 4


def test_a_map_that_is_restored_is_the_one_that_was_saved(runtime: Runtime, tmp_path: Path) -> None:
    fill(runtime, "hall")
    before = state_of(runtime.engine, "hall")
    job = backed_up(runtime)
    assert job.result is not None
    runtime.engine.maps.delete("hall")
    with Archive(files_of(tmp_path / SAVED / job.result["backup"])["hall"]) as archive:
        runtime.engine.maps.import_map(archive, "hall", lambda *_: None, lambda _: None, 10**6, lambda _: None)
    assert state_of(runtime.engine, "hall") == before


def test_a_damaged_map_keeps_the_file_that_it_had_and_is_told(tmp_path: Path) -> None:
    with runtime_at(tmp_path, backup_dir=tmp_path / SAVED) as runtime:
        fill(runtime, "hall", "lab")
        backed_up(runtime)
    (tmp_path / "data" / "maps" / "hall" / "map.sqlite").write_bytes(b"no database" * 1000)
    with runtime_at(tmp_path, backup_dir=tmp_path / SAVED) as runtime:
        runtime.engine.maps.get("lab").enrol(enrolments(70, 1, "q", "tuesday"))
        job = backed_up(runtime)
        assert job.state == "failed" and job.problem is not None
        assert job.problem["type"].endswith(":backup-incomplete")
        assert job.problem["detail"].startswith("1 of 2 maps could not be saved. hall: ")
        shelf = Shelf(tmp_path / SAVED)
        new, old = (files_of(shelf.folder / one.name) for one in shelf.backups())
        assert new["hall"].samefile(old["hall"]) and not new["lab"].samefile(old["lab"])
        pace = timedelta(hours=24)  # it left a backup, so the next one is not hurried
        assert runtime.backups.next_at(shelf.schedule(), shelf.backups(), job) == shelf.backups()[0].at + pace


def test_a_backup_is_due_after_its_interval_and_sooner_after_a_failure(tmp_path: Path) -> None:
    (tmp_path / "disk").write_text("no folder")
    with runtime_at(tmp_path, backup_dir=tmp_path / "disk" / SAVED) as runtime:
        fill(runtime, "hall")
        backups, shelf = runtime.backups, Shelf(tmp_path / "disk" / SAVED)
        failed = backed_up(runtime)
        assert failed.state == "failed" and failed.problem and failed.problem["type"].endswith(":storage-failure")
        assert failed.ended_at is not None
        (tmp_path / "disk").unlink()  # now the disk is there
        assert backups.check(failed.ended_at + AGAIN - SETTLED) is None
        begun = backups.check(failed.ended_at + AGAIN)
        assert begun is not None
        job = end_of(runtime, begun)
        (made,) = shelf.backups()
        assert job.result and made.name == job.result["backup"]
        for hours, keep in ((1, 7), (None, 3)):
            shelf.set_schedule(BackupSchedule(hours=hours, keep=keep))
            assert shelf.schedule() == BackupSchedule(hours=hours, keep=keep)
            assert (backups.check(made.at + timedelta(hours=1)) is None) == (hours is None)
        assert backups.newest() == made.at == moment_of(name_of(made.at))
        end_of(runtime, runtime.jobs.all()[-1])


def test_where_there_is_no_place_none_is_due_and_none_is_displaced(runtime: Runtime, tmp_path: Path) -> None:
    backups, shelf, later = runtime.backups, Shelf(tmp_path / SAVED), datetime.now(UTC) + timedelta(days=2)
    assert backups.check(later) is None and backups.next_at(shelf.schedule(), [], None) is None
    asked = backed_up(runtime)  # who asks for one gets one of nothing
    assert asked.result and (asked.result["maps"], asked.result["bytes"]) == (0, 0)
    runtime.engine.maps.create("lab", ENCODER, 8)
    assert backups.next_at(shelf.schedule(), shelf.backups(), asked) is None, "it has no place yet"
    backed_up(runtime)  # one of an empty map postpones none either
    fill(runtime, "hall")
    assert backups.check(later) is None, "more may come"
    assert backups.next_at(shelf.schedule(), shelf.backups(), None) == later + SETTLED
    first = backups.check(later + SETTLED)
    assert first is not None and (end_of(runtime, first).result or {})["maps"] == 2
    runtime.engine.maps.delete("hall")
    assert backups.check(later + timedelta(days=2)) is None


def test_the_first_backup_waits_until_no_place_is_added_but_not_for_ever(runtime: Runtime, tmp_path: Path) -> None:
    backups, start = runtime.backups, datetime.now(UTC) + timedelta(days=1)
    (hall,) = fill(runtime, "hall")
    assert backups.check(start) is None
    hall.enrol(enrolments(50, 1, "q", "tuesday"))
    assert backups.check(start + SETTLED) is None, "a place was added meanwhile"
    assert backups.check(start + 1.9 * SETTLED) is None
    hall.enrol(enrolments(60, 1, "r", "tuesday"))
    first = backups.check(start + PATIENCE)
    assert first is not None and end_of(runtime, first).state == "succeeded"
    assert Shelf(tmp_path / SAVED).backups()[0].index.find("hall").places == 5  # type: ignore[union-attr]


def test_what_was_begun_is_gone_on_with_or_removed(runtime: Runtime, tmp_path: Path) -> None:
    shelf = Shelf(tmp_path / SAVED)
    left = name_of(datetime.now(UTC) - timedelta(days=1))
    begun = shelf.begin(left)
    (begun / "hall.0123456789abcdef.tar").write_text("half")
    assert shelf.begin(left) == begun and list(begun.iterdir()), "by the same name it is gone on with"
    fill(runtime, "hall")
    job = backed_up(runtime)
    assert job.result is not None
    assert {path.name for path in shelf.folder.iterdir()} == {"LOCK", job.result["backup"]}
    assert shelf.backups()[0].index.find("hall") is not None
    shutil.rmtree(shelf.folder)
    assert shelf.backups() == [] and runtime.backups.newest() is None


def test_without_a_folder_there_are_no_backups(tmp_path: Path) -> None:
    with runtime_at(tmp_path) as runtime:
        assert not runtime.backups.enabled and runtime.backups.newest() is None
        with pytest.raises(BackupFolderMissing):
            runtime.backups.submit()
