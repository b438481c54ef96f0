"""Imports: map files that clients send are stored, checked, and made into maps, at once or by a job.

imports/<name>       a complete file, of which a request or a job makes a map
imports/.<name>      a file that is still arriving; the next start removes what a crash left of it
"""

from __future__ import annotations

import logging
import os
import shutil
import threading
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import Any

from anyio import CapacityLimiter

from core.disk.files import disk_errors, write_at
from core.errors import (
    InvalidArchive,
    InvalidModel,
    StorageFull,
    TooManyPixels,
    UnknownEncoder,
    UnknownMap,
    WrongEncoder,
)
from core.frames.containers import read_header
from core.frames.images import Limits
from core.maps.archives.manifest import Manifest
from core.maps.archives.reading import Archive, opening_of
from core.maps.archives.tar_layout import BLOCK
from core.maps.archives.unpacking import check_sizes
from core.maps.enrolling import any_descriptors
from core.maps.records import MOST_LOOKS, Precision
from core.method.catalogue import EncoderSummary
from core.places import check_map_id
from service.engine.engine import Engine
from service.errors.faults import ClientGone, TooManyImports, TooManyPlaces
from service.http.arrivals import Arrival, arriving
from service.http.bodies import in_pieces
from service.jobs.context import JobContext
from service.jobs.job import Job
from service.jobs.jobs import Jobs
from service.maps.limits import check_new_map
from service.worker_threads import to_its_end

KIND = "import"
FOLDER = "imports"

THUMBNAIL_BYTES, THUMBNAIL_PIXELS = 4 << 20, 2048 * 2048
"""Pictures up to this size are imported even if the service's own limit on frames is lower: they may be thumbnails
that a service with a higher limit made."""

LENGTH_TOLERANCES: Mapping[Precision, float] = {"half": 0.01, "compressed": 0.1}
"""By how much the length of a descriptor may differ from that which its encoder gives, by the precision of the map."""

log = logging.getLogger("placerec.imports")

Accept = Callable[[Manifest], str]
"""Looks at the manifest of a file that is still arriving, and returns the id of the map that is to be made of it.
Raises the problem that the client is answered with if none can be made."""


@dataclass(frozen=True)
class ReceivedFile:
    """A map file that is complete.

    name: in the folder of imports.
    map_id: of the map that is to be made of it.
    tag: SHA-256 of the manifest, in hexadecimal.
    size: in bytes.
    """

    name: str
    map_id: str
    manifest: Manifest
    tag: str
    size: int


