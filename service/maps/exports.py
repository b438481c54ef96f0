"""Moments of maps that are being downloaded: kept for a while, so that a download that broke off can go on."""

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
from typing import TYPE_CHECKING

from anyio import CapacityLimiter, to_thread
from starlette.responses import StreamingResponse
from starlette.types import Receive, Scope, Send

from core.storage import Map
from core.storage.archives.virtual_archive import CHUNK_BYTES, VirtualArchive
from service.errors.faults import NotReady, TooManyExports
from service.http.headers import Slice

if TYPE_CHECKING:
    from service.settings import Settings

FOLDER = "exports"
MEDIA_TYPE = "application/x-tar"

log = logging.getLogger("placerec.exports")


@dataclass(eq=False)
class Export:
    """A kept moment.

    map: of which it is; the object, for another map of the same id is another map.
    state: of the map when it was taken; None once it was found to be changed.
    users: answers that read from it now.
    """

    map: Map
    state: object
    archive: VirtualArchive
    users: int = 0
    used: float = 0.0
    timer: asyncio.TimerHandle | None = None


class Exports:
    """All of them; on the event loop.  What lies in the folder is of this process alone.

    Args:
        settings: how many are kept, and for how long.
    """

    def __init__(self, settings: Settings) -> None:
        self._folder = settings.data_dir / FOLDER
        self._most, self._seconds = settings.max_exports, settings.export_seconds
        self._kept: dict[tuple[str, str], Export] = {}
        self._taking: dict[Map, asyncio.Task[Export]] = {}
        self._one = CapacityLimiter(1)  # each reads all of a map
        self._reading = CapacityLimiter(4)
        self._closing = False

    def clean(self) -> None:
        """Remove what an earlier process left; blocks."""
        shutil.rmtree(self._folder, ignore_errors=True)

    def find(self, map_id: str, tags: list[str]) -> Export | None:
        """One that a caller has a part of already; of a map that was changed or deleted since, too."""
        return next((found for tag in tags if (found := self._kept.get((map_id, tag)))), None)

    async def take(self, map_: Map) -> Export:
        """The map as it is now; kept before if it was not changed since.

        Raises:
            TooManyExports: as many as may be kept are being read.
            UnknownMap, MapQuarantined: it was deleted meanwhile, or is damaged.
            StorageFull, StorageFailure.
        """
        state = map_.exporter.state()
        for kept in self._kept.values():
            if kept.map is map_ and kept.state is state and state is not None:
                return kept
        task = self._taking.get(map_)
        if task is None:
            self._make_room()
            task = self._taking[map_] = asyncio.create_task(self._take(map_))
            task.add_done_callback(lambda done: self._took(map_, done))
        return await asyncio.shield(task)  # another caller may wait for it, or the same one come again

    def _took(self, map_: Map, task: asyncio.Task[Export]) -> None:
        del self._taking[map_]
        if not task.cancelled() and (error := task.exception()) is not None:
            log.warning("the map %s could not be exported: %s", map_.record.id, error)

    def _make_room(self) -> None:
        if self._closing:
            raise NotReady("The service is stopping.", {"service": "it is stopping"})
        free = sorted((kept for kept in self._kept.values() if not kept.users), key=lambda kept: kept.used)
        while len(self._kept) + len(self._taking) >= self._most:
            if not free:
                raise TooManyExports("Too many maps are being exported; send the request again in a while.")
            self._discard(free.pop(0))

    async def _take(self, map_: Map) -> Export:
        folder = self._folder / secrets.token_hex(8)
        began = time.perf_counter()

        def advance(_read: int) -> None:
            if self._closing:
                raise NotReady("The service is stopping.", {"service": "it is stopping"})

        def work() -> tuple[object, VirtualArchive]:
            map_.open()
            state = map_.exporter.state()  # before: a change in between is then told as one
            return state, map_.exporter.into(folder, advance)

        state, archive = await to_thread.run_sync(work, limiter=self._one)
        seconds = round(time.perf_counter() - began, 3)
        map_id = archive.manifest.map.id
        noted = {"map": map_id, "places": archive.manifest.places, "bytes": archive.size, "seconds": seconds}
        log.info("export taken", extra=noted)
        same = self._kept.get((map_id, archive.tag))
        if same is not None:  # the map is again, or still, what it was
            same.map, same.state = map_, state
            await to_thread.run_sync(archive.discard)
        else:
            same = self._kept[map_id, archive.tag] = Export(map_, state, archive)
        self._touch(same)
        return same

    def hold(self, export: Export) -> Callable[[], None]:
        """It is not given up until what this returns is called."""
        held = True

        def release() -> None:
            nonlocal held
            if held:
                held = False
                export.users -= 1
                self._touch(export)

        export.users += 1
        return release

    def _touch(self, export: Export) -> None:
        """From now on the time runs in which it can be asked for again."""
        export.used = time.monotonic()
        if export.timer is not None:
            export.timer.cancel()
        if not self._closing:
            export.timer = asyncio.get_running_loop().call_later(self._seconds, self._expire, export)

    def _expire(self, export: Export) -> None:
        if export.users:
            self._touch(export)
        else:
            self._discard(export)

    def _discard(self, export: Export) -> None:
        if export.timer is not None:
            export.timer.cancel()
        key = (export.archive.manifest.map.id, export.archive.tag)
        if self._kept.get(key) is export:
            del self._kept[key]
            asyncio.get_running_loop().run_in_executor(None, export.archive.discard)

    async def chunks(self, export: Export, part: Slice) -> AsyncIterator[bytes]:
        """The bytes of a part of it, read as they are sent.

        Raises:
            StorageFailure: the disk refuses; what was sent so far is then all there is.
        """
        position = part.start
        while position < part.stop:
            most = min(CHUNK_BYTES, part.stop - position)
            chunk = await to_thread.run_sync(export.archive.read, position, most, limiter=self._reading)
            position += len(chunk)
            yield chunk

    async def close(self) -> None:
        """Give up what is being taken, and all that is kept."""
        self._closing = True
        for task in [*self._taking.values()]:
            with suppress(Exception):
                await task
        for export in [*self._kept.values()]:
            if export.timer is not None:
                export.timer.cancel()
        self._kept.clear()
        await to_thread.run_sync(self.clean)


class ExportResponse(StreamingResponse):
    """An answer that holds on to the export it is read from, until it was sent or is never going to be."""

    def __init__(self, exports: Exports, export: Export, part: Slice, status: int, headers: dict[str, str]) -> None:
        super().__init__(exports.chunks(export, part), status, headers, MEDIA_TYPE)
        self._release = exports.hold(export)
        weakref.finalize(self, self._release)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        try:
            await super().__call__(scope, receive, send)
        finally:
            self._release()
