"""Exports: maps as they were when a download began, kept for a while so that an interrupted download can go on."""

from __future__ import annotations

import asyncio
import logging
import secrets
import shutil
import time
import weakref
from collections.abc import AsyncIterator, Callable
from contextlib import suppress
from dataclasses import dataclass

from anyio import CapacityLimiter, to_thread
from starlette.responses import StreamingResponse
from starlette.types import Receive, Scope, Send

from core.storage import Map
from core.storage.archives.virtual_archive import CHUNK_BYTES, VirtualArchive
from service.errors.faults import NotReady, TooManyExports
from service.http.headers import Slice
from service.settings import Settings

FOLDER = "exports"
MEDIA_TYPE = "application/x-tar"

log = logging.getLogger("placerec.exports")


@dataclass(eq=False)
class Export:
    """A map as it was at one time.

    map: the object, since a later map of the same id is another map.
    state: what ``map.capturing.state()`` was then; the map has not changed as long as it gives the same object.
    archive: gives the bytes of the export file.
    readers: how many responses read from it now.
    used: when it was last asked for, on the monotonic clock.
    expiry: removes the export when it has not been used for a while.
    """

    map: Map
    state: object
    archive: VirtualArchive
    readers: int = 0
    used: float = 0.0
    expiry: asyncio.TimerHandle | None = None


class Exports:
    """All exports that are kept; to be used on the event loop.  No other process uses their folder.

    Args:
        settings: ``max_exports`` are kept, each for ``export_seconds`` after its last use.
    """

    def __init__(self, settings: Settings) -> None:
        self._folder = settings.data_dir / FOLDER
        self._max_exports, self._seconds = settings.max_exports, settings.export_seconds
        self._exports: dict[tuple[str, str], Export] = {}
        """By the id of the map and the tag of the export file."""
        self._under_way: dict[Map, asyncio.Task[Export]] = {}
        self._creating = CapacityLimiter(1)  # each reads a whole map
        self._reading = CapacityLimiter(4)
        self._closing = False

    def clean(self) -> None:
        """Remove what an earlier process left; blocks."""
        shutil.rmtree(self._folder, ignore_errors=True)

    def find(self, map_id: str, tags: list[str]) -> Export | None:
        """The export of a map that has one of these tags, even if the map was changed or deleted since."""
        return next((found for tag in tags if (found := self._exports.get((map_id, tag)))), None)

    async def create(self, map_: Map) -> Export:
        """The export of a map as it is now; one that is kept if the map has not changed since.

        Raises:
            TooManyExports: as many as are allowed are being read.
            NotReady: the service is stopping.
            UnknownMap, MapQuarantined: it was deleted meanwhile, or is damaged.
            StorageFull, StorageFailure.
        """
        state = map_.exporter.state()
        for export in self._exports.values():
            if export.map is map_ and export.state is state and state is not None:
                return export
        task = self._under_way.get(map_)
        if task is None:
            self._make_room()
            task = self._under_way[map_] = asyncio.create_task(self._create(map_))
            task.add_done_callback(lambda done: self._created(map_, done))
        return await asyncio.shield(task)  # other requests may wait for it, too

    def _created(self, map_: Map, task: asyncio.Task[Export]) -> None:
        del self._under_way[map_]
        if not task.cancelled() and (error := task.exception()) is not None:
            log.warning("the map %s could not be exported: %s", map_.record.id, error)

    def _make_room(self) -> None:
        """Remove the exports that were not read for the longest time until one more may be made."""
        self._check_open()
        idle = sorted((export for export in self._exports.values() if not export.readers), key=lambda one: one.used)
        while len(self._exports) + len(self._under_way) >= self._max_exports:
            if not idle:
                raise TooManyExports("Too many maps are being exported; send the request again later.")
            self._remove(idle.pop(0))

    def _check_open(self) -> None:
        if self._closing:
            raise NotReady("The service is stopping.", {"service": "it is stopping"})

    async def _create(self, map_: Map) -> Export:
        folder = self._folder / secrets.token_hex(8)
        began = time.perf_counter()

        def work() -> tuple[object, VirtualArchive]:
            map_.open()
            state = map_.exporter.state()  # read first, so that a change meanwhile is noticed
            return state, map_.exporter.into(folder, lambda _read: self._check_open())

        state, archive = await to_thread.run_sync(work, limiter=self._creating)
        seconds = round(time.perf_counter() - began, 3)
        map_id = archive.manifest.map.id
        facts = {"map": map_id, "places": archive.manifest.places, "bytes": archive.size, "seconds": seconds}
        log.info("export taken", extra=facts)
        export = self._exports.get((map_id, archive.tag))
        if export is not None:  # the map is what it was before
            export.map, export.state = map_, state
            await to_thread.run_sync(archive.discard)
        else:
            export = self._exports[map_id, archive.tag] = Export(map_, state, archive)
        self._renew(export)
        return export

    def hold(self, export: Export) -> Callable[[], None]:
        """Keep an export until the function that this returns is called; calling it again does nothing."""
        held = True

        def release() -> None:
            nonlocal held
            if held:
                held = False
                export.readers -= 1
                self._renew(export)

        export.readers += 1
        return release

    def _renew(self, export: Export) -> None:
        """Keep an export for the full time from now on."""
        export.used = time.monotonic()
        if export.expiry is not None:
            export.expiry.cancel()
        if not self._closing:
            export.expiry = asyncio.get_running_loop().call_later(self._seconds, self._expire, export)

    def _expire(self, export: Export) -> None:
        if export.readers:
            self._renew(export)
        else:
            self._remove(export)

    def _remove(self, export: Export) -> None:
        if export.expiry is not None:
            export.expiry.cancel()
        key = (export.archive.manifest.map.id, export.archive.tag)
        if self._exports.get(key) is export:
            del self._exports[key]
            asyncio.get_running_loop().run_in_executor(None, export.archive.discard)

    async def read(self, export: Export, part: Slice) -> AsyncIterator[bytes]:
        """Read a part of an export file, chunk by chunk.

        Raises:
            StorageFailure: the disk refuses, possibly after some chunks.
        """
        position = part.start
        while position < part.stop:
            most = min(CHUNK_BYTES, part.stop - position)
            chunk = await to_thread.run_sync(export.archive.read, position, most, limiter=self._reading)
            position += len(chunk)
            yield chunk

    async def close(self) -> None:
        """Stop the exports that are being made, and remove all."""
        self._closing = True
        for task in [*self._under_way.values()]:
            with suppress(Exception):
                await task
        for export in [*self._exports.values()]:
            if export.expiry is not None:
                export.expiry.cancel()
        self._exports.clear()
        await to_thread.run_sync(self.clean)


class ExportResponse(StreamingResponse):
    """A part of an export file; the export is kept until the response was sent or is dropped."""

    def __init__(self, exports: Exports, export: Export, part: Slice, status: int, headers: dict[str, str]) -> None:
        super().__init__(exports.read(export, part), status, headers, MEDIA_TYPE)
        self._release = exports.hold(export)
        weakref.finalize(self, self._release)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        try:
            await super().__call__(scope, receive, send)
        finally:
            self._release()