class Imports:
    """Receives map files and makes maps of them."""

    def __init__(self, engine: Engine, jobs: Jobs) -> None:
        self._engine, self._jobs = engine, jobs
        self._folder = engine.settings.data_dir / FOLDER
        self._files: set[str] = set()
        """Names of the files that are stored or still arriving."""
        self._building = CapacityLimiter(1)  # each writes as fast as the disk takes it
        jobs.register(KIND, self.run, self._discard)

    def clean(self) -> None:
        """Remove the files that no job waits for, as a crash left them; call it before the jobs start."""
        waited_for = {job.arguments.get("file") for job in self._jobs.all() if not job.ended}
        if self._folder.is_dir():
            for path in self._folder.iterdir():
                if path.name not in waited_for:
                    with suppress(OSError):
                        path.unlink()
                else:
                    self._files.add(path.name)

    # Receiving

    async def receive(self, chunks: AsyncIterator[bytes], announced: int, accept: Accept) -> ReceivedFile:
        """Store a file as it arrives, and check its manifest as soon as that is there.

        Args:
            announced: length of the file in bytes; 0 if it is not known.

        Raises:
            TooManyImports, InvalidArchive, ArchiveTooNew, StorageFull, StorageFailure, and whatever ``accept`` and
                ``chunks`` raise: nothing of the file is left.
        """
        if len(self._files) >= self._engine.settings.max_imports:
            raise TooManyImports("Too many maps are being imported; send this one again later.")
        arrival = Arrival(self._folder, "store the map file")
        self._files.add(arrival.name)
        incoming = _IncomingFile(arrival, announced, accept)
        try:
            async with arriving(arrival, incoming.check_room):
                async for piece in in_pieces(chunks):
                    await to_its_end(partial(incoming.add, piece))
                return await to_its_end(incoming.complete)
        except BaseException:
            await to_its_end(lambda: self._remove(arrival.name))
            raise

    def check_manifest(self, manifest: Manifest, map_id: str | None, encoder: str | None) -> str:
        """Check that a file can become a map here; needs only its manifest.

        Args:
            map_id: the id that the client asks for; None for that of the file.
            encoder: name or identity of the encoder that the client expects; None for any.

        Returns:
            The id of the map that is to be made.

        Raises:
            WrongEncoder: the map's encoder is not the expected one, or is not installed here.
            InvalidIdentifier, MapExists, TooManyMaps, TooManyPlaces, InvalidArchive.
        """
        record, most_places = manifest.map, self._engine.settings.max_places
        if encoder is not None and encoder not in (record.encoder, record.encoder.partition("@")[0]):
            raise WrongEncoder(f"The file's map is bound to {record.encoder[:140]}, not to {encoder[:140]}.")
        installed = self.check_encoder(manifest)
        if (record.dimension, record.local_shape) != (installed.dimension, installed.local_shape):
            raise InvalidArchive("The file's descriptors have another shape than those of its encoder.")
        check_sizes(manifest)
        if manifest.places > most_places * (1 + MOST_LOOKS):  # the file counts looks as well; they tell later
            raise TooManyPlaces(f"The file has {manifest.places} places; a map may have at most {most_places}.")
        name = record.id if map_id is None else map_id
        check_new_map(self._engine, self._jobs, check_map_id(name))
        return name

    def check_encoder(self, manifest: Manifest) -> EncoderSummary:
        """The encoder of a file's map.

        Raises:
            WrongEncoder: it is not installed, or damaged.
        """
        with suppress(UnknownEncoder, InvalidModel):
            installed = self._engine.catalogue.summary(manifest.map.encoder)
            if installed.identity == manifest.map.encoder:
                return installed
        raise WrongEncoder(f"The file's map is bound to {manifest.map.encoder[:140]}, which is not installed here.")

    # Making maps

    async def build(self, received: ReceivedFile) -> None:
        """Make the map of a file; it is listed when this returns.  The file is removed in any case.

        Raises:
            WrongEncoder, InvalidArchive, MapExists, TooManyPlaces, StorageFull, StorageFailure: nothing of the map is
                left.
        """
        cancelled = threading.Event()

        def advance(_done: int, _total: int) -> None:
            if cancelled.is_set():
                raise ClientGone("The client closed the connection before the map was made.")

        def work() -> None:
            self._build(received.name, received.map_id, advance)

        try:
            async with self._building:
                await to_its_end(work, CapacityLimiter(1), cancelled.set)  # in no thread of the pool
        finally:
            await to_its_end(lambda: self._remove(received.name))

    def submit(self, received: ReceivedFile) -> Job:
        """Submit a job that makes the map of a file.

        Raises:
            JobQueueFull, StorageFull, StorageFailure: the file is removed.
        """
        arguments = {"to": received.map_id, "file": received.name, "manifest": received.tag, "bytes": received.size}
        try:
            return self._jobs.submit(KIND, received.map_id, arguments=arguments)
        except BaseException:
            self._remove(received.name)
            raise

    def run(self, context: JobContext) -> Mapping[str, Any]:
        """Make the map of a job's file; an attempt after a restart begins again, since only the file is stored.

        Raises:
            WrongEncoder, InvalidArchive, MapExists, TooManyPlaces, StorageFull, StorageFailure: nothing of the map is
                left.
            JobCancelled, JobInterrupted.
        """
        name, map_id = str(context.arguments["file"]), str(context.arguments["to"])
        if (made := context.notes.get("result")) is not None and self._is_listed(made):
            return dict(made)  # the process was killed after the map was listed and before the job ended

        def advance(done: int, total: int) -> None:
            context.check_cancelled()
            context.progress(done, total)

        def before_listing(archive: Archive, places: int) -> None:
            context.check_cancelled()  # from here on it cannot be undone
            record = archive.manifest.map
            context.remember(
                result={
                    "map": map_id,
                    "encoder": record.encoder,
                    "places": places,
                    "created_at": record.created_at.isoformat(),
                    "manifest": archive.tag,
                }
            )

        self._build(name, map_id, advance, before_listing)
        return dict(context.notes["result"])

    def _build(
        self,
        name: str,
        map_id: str,
        advance: Callable[[int, int], None],
        before_listing: Callable[[Archive, int], None] = lambda _archive, _places: None,
    ) -> None:
        most_places = self._engine.settings.max_places

        def complete(places: int) -> None:
            if places > most_places:
                raise TooManyPlaces(f"The file has {places} places; a map may have at most {most_places}.")
            before_listing(archive, places)

        with disk_errors("read the map file"):
            archive = Archive(self._folder / name)
        with archive:
            definition = self.check_encoder(archive.manifest).definition
            tolerance = LENGTH_TOLERANCES[archive.manifest.map.precision]
            limits = self._picture_limits()
            self._engine.maps.import_map(
                archive,
                map_id,
                advance,
                partial(_check_picture, limits=limits),
                limits.max_bytes,
                complete,
                any_descriptors if definition is None else partial(definition.could_give, tolerance=tolerance),
            )
        log.info("map imported", extra={"map": map_id, "places": archive.manifest.places, "manifest": archive.tag})

    def _picture_limits(self) -> Limits:
        """The larger of the limits of frames and of thumbnails."""
        settings = self._engine.settings
        most_bytes = max(settings.max_image_bytes, THUMBNAIL_BYTES)
        return Limits(most_bytes, max(settings.max_image_pixels, THUMBNAIL_PIXELS), min_side=1)

    def _is_listed(self, made: Mapping[str, Any]) -> bool:
        try:
            return self._engine.maps.find(made["map"]).record.created_at.isoformat() == made["created_at"]
        except UnknownMap:
            return False

    def _discard(self, job: Job) -> None:
        self._remove(str(job.arguments["file"]))

    def _remove(self, name: str) -> None:
        with suppress(OSError):
            (self._folder / name).unlink(missing_ok=True)
            self._files.discard(name)


