"""Exports: the file of a map as it was when a download began, stored for a while so that the download can go on."""

from __future__ import annotations

import asyncio
import logging
import math
import secrets
import shutil
import time
import weakref
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

from anyio import CapacityLimiter, from_thread, to_thread
from starlette.datastructures import Headers
from starlette.responses import FileResponse
from starlette.types import Message, Receive, Scope, Send

from core.disk.permissions import PRIVATE_FOLDER
from core.errors import StorageFull
from core.maps.archives.writing import Exported
from core.store import Map
from service.errors.faults import NotReady, RangeNotSatisfiable, TooManyExports
from service.places.staging import RESERVE
from service.settings import Settings
from service.worker_threads import in_thread

FOLDER = "exports"
MEDIA_TYPE = "application/x-tar"

SECONDS_AFTER_THE_END = 300.0
"""The longest time that an export is stored after its last byte was sent: few requests after that resume a download."""

log = logging.getLogger("placerec.exports")


@dataclass(eq=False)
class Export:
    """A map as it was at one time.

    map: the object, since a later map of the same id is another map.
    state: the value of ``map.exporter.state()`` then; the map has not changed as long as it gives the same.
    file: the export file.
    readers: how many responses read it now.
    used: when it was last requested, on the monotonic clock.
    expiry: removes the export when it has not been used for a while.
    """

    map: Map
    state: object
    file: Exported
    readers: int = 0
    used: float = 0.0
    expiry: asyncio.TimerHandle | None = None


class Exports:
    """All stored exports; to be used on the event loop.  No other process uses their folder.

    Args:
        settings: ``max_exports`` are stored, each for ``export_seconds`` after its last use.
    """

    def __init__(self, settings: Settings) -> None:
        self._folder = settings.data_dir / FOLDER
        self._max_exports, self._seconds = settings.max_exports, settings.export_seconds
        self._exports: dict[tuple[str, str], Export] = {}
        """By the id of the map and the tag of the export file."""
        self._under_way: dict[Map, tuple[object, asyncio.Task[Export]]] = {}
        """Of the maps that are being written, with their state before it began; None if it was not known."""
        self._tags: weakref.WeakKeyDictionary[Map, tuple[object, str]] = weakref.WeakKeyDictionary()
        """The state of each map when it was last exported, and the tag of that export, even if it is gone."""
        self._creating = CapacityLimiter(1)  # each reads and writes a whole map
        self._closing = False

    def clean(self) -> None:
        """Remove what an earlier process left; blocks."""
        shutil.rmtree(self._folder, ignore_errors=True)

    def find(self, map_id: str, tags: list[str]) -> Export | None:
        """The export of a map that has one of these tags, even if the map was changed or deleted since."""
        return next((found for tag in tags if (found := self._exports.get((map_id, tag)))), None)

    async def tag_of(self, map_: Map) -> str | None:
        """The tag that an export of the map would have now; None if that is not known without writing one."""
        state, tag = self._tags.get(map_, (None, ""))
        return tag if state is not None and state == await in_thread(map_.exporter.state) else None

    async def create(self, map_: Map) -> Export:
        """The export of a map as it is now; a stored one if the map has not changed since.

        Raises:
            TooManyExports: as many as are allowed are being read.
            NotReady: the service is stopping.
            UnknownMap, MapQuarantined: it was deleted meanwhile, or is damaged.
            StorageFull, StorageFailure.
        """
        while True:
            state = await in_thread(map_.exporter.state)
            for export in self._exports.values():
                if export.map is map_ and export.state == state and state is not None:
                    return export
            begun_with, task = self._under_way.get(map_, (None, None))
            if task is None:
                self._make_room()
                task = asyncio.create_task(self._create(map_))
                self._under_way[map_] = state, task
                task.add_done_callback(lambda done: self._created(map_, done))
            elif state is None or begun_with != state:  # it may lack what was written since
                await asyncio.wait([task])
                continue
            export = await asyncio.shield(task)  # other requests may wait for it, too
            if self._keeps(export):  # and may have removed it since
                return export

    def _keeps(self, export: Export) -> bool:
        return self._exports.get((export.file.manifest.map.id, export.file.tag)) is export

    def _created(self, map_: Map, task: asyncio.Task[Export]) -> None:
        del self._under_way[map_]
        if not task.cancelled() and (error := task.exception()) is not None:
            log.warning("the map %s could not be exported: %s", map_.record.id, error)

    def _make_room(self) -> None:
        """Remove the exports that were not read for the longest time until one more may be stored."""
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
        path = self._folder / f"{secrets.token_hex(8)}.tar"
        began = time.perf_counter()

        def work() -> tuple[object, Exported]:
            self._check_open()
            map_.open()
            state = map_.exporter.state()  # read first, so that a change meanwhile is noticed
            self._folder.mkdir(PRIVATE_FOLDER, exist_ok=True)
            return state, map_.exporter.write(
                path, lambda _written: self._check_open(), lambda size: from_thread.run(self._make_space, size)
            )

        state, file = await to_thread.run_sync(work, limiter=self._creating)
        seconds = round(time.perf_counter() - began, 3)
        map_id = file.manifest.map.id
        facts = {"map": map_id, "places": file.manifest.places, "bytes": file.size, "seconds": seconds}
        log.info("export written", extra=facts)
        self._tags[map_] = state, file.tag
        export = self._exports.get((map_id, file.tag))
        if export is not None:  # the map is what it was before
            export.map, export.state = map_, state
            self._renew(export)
            await to_thread.run_sync(_delete, file)
        else:
            export = self._exports[map_id, file.tag] = Export(map_, state, file)
            self._renew(export)
        return export

    async def _make_space(self, size: int) -> None:
        """Remove the exports that were not read for the longest time until there is room for one of this size
        and for what enrolments need.

        Raises:
            StorageFull: there would not be room without all of them; none was removed then.
        """
        self._check_open()
        while (free := shutil.disk_usage(self._folder).free) < size + RESERVE:
            idle = [export for export in self._exports.values() if not export.readers]
            if not idle or free + sum(export.file.size for export in idle) < size + RESERVE:
                raise StorageFull(f"The disk has no room for the map as a file of {size} bytes beside the maps.")
            await self._remove(min(idle, key=lambda one: one.used))

    def hold(self, export: Export) -> Callable[[bool], None]:
        """Keep an export until the function that this returns is called; calling it again does nothing.

        The function takes whether the last byte of the file was sent.
        """
        held = True

        def release(ended: bool) -> None:
            nonlocal held
            if held:
                held = False
                export.readers -= 1
                self._renew(export, SECONDS_AFTER_THE_END if ended else math.inf)

        export.readers += 1
        return release

    def _renew(self, export: Export, seconds: float = math.inf) -> None:
        """Keep an export from now on for the full time, or less."""
        export.used = time.monotonic()
        if export.expiry is not None:
            export.expiry.cancel()
        if not self._closing:
            wait = min(seconds, self._seconds)
            export.expiry = asyncio.get_running_loop().call_later(wait, self._expire, export)

    def _expire(self, export: Export) -> None:
        if export.readers:
            self._renew(export)
        else:
            self._remove(export)

    def _remove(self, export: Export) -> asyncio.Future[None]:
        """Forget an export now; its file is gone when the returned future is done."""
        if export.expiry is not None:
            export.expiry.cancel()
        if self._keeps(export):
            del self._exports[export.file.manifest.map.id, export.file.tag]
        return asyncio.get_running_loop().run_in_executor(None, _delete, export.file)

    async def close(self) -> None:
        """Stop the exports that are being made, and remove all."""
        self._closing = True
        for _, task in [*self._under_way.values()]:
            with suppress(Exception):
                await task
        for export in [*self._exports.values()]:
            if export.expiry is not None:
                export.expiry.cancel()
        self._exports.clear()
        await to_thread.run_sync(self.clean)


