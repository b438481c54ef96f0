"""The data directory: all maps, each in a folder of its own, and a lock that keeps other processes out.

LOCK                    locked as long as the directory is open
FORMAT                  the version of this layout
maps/<id>/map.sqlite    the map
maps/.unlisted-<id>/…   a map that is being built; it is listed when it is complete
"""

from __future__ import annotations

import logging
import os
import secrets
import shutil
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from core.disk.files import Damage, FolderLock, check_writable, disk_errors, make_folder, sync_folder, write_file
from core.disk.permissions import PRIVATE_FOLDER
from core.errors import (
    DataDirectoryTooNew,
    DataDirectoryTooOld,
    MapExists,
    MapQuarantined,
    PlacerecError,
    StorageFailure,
    StorageFull,
    UnknownMap,
)
from core.ledger.maps.record import MapState
from core.maps.pagination import Listing, decode_name, one_more, page_of
from core.maps.records import MapRecord, VerifyReport
from core.maps.status import Progress, no_progress
from core.store.file import FILE, MapFile, OpenFiles, create
from core.store.following import ROWS_PER_SEGMENT
from core.store.map import Map
from core.store.rows import RowCache
from core.store.store import Store
from core.store.verification import inspect

if TYPE_CHECKING:
    from core.index.milvus import Milvus

log = logging.getLogger(__name__)

MOST_OPEN = 200

CACHE_BYTES = 64 << 20
"""The size of the cache of rows, unless another is given; the system keeps those of the files that are read often."""

FORMAT = "placerec data 3\n"
EARLIER = ("placerec data 1\n", "placerec data 2\n")
_MAPS = "maps"

UNLISTED = ".unlisted-"
"""Prefix of the folder of a map that is being built; no map id begins with a dot."""

# No map id begins with a dot, so these folders are never mistaken for maps.
_HALF_MADE, _HALF_REMOVED = ".making-", ".removing-"


def has_map(directory: Path, map_id: str) -> bool:
    """Whether a data directory, which a service may be using, has a map of this id, sound or damaged."""
    return (directory / _MAPS / map_id).is_dir()


