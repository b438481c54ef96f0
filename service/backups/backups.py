"""Backups that the service makes by itself: a thread that submits the job when one is due, and the job.

The job saves one map after the other, without holding up answers or writes.  A map that cannot be read, because it is
damaged, keeps the file of the backup before, and the job ends as failed, which is an alarm; the others are saved.
"""

from __future__ import annotations

import logging
import shutil
import threading
import weakref
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

from core.disk.files import FolderLock, disk_errors, sync_file
from core.errors import MapQuarantined, PlacerecError, StorageFailure, StorageFull, UnknownMap
from core.store import Map
from service.backups.index import BackupEntry, BackupIndex, InvalidIndex, file_name
from service.backups.shelf import Backup, BackupSchedule, Shelf, name_of, take_over
from service.engine.engine import Engine
from service.errors.faults import BackupFolderMissing, BackupIncomplete
from service.jobs.context import JobCancelled, JobContext
from service.jobs.job import Job
from service.jobs.jobs import Jobs
from service.places.staging import RESERVE
from service.settings import Settings

KIND = "backup"

CHECK_SECONDS = 20.0
"""Whether a backup is due is looked at this often."""

CHECK_SECONDS_FIRST = 1.0
"""And this often before the first one, so that it is made soon."""

SETTLED = timedelta(seconds=5)
"""The first backup is begun when no place was enrolled for this time: one made before would have a part of the first
map, and the next one is due after the interval."""

PATIENCE = timedelta(minutes=10)
"""If places are enrolled all the time, the first backup is begun after this time."""

AGAIN = timedelta(hours=1)
"""After a backup that has failed, the next one is begun after this time, or after the interval if that is shorter."""

log = logging.getLogger("placerec.backups")