def _delete(file: Exported) -> None:
    with suppress(OSError):
        file.path.unlink()


class _MalformedRange(Exception):
    pass


class ExportResponse(FileResponse):
    """An export file or the ranges of it that the request asks for; the export is stored until the response ends.

    A range that cannot be read is passed over (RFC 9110, section 14.2), and so is one with an If-Range other than the
    tag of the file: a date says too little, as a map may change within a second.

    Raises:
        RangeNotSatisfiable: on sending, if a range begins after the end.
    """

    chunk_size = 1 << 20

    def __init__(self, exports: Exports, export: Export, headers: dict[str, str]) -> None:
        super().__init__(export.file.path, headers=headers, media_type=MEDIA_TYPE)
        self._size = export.file.size
        self._release = exports.hold(export)
        weakref.finalize(self, self._release, False)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        reaches_end = ended = False

        async def checked(message: Message) -> None:
            """Answer what is wrong with a range as this service does, and note whether the last byte was sent."""
            nonlocal reaches_end, ended
            if message["type"] == "http.response.start":
                if message["status"] == 416:
                    said = f"The export has {self._size} bytes; the requested range begins after its end."
                    raise RangeNotSatisfiable(said, self._size)
                if message["status"] == 400:
                    raise _MalformedRange
                given_range = Headers(raw=message["headers"]).get("content-range", "")
                reaches_end = message["status"] == 200 or given_range.endswith(f"-{self._size - 1}/{self._size}")
            await send(message)
            ended = reaches_end and message["type"] == "http.response.body" and not message.get("more_body")

        method = scope["state"]["method"]
        unless = Headers(scope=scope).get("if-range")
        if unless is not None and unless != self.headers["etag"]:
            scope = _without_range(scope)
        if method == "HEAD":  # for which Range has no meaning
            scope = {**_without_range(scope), "method": method}
        try:
            await super().__call__(scope, receive, checked)
        except _MalformedRange:
            await super().__call__(_without_range(scope), receive, checked)
        finally:
            self._release(ended and method != "HEAD")


def _without_range(scope: Scope) -> Scope:
    return {**scope, "headers": [(name, value) for name, value in scope["headers"] if name != b"range"]}