class Directory(Store):
    """All maps of a data directory, which one process uses at a time."""

    def __init__(
        self,
        directory: Path,
        most_open: int = MOST_OPEN,
        cache_bytes: int = CACHE_BYTES,
        rows_per_segment: int = ROWS_PER_SEGMENT,
        milvus: Milvus | None = None,
    ) -> None:
        """Lock the directory, make it if it is missing, and read the record of every map.

        Args:
            most_open: maps that are open together; those used least are closed for others.
            cache_bytes: most bytes of rows that are kept in memory.
            rows_per_segment: of snapshots.
            milvus: has the codes of large maps; None: memory has those of all.

        Raises:
            DataDirectoryLocked: another process uses it.
            DataDirectoryTooNew: a later version of placerec wrote it, or one of its maps.
            DataDirectoryTooOld: an earlier version wrote it.
            StorageFull, StorageFailure: the disk refuses.
        """
        self._directory = directory
        self._folder = directory / _MAPS
        self._rows_per_segment, self._cache = rows_per_segment, RowCache(cache_bytes)
        self._open_files, self.milvus = OpenFiles(most_open), milvus
        self._making = threading.Lock()  # held while a map is made or deleted
        self._maps: dict[str, Map] = {}
        self._unlisted: dict[str, Map] = {}
        self._reserved: set[str] = set()
        # Maps that could not be read at the start, and why: damaged files, or errors of the disk.
        self._damaged: dict[str, str] = {}
        self._refused: dict[str, PlacerecError] = {}
        self._closed = False
        with disk_errors(f"open the data directory {directory}"):
            make_folder(directory)
            self._lock = FolderLock(directory / "LOCK")
            try:
                self._check_format()
                self._folder.mkdir(PRIVATE_FOLDER, exist_ok=True)
                sync_folder(directory)
                self._scan()
            except BaseException:
                self._lock.release()
                raise

    def _check_format(self) -> None:
        path = self._directory / "FORMAT"
        try:
            found = path.read_text(errors="replace")
        except FileNotFoundError:
            write_file(path, FORMAT.encode())
            return
        if found == FORMAT:
            return
        if found in EARLIER:
            raise DataDirectoryTooOld(
                f"{self._directory} was written by placerec 1: export its maps with that version, and import the files"
                " into a new data directory."
            )
        if found.startswith("placerec data "):
            raise DataDirectoryTooNew(
                f"{self._directory} was written by a later version of placerec ({found.strip()})."
            )
        raise StorageFailure(f"{path} was not written by placerec: is this the right directory?")

    def _scan(self) -> None:
        for folder in sorted(self._folder.iterdir()):
            if folder.name.startswith((_HALF_MADE, _HALF_REMOVED)):
                log.info("Removing %s, left by a crash.", folder.name)
                shutil.rmtree(folder, ignore_errors=True)
            elif folder.name.startswith(UNLISTED):
                self._adopt_unlisted(folder)
            elif folder.is_dir() and not folder.name.startswith("."):
                self._adopt(folder)

    def _adopt_unlisted(self, folder: Path) -> None:
        try:
            with disk_errors(f"open map {folder.name!r}"):
                self._unlisted[folder.name.removeprefix(UNLISTED)] = self._read(folder)
        except Damage as damage:
            log.error("Removing the unfinished map %s: %s", folder.name, damage)
            shutil.rmtree(folder, ignore_errors=True)
        except (StorageFull, StorageFailure) as refusal:
            log.error("The unfinished map %s cannot be opened: %s", folder.name, refusal)

    def _adopt(self, folder: Path) -> None:
        self._refused.pop(folder.name, None)
        try:
            with disk_errors(f"open map {folder.name!r}"):
                self._maps[folder.name] = self._read(folder)
        except Damage as damage:
            log.error("Map %s is quarantined: %s", folder.name, damage)
            self._damaged[folder.name] = str(damage)
        except (StorageFull, StorageFailure) as refusal:
            # The other maps are served; this one is tried again when it is used.
            log.error("Map %s cannot be opened: %s", folder.name, refusal)
            self._refused[folder.name] = refusal

    def _make(self, made: MapRecord, unlisted: bool) -> Map:
        with self._making, disk_errors(f"create map {made.id!r}"):
            self._expect_open()
            self._expect_free(made.id)
            folder = self._folder / (f"{UNLISTED}{made.id}" if unlisted else made.id)
            unfinished = self._folder / f"{_HALF_MADE}{made.id}-{secrets.token_hex(4)}"
            try:
                create(unfinished, made)
                os.rename(unfinished, folder)
                sync_folder(self._folder)
                found = self._found(folder, MapState(1, made))
            except BaseException:
                shutil.rmtree(unfinished, ignore_errors=True)
                shutil.rmtree(folder, ignore_errors=True)
                raise
            (self._unlisted if unlisted else self._maps)[made.id] = found
        return found

    def _read(self, folder: Path) -> Map:
        """The map in a folder, of which only the record is read.

        Raises:
            DataDirectoryTooNew, DataDirectoryTooOld: its file is of a version that is not read.
            Damage: it is not a map, or another one than its folder says.
            StorageFull, StorageFailure: the disk refuses.
        """
        file = MapFile(folder, OpenFiles(1))
        try:
            state = file.state()
            if state.record.id != folder.name.removeprefix(UNLISTED) and not folder.name.startswith(_HALF_MADE):
                raise Damage(f"{FILE}: it belongs to the map {state.record.id!r}")
        finally:
            file.rest()
        return self._found(folder, state)

    def _found(self, folder: Path, state: MapState) -> Map:
        """The map in a folder, which was found in a state."""
        file = MapFile(folder, self._open_files)
        made = Map(file, state, self._cache, self.milvus, self._rows_per_segment)
        file.rested = made.rest
        return made

    def _expect_free(self, map_id: str) -> None:
        if map_id in self._maps or (self._folder / map_id).exists():
            raise MapExists(f"There is already a map {map_id!r}.")
        if map_id in self._unlisted or map_id in self._reserved:
            raise MapExists(f"A map {map_id!r} is being made.")

    @contextmanager
    def _building(self, made: MapRecord) -> Iterator[Map]:
        with self._making:
            self._expect_open()
            self._expect_free(made.id)
            self._reserved.add(made.id)
        unfinished = self._folder / f"{_HALF_MADE}{made.id}-{secrets.token_hex(4)}"
        building: Map | None = None
        try:
            with disk_errors(f"make map {made.id!r}"):
                create(unfinished, made)
                building = self._found(unfinished, MapState(1, made))
                yield building
                if damage := building.database.check():
                    raise StorageFailure(f"The disk did not keep what was written: {damage[0]}.")
                state = building.latest()
                self._end(building)
                sync_folder(unfinished)  # the end of SQLite's log
                with self._making:
                    self._expect_open()
                    folder = self._folder / made.id
                    os.rename(unfinished, folder)
                    try:
                        sync_folder(self._folder)
                    except BaseException:
                        os.rename(folder, unfinished)
                        raise
                    self._maps[made.id] = self._found(folder, state)
        except Damage as damage:
            raise StorageFailure(f"The disk did not keep what was written: {damage}.") from damage
        finally:
            if building is not None:
                self._end(building)
            self._reserved.discard(made.id)
            shutil.rmtree(unfinished, ignore_errors=True)

    def unlisted(self) -> dict[str, Map]:
        return self._unlisted.copy()

    def abandoned(self) -> list[str]:
        """The ids of the maps that are being built, for one process uses the directory."""
        return list(self._unlisted)

    def publish(self, map_id: str) -> Map:
        with self._making, disk_errors(f"publish map {map_id!r}"):
            self._expect_open()
            made = self._unlisted.get(map_id)
            if made is None:
                raise UnknownMap(f"No map {map_id[:80]!r} is being made.")
            unfinished, folder = self._folder / f"{UNLISTED}{map_id}", self._folder / map_id
            state = made.latest()
            self._end(made)
            try:
                sync_folder(unfinished)  # the end of SQLite's log
                os.rename(unfinished, folder)
            except OSError:
                self._unlisted[map_id] = self._found(unfinished, state)
                raise
            del self._unlisted[map_id]
            listed = self._maps[map_id] = self._found(folder, state)
            sync_folder(self._folder)
        return listed

    def _end(self, found: Map, deleted: bool = False) -> None:
        found.end(deleted)
        assert isinstance(found.database, MapFile)
        found.database.close()

    def abandon(self, map_id: str) -> None:
        with self._making, disk_errors(f"remove map {map_id!r}"):
            made = self._unlisted.get(map_id)
            if made is None:
                return
            removed = self._rename_removed(made, self._folder / f"{UNLISTED}{map_id}", self._unlisted)
        shutil.rmtree(removed, ignore_errors=True)

    def _rename_removed(self, found: Map | None, folder: Path, among: dict[str, Map]) -> Path:
        """Close a map, rename its folder durably to a name that the next start would delete, and return that path."""
        map_id = folder.name.removeprefix(UNLISTED)
        removed = self._folder / f"{_HALF_REMOVED}{map_id}-{secrets.token_hex(4)}"
        if found is not None:
            self._end(found, deleted=True)
        try:
            os.rename(folder, removed)
        except FileNotFoundError:
            log.warning("The folder of map %s was already gone.", map_id)
        except OSError:
            if found is not None:
                among[map_id] = self._read(folder)
            raise
        among.pop(map_id, None)
        sync_folder(self._folder)
        return removed

    def get(self, map_id: str) -> Map:
        """A map, ready for use; its first use reads it from disk.

        Raises:
            UnknownMap, MapQuarantined, StorageFailure.
        """
        found = self._touched(self.find(map_id))
        found.open()
        return found

    def _touched(self, found: Map) -> Map:
        assert isinstance(found.database, MapFile)
        found.database.touch()
        return found

    def opened(self, map_id: str) -> Map | None:
        """A map that is in service and was read from disk before; None otherwise.  This never waits."""
        found = self._maps.get(map_id)
        return self._touched(found) if found is not None and found.is_open else None

    def find(self, map_id: str) -> Map:
        """A map whose record and number of places can be used without reading it from disk.

        Raises:
            UnknownMap, MapQuarantined, StorageFailure.
        """
        self._expect_open()
        if map_id in self._refused:
            with self._making:
                if map_id in self._refused:
                    self._adopt(self._folder / map_id)
        found = self._maps.get(map_id)
        if found is None:
            raise self._absent(map_id)
        found.expect_there()
        return found

    def _absent(self, map_id: str) -> PlacerecError:
        if refusal := self._refused.get(map_id):
            return type(refusal)(*refusal.args)
        if reason := self._damaged.get(map_id):
            return MapQuarantined(f"Map {map_id!r} is damaged and out of service: {reason}.")
        return UnknownMap(f"There is no map {map_id[:80]!r}.")

    def records(self, cursor: str | None, limit: int) -> tuple[list[MapRecord], str | None]:
        """A page of the maps' records by id, without quarantined maps, and the cursor of the next page.

        Raises:
            InvalidCursor.
        """
        wanted = one_more(limit)
        listing: Listing = ["maps"]
        after = decode_name(listing, cursor)
        maps = {map_id: found for map_id, found in self._maps.copy().items() if found.damage is None}
        following = sorted(map_id for map_id in maps if map_id > after)[:wanted]
        page, more = page_of(listing, following, limit, str)
        return [maps[map_id].record for map_id in page], more

    def quarantined(self) -> dict[str, str]:
        in_use = {map_id: found.damage for map_id, found in self._maps.copy().items()}
        found_later = {map_id: reason for map_id, reason in in_use.items() if reason is not None}
        refused = {map_id: str(refusal) for map_id, refusal in self._refused.items()}
        return {**self._damaged, **refused, **found_later}

    def verify(self, map_id: str, progress: Progress = no_progress) -> VerifyReport:
        with suppress(MapQuarantined):
            return self.get(map_id).verify(progress)
        report = inspect(MapFile(self._folder / map_id, OpenFiles(1)), map_id, None, progress)
        reason = f"out of service: {self.quarantined().get(map_id)}"
        return report.model_copy(update={"ok": False, "problems": [reason, *report.problems]})

    def delete(self, map_id: str) -> None:
        """Delete a map, which may be quarantined; the deletion is durable when this returns.

        Raises:
            UnknownMap, StorageFull, StorageFailure.
        """
        with self._making, disk_errors(f"delete map {map_id!r}"):
            self._expect_open()
            found = self._maps.get(map_id)
            if found is None and map_id not in self.quarantined():
                raise self._absent(map_id)
            removed = self._rename_removed(found, self._folder / map_id, self._maps)
            self._damaged.pop(map_id, None)
            self._refused.pop(map_id, None)
        # Files that cannot be deleted now are deleted at the next start.
        shutil.rmtree(removed, ignore_errors=True)
        if found is not None:
            self._drop_codes(found.record)

    def check_writable(self) -> None:
        """Write, sync and delete a small file, to see that maps could be written.

        Raises:
            StorageFull, StorageFailure.
        """
        self._expect_open()
        check_writable(self._directory)
        if self.milvus is not None:
            self.milvus.check()

    @property
    def open_maps(self) -> int:
        return len(self._open_files)

    def close(self) -> None:
        """Wait for reads and writes under way, close all maps, and release the lock on the directory."""
        with self._making:
            self._closed = True
            for found in [*self._maps.values(), *self._unlisted.values()]:
                self._end(found)
            self._lock.release()

    def _expect_open(self) -> None:
        if self._closed:
            raise StorageFailure("The data directory is closed.")