class Backups:
    """The backups of a service, or of all services that share maps and the folder.

    Args:
        settings: ``backup_dir`` is the folder; without it there are no backups.
    """

    def __init__(self, settings: Settings, engine: Engine, jobs: Jobs) -> None:
        self._engine, self._jobs = engine, jobs
        self._shelf = None if settings.backup_dir is None else Shelf(settings.backup_dir)
        self._tags: weakref.WeakKeyDictionary[Map, tuple[object, str]] = weakref.WeakKeyDictionary()
        """The state of each map when it was last saved, and the tag of its file."""
        self._began = datetime.now(UTC)
        self._enrolled: tuple[int, datetime, datetime] | None = None
        """How many places there are before the first backup, since when, and when there were some at first."""
        self._submitting = threading.Lock()
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="backups", daemon=True)
        if self._shelf is not None:  # a service without the folder leaves the job to one that has it
            jobs.register(KIND, self.make)

    @property
    def enabled(self) -> bool:
        """Whether there is a folder for backups."""
        return self._shelf is not None

    def start(self) -> None:
        """Begin to look whether a backup is due."""
        if self._shelf is not None:
            self._thread.start()

    def close(self) -> None:
        """Stop looking; a job that runs is stopped with the others."""
        self._stopping.set()
        if self._thread.is_alive():
            self._thread.join()

    # Asking

    def shelf(self) -> Shelf:
        """The folder of backups.

        Raises:
            BackupFolderMissing: no setting names one.
        """
        if self._shelf is None:
            raise BackupFolderMissing("The setting PLACEREC_BACKUP_DIR names no folder for backups.")
        return self._shelf

    def newest(self) -> datetime | None:
        """When the newest backup was begun; None: there is none, or the folder cannot be read."""
        with suppress(OSError):
            return None if self._shelf is None else self._shelf.newest()
        return None

    def latest(self) -> Job | None:
        """The job of the latest backup that is remembered, whatever became of it."""
        return next((job for job in reversed(self._jobs.all()) if job.kind == KIND), None)

    @property
    def empty(self) -> bool:
        """Whether no map has a place, and none is damaged.

        Raises:
            StorageFailure: the maps cannot be listed.
        """
        return not self._engine.maps.quarantined() and not any(self._counts())

    def _counts(self) -> Iterator[int]:
        """The number of places of each map."""
        for record in self._engine.all_records():
            with suppress(UnknownMap, MapQuarantined):  # it was deleted or found to be damaged since it was listed
                yield self._engine.maps.find(record.id).count_places()

    def next_at(self, schedule: BackupSchedule, backups: list[Backup], latest: Job | None) -> datetime | None:
        """When the next backup is begun: a moment that may be over; None: none is, by itself.

        While no map has a place none is: backups of nothing would take the places of those that have maps, as where a
        service was started on the wrong folder; one that somebody asked for postpones none.

        Args:
            backups: those that there are, the newest first.
            latest: the job of the latest one.

        Raises:
            StorageFailure: the maps cannot be listed.
        """
        if schedule.hours is None or self.empty:
            return None
        pace = timedelta(hours=schedule.hours)
        saved = _latest_of_places(backups)
        due = self._first_at() if saved is None else saved.at + pace
        if latest is None or latest.state not in ("failed", "cancelled") or latest.ended_at is None:
            return due
        left_one = latest.problem is not None and str(latest.problem["type"]).endswith(":backup-incomplete")
        return due if left_one else max(due, latest.ended_at + min(pace, AGAIN))

    def submit(self) -> Job:
        """Submit the job that makes a backup now; the one that waits or runs, if there is one.

        Raises:
            BackupFolderMissing, JobQueueFull, StorageFull, StorageFailure.
        """
        self.shelf()
        with self._submitting:
            latest = self.latest()
            return latest if latest is not None and not latest.ended else self._jobs.submit(KIND, None)

    # Looking

    def _run(self) -> None:
        while not self._stopping.is_set():
            seconds = CHECK_SECONDS
            try:
                self.check(datetime.now(UTC))
                seconds = CHECK_SECONDS_FIRST if self.newest() is None and self.latest() is None else CHECK_SECONDS
            except (PlacerecError, OSError) as error:
                log.warning("it cannot be said whether a backup is due: %s", error)
            except Exception:  # a defect, which must not end the thread
                log.exception("it cannot be said whether a backup is due")
            self._stopping.wait(seconds)

    def check(self, now: datetime) -> Job | None:
        """Submit a backup if one is due; returns its job.

        Raises:
            BackupFolderMissing, JobQueueFull, StorageFull, StorageFailure.
            OSError: the folder cannot be read.
        """
        shelf, latest = self.shelf(), self.latest()
        if latest is not None and not latest.ended:
            return None
        schedule, backups = shelf.schedule(), shelf.backups()
        if schedule.hours is not None and _latest_of_places(backups) is None and (places := sum(self._counts())):
            before, since, first = self._enrolled or (places, now, now)
            self._enrolled = places, since if places == before else now, first
        due = self.next_at(schedule, backups, latest)
        return self.submit() if due is not None and due <= now else None

    def _first_at(self) -> datetime:
        """When the first backup is begun."""
        if self._enrolled is None:
            return self._began
        _, since, first = self._enrolled
        return min(since + SETTLED, first + PATIENCE)

    # Making

    def make(self, context: JobContext) -> Mapping[str, Any]:
        """Save all maps; an attempt after a restart goes on with the maps that are not saved yet.

        Raises:
            BackupIncomplete: some maps could not be saved; all others are.
            DataDirectoryLocked: another service writes to the folder.
            StorageFull, StorageFailure: nothing of this backup is left.
            JobCancelled, JobInterrupted.
        """
        shelf = self.shelf()
        with disk_errors("write a backup"):
            while (name := str(context.notes.get("name") or name_of(datetime.now(UTC)))) in shelf.names():
                if "name" in context.notes:  # it was made before the service was killed
                    return {"backup": name}
                context.pause(0.2)  # until the second is over
            context.remember(name=name)
            begun = shelf.begin(name)
            lock = FolderLock(shelf.folder / "LOCK")
        try:
            with disk_errors("write a backup"):
                return self._make(context, shelf, name, begun)
        except (JobCancelled, StorageFull, StorageFailure):
            shelf.discard(name)
            raise
        finally:
            lock.release()

    def _make(self, context: JobContext, shelf: Shelf, name: str, begun: Path) -> Mapping[str, Any]:
        earlier = next((one for one in shelf.backups() if one.name != name), None)
        index = BackupIndex()
        with suppress(OSError, InvalidIndex):  # what an attempt before this one has saved
            index = BackupIndex.read(begun)
        failed, unchanged = dict(self._engine.maps.quarantined()), 0
        ids = [record.id for record in self._engine.all_records()]
        for number, map_id in enumerate(ids):
            context.check_cancelled()
            context.progress(number, len(ids), map_id)
            if index.find(map_id) is None:
                try:
                    unchanged += self._save(context, map_id, begun, index, shelf, earlier)
                except (StorageFull, UnknownMap) as error:
                    if isinstance(error, StorageFull):
                        raise
                except PlacerecError as error:
                    failed[map_id] = str(error)
        for map_id in failed:
            self._keep(map_id, begun, index, shelf, earlier)
        index.write(begun)
        context.progress(len(ids), len(ids))
        shelf.complete(name)
        deleted = shelf.thin_out(shelf.schedule().keep)
        facts = {"backup": name, "maps": len(index.maps), "bytes": sum(one.bytes for one in index.maps)}
        facts |= {"unchanged": unchanged, "deleted": deleted}
        if failed:
            told = "; ".join(f"{map_id}: {why}" for map_id, why in sorted(failed.items()))
            log.warning("the backup %s lacks the present state of %s maps: %s", name, len(failed), told)
            raise BackupIncomplete(f"{len(failed)} of {len(ids) + len(failed)} maps could not be saved. {told}"[:2000])
        log.info("backup made", extra=facts)
        return facts

    def _save(
        self, context: JobContext, map_id: str, begun: Path, index: BackupIndex, shelf: Shelf, earlier: Backup | None
    ) -> bool:
        """Save a map; whether it is as it was in the backup before, whose file it then has.

        Raises:
            UnknownMap, MapQuarantined, StorageFull, StorageFailure.
        """
        map_ = self._engine.maps.find(map_id)
        known = None if earlier is None else earlier.index.find(map_id)
        state, tag = self._tags.get(map_, (None, ""))
        if known is not None and state is not None and tag == known.manifest_sha256 and state == map_.exporter.state():
            with suppress(FileNotFoundError):  # somebody has removed it
                return self._take_over(known, begun, index, shelf, earlier)
        map_.open()
        state = map_.exporter.state()  # read first, so that a change meanwhile is noticed
        written = begun / f".{map_id}"

        def expect(size: int) -> None:
            if shutil.disk_usage(begun).free < size + RESERVE:
                raise StorageFull(f"The disk of the backups has no room for the {size} bytes of the map {map_id!r}.")

        written.unlink(missing_ok=True)
        exported = map_.exporter.write(written, lambda _count: context.check_cancelled(), expect)
        self._tags[map_] = state, exported.tag
        if known is not None and exported.tag == known.manifest_sha256:
            with suppress(FileNotFoundError):
                written_again = self._take_over(known, begun, index, shelf, earlier)
                written.unlink()
                return written_again
        file = begun / file_name(map_id, exported.tag)
        sync_file(written)
        written.replace(file)
        entry = BackupEntry(
            id=map_id,
            file=file.name,
            manifest_sha256=exported.tag,
            bytes=exported.size,
            places=exported.manifest.places,
            saved_at=datetime.now(UTC),
        )
        index.put(entry)
        index.write(begun)
        return False

    def _take_over(
        self, known: BackupEntry, begun: Path, index: BackupIndex, shelf: Shelf, earlier: Backup | None
    ) -> bool:
        """Let the backup have the file that the one before has; raises FileNotFoundError if that is gone."""
        if earlier is None:
            return False
        take_over(shelf.folder / earlier.name / known.file, known.bytes, begun / known.file)
        index.put(known)
        index.write(begun)
        return True

    def _keep(self, map_id: str, begun: Path, index: BackupIndex, shelf: Shelf, earlier: Backup | None) -> None:
        """Let a map that cannot be saved have the file that it had in the backup before, if there was one."""
        (begun / f".{map_id}").unlink(missing_ok=True)
        known = None if earlier is None else earlier.index.find(map_id)
        if known is not None:
            with suppress(FileNotFoundError):
                self._take_over(known, begun, index, shelf, earlier)


def _latest_of_places(backups: Sequence[Backup]) -> Backup | None:
    """Of backups, the newest first, the newest that has places; None: none has."""
    return next((backup for backup in backups if any(saved.places for saved in backup.index.maps)), None)