class _IncomingFile:
    """A file that is arriving: its manifest is read as soon as it is there.

    For one thread at a time.
    """

    def __init__(self, arrival: Arrival, announced: int, accept: Accept) -> None:
        self._arrival, self._announced, self._accept = arrival, announced, accept
        self._size = 0
        self._checked: tuple[Manifest, str, str] | None = None
        """The manifest, its tag, and the id of the map, as soon as they are known."""

    def check_room(self) -> None:
        """Raise StorageFull unless the disk has room for the announced bytes as a file and as a map."""
        if shutil.disk_usage(self._arrival.temporary.parent).free < 2 * self._announced:
            raise StorageFull(
                f"The disk has no room for {self._announced} bytes twice, once as a file and once as a map."
            )

    def add(self, data: bytes) -> None:
        """Write the next bytes; raises what ``accept`` raises, or InvalidArchive, if the manifest is refused."""
        with disk_errors("store the map file"):
            write_at(self._arrival.file, data, self._size)
        self._size += len(data)
        if self._checked is None and self._size >= BLOCK:
            self._check_manifest()

    def _check_manifest(self) -> None:
        file = self._arrival.file
        opening = opening_of(os.pread(file, BLOCK, 0), lambda offset, size: os.pread(file, size, offset))
        if opening is not None:
            manifest, tape, tag = opening
            if self._announced and tape.size != self._announced:
                raise InvalidArchive(
                    f"By its manifest the file has {tape.size} bytes, but the request announces {self._announced}."
                )
            self._checked = manifest, tag, self._accept(manifest)

    def complete(self) -> ReceivedFile:
        """Give the file its name for good.

        Raises:
            InvalidArchive, StorageFull, StorageFailure.
        """
        if self._checked is None:
            raise InvalidArchive(f"The file ends after {self._size} bytes, within its manifest.")
        manifest, tag, map_id = self._checked
        self._arrival.complete()
        return ReceivedFile(self._arrival.name, map_id, manifest, tag, self._size)


def _check_picture(content: bytes, limits: Limits) -> None:
    header = read_header(content)
    if header.width * header.height > limits.max_pixels:
        raise TooManyPixels(f"it has {header.width}x{header.height} pixels; at most {limits.max_pixels} are allowed")
