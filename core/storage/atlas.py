"""The data directory: all maps, each in a folder of its own, and a lock that keeps other processes out.

LOCK                              locked as long as the atlas is open
FORMAT                            the version of this layout
maps/<id>/map.sqlite              the map's record, its places, sequences and pictures, and which descriptor rows count
maps/<id>/descriptors-….seg       descriptors
maps/<id>/….index                 codes by which all but small maps are searched
maps/.unlisted-<id>/…             a map that is being built; it is listed when it is complete
"""

from __future__ import annotations

import logging
import os
import secrets
import shutil
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from core.disk.files import Damage, FolderLock, check_writable, disk_errors, make_folder, sync_folder, write_file
from core.disk.permissions import PRIVATE_FOLDER
from core.errors import DataDirectoryTooNew, MapExists, MapQuarantined, StorageFailure, StorageFull, UnknownMap
from core.maps.archives.reading import Archive
from core.maps.enrolling import CheckDescriptors, any_descriptors
from core.maps.pagination import Listing, decode_name, one_more, page_of
from core.maps.records import MapRecord, MapSettings, Precision, VerifyReport
from core.maps.status import Progress, no_progress
from core.places import check_map_id
from core.storage.archives.building import build
from core.storage.files.row_formats import HALF
from core.storage.files.segment_files import NO_LOCAL, ROWS_PER_SEGMENT, Layout
from core.storage.map import Map
from core.storage.opening import UNLISTED, create_folder, read_record
from core.storage.verification import inspect_folder

log = logging.getLogger(__name__)

FORMAT = "placerec data 2\n"
EARLIER = ("placerec data 1\n",)
"""Directories of these forms are brought up to date as their maps are opened, and earlier versions then refuse them."""
_MAPS = "maps"
# No map id begins with a dot, so these folders are never mistaken for maps.
_HALF_MADE, _HALF_REMOVED = ".making-", ".removing-"


def has_map(directory: Path, map_id: str) -> bool:
    """Whether a data directory, which a service may be using, has a map of this id, sound or damaged."""
    return (directory / _MAPS / map_id).is_dir()


class Atlas:
    """All maps of a data directory (:class:`core.maps.store.Store`).

    Any thread may call any method; one process uses the directory at a time.
    """

    def __init__(self, directory: Path, rows_per_segment: int = ROWS_PER_SEGMENT) -> None:
        """Lock the directory, make it if it is missing, and read the record of every map.

        Args:
            rows_per_segment: rows of a full segment file of new maps; existing maps keep theirs.

        Raises:
            DataDirectoryLocked: another process uses it.
            DataDirectoryTooNew: a later version of placerec wrote it, or one of its maps.
            DataDirectoryTooOld: one of its maps was written before the first release.
            StorageFull, StorageFailure: the disk refuses.
        """
        self._directory = directory
        self._folder = directory / _MAPS
        self._rows_per_segment = rows_per_segment
        self._making = threading.Lock()  # held while a map is made or deleted
        self._maps: dict[str, Map] = {}
        self._unlisted: dict[str, Map] = {}
        self._reserved: set[str] = set()
        # Maps that could not be read at the start, and why: damaged files, or errors of the disk.
        self._damaged: dict[str, str] = {}
        self._refused: dict[str, str] = {}
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
            write_file(path, FORMAT.encode())
            return
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
                self._unlisted[folder.name.removeprefix(UNLISTED)] = Map(folder, *read_record(folder))
        except Damage as damage:
            log.error("Removing the unfinished map %s: %s", folder.name, damage)
            shutil.rmtree(folder, ignore_errors=True)
        except (StorageFull, StorageFailure) as refusal:
            log.error("The unfinished map %s cannot be opened: %s", folder.name, refusal)

    def _adopt(self, folder: Path) -> None:
        self._refused.pop(folder.name, None)
        try:
            with disk_errors(f"open map {folder.name!r}"):
                self._maps[folder.name] = Map(folder, *read_record(folder))
        except Damage as damage:
            log.error("Map %s is quarantined: %s", folder.name, damage)
            self._damaged[folder.name] = str(damage)
        except (StorageFull, StorageFailure) as refusal:
            # The other maps are served; this one is tried again when it is used.
            log.error("Map %s cannot be opened: %s", folder.name, refusal)
            self._refused[folder.name] = str(refusal)

    def create(
        self,
        map_id: str,
        encoder_identity: str,
        dimension: int,
        settings: MapSettings | None = None,
        local_shape: tuple[int, int] = NO_LOCAL,
        unlisted: bool = False,
        precision: Precision = HALF,
    ) -> Map:
        check_map_id(map_id)
        # Raises ValueError for values that no segment file can hold.
        Layout(dimension, encoder_identity, self._rows_per_segment, local_shape, precision)
        record = MapRecord.new(map_id, encoder_identity, dimension, local_shape, precision, settings)
        with self._making, disk_errors(f"create map {map_id!r}"):
            self._expect_open()
            self._expect_free(map_id)
            folder = self._folder / map_id
            folder = self._folder / f"{UNLISTED}{map_id}" if unlisted else folder
            unfinished = self._folder / f"{_HALF_MADE}{map_id}-{secrets.token_hex(4)}"
            try:
                create_folder(unfinished, record, self._rows_per_segment)
                os.rename(unfinished, folder)
                sync_folder(self._folder)
            except BaseException:
                shutil.rmtree(unfinished, ignore_errors=True)
                shutil.rmtree(folder, ignore_errors=True)
                raise
            made = Map(folder, record)
            (self._unlisted if unlisted else self._maps)[map_id] = made
        return made

    def _expect_free(self, map_id: str) -> None:
        if map_id in self._maps or (self._folder / map_id).exists():
            raise MapExists(f"There is already a map {map_id!r}.")
        if map_id in self._unlisted or map_id in self._reserved:
            raise MapExists(f"A map {map_id!r} is being made.")

    @contextmanager
    def building(self, map_id: str) -> Iterator[Path]:
        """The path of a folder that the block makes; it is listed as a map when the block ends without an error.

        Until then the map is not found, and a crash leaves nothing of it.  The id is reserved meanwhile.

        Raises:
            InvalidIdentifier: the id is malformed.
            MapExists: the id is taken.
            StorageFull, StorageFailure.
        """
        check_map_id(map_id)
        with self._making:
            self._expect_open()
            self._expect_free(map_id)
            self._reserved.add(map_id)
        unfinished = self._folder / f"{_HALF_MADE}{map_id}-{secrets.token_hex(4)}"
        try:
            with disk_errors(f"make map {map_id!r}"):
                yield unfinished
                with self._making:
                    self._expect_open()
                    folder = self._folder / map_id
                    os.rename(unfinished, folder)
                    try:
                        made = Map(folder, *read_record(folder))
                        sync_folder(self._folder)
                    except BaseException:
                        os.rename(folder, unfinished)
                        raise
                    self._maps[map_id] = made
        finally:
            self._reserved.discard(map_id)
            shutil.rmtree(unfinished, ignore_errors=True)

    def import_map(
        self,
        archive: Archive,
        map_id: str,
        advance: Callable[[int, int], None],
        check_picture: Callable[[bytes], None],
        most_picture_bytes: int,
        before_listing: Callable[[int], None],
        check_descriptors: CheckDescriptors = any_descriptors,
    ) -> None:
        """Make a map of an export file (:meth:`core.maps.store.Store.import_map`)."""
        try:
            with self.building(map_id) as folder:
                places = build(
                    archive,
                    folder,
                    map_id,
                    advance=advance,
                    check_picture=check_picture,
                    most_picture_bytes=most_picture_bytes,
                    check_descriptors=check_descriptors,
                )
                before_listing(places)
        except Damage as damage:
            raise StorageFailure(f"The disk did not keep what was written: {damage}.") from damage

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
            places = made.count_places()
            made.close()
            try:
                os.rename(unfinished, folder)
            except OSError:
                self._unlisted[map_id] = Map(unfinished, made.record, places)
                raise
            del self._unlisted[map_id]
            listed = self._maps[map_id] = Map(folder, made.record, places)
            sync_folder(self._folder)
        return listed

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
            found.close(deleted=True)
        try:
            os.rename(folder, removed)
        except FileNotFoundError:
            log.warning("The folder of map %s was already gone.", map_id)
        except OSError:
            if found is not None:
                among[map_id] = Map(folder, found.record, found.count_places())
            raise
        among.pop(map_id, None)
        sync_folder(self._folder)
        return removed

    def get(self, map_id: str) -> Map:
        """A map, ready for use; its first use reads it from disk.

        Raises:
            UnknownMap, MapQuarantined, StorageFailure.
        """
        found = self.find(map_id)
        found.open()
        return found

    def opened(self, map_id: str) -> Map | None:
        """A map that is in service and was read from disk before; None otherwise.  This never waits."""
        found = self._maps.get(map_id)
        return found if found is not None and found.is_open else None

    @property
    def open_maps(self) -> int:
        """The number of maps that were read from disk and are in service."""
        return sum(one.is_open for one in self._maps.copy().values())

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
        found.check_serving()
        return found

    def _absent(self, map_id: str) -> UnknownMap | MapQuarantined | StorageFailure:
        if reason := self._refused.get(map_id):
            return StorageFailure(reason)
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
        return {**self._damaged, **self._refused, **found_later}

    def verify(self, map_id: str, progress: Progress = no_progress) -> VerifyReport:
        with suppress(MapQuarantined):
            return self.get(map_id).verify(progress)
        report = inspect_folder(self._folder / map_id, progress)
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

    def check_writable(self) -> None:
        """Write, sync and delete a small file, to see that maps could be written.

        Raises:
            StorageFull, StorageFailure.
        """
        self._expect_open()
        check_writable(self._directory)

    def check_pictures(self) -> None:
        """Pictures are stored with the rest."""

    def close(self) -> None:
        """Wait for reads and writes under way, close all maps, and release the lock on the directory."""
        with self._making:
            self._closed = True
            for found in [*self._maps.values(), *self._unlisted.values()]:
                found.close()
            self._lock.release()

    def _expect_open(self) -> None:
        if self._closed:
            raise StorageFailure("The data directory is closed.")
