"""Maps that are brought as files: written to disk as they arrive, checked to the last bit, listed when they are whole.

imports/<name>       a file that a job is to read, or a request that is under way
imports/.<name>      one that is still arriving; nothing waits for it after a crash
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import logging
import os
import re
import secrets
import shutil
import threading
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from anyio import CapacityLimiter

from core.disk.files import Damage, disk_errors, sync_folder, write_at
from core.errors import InvalidArchive, StorageFailure, StorageFull, TooManyPixels, UnknownMap, WrongEncoder
from core.frames.containers import read_header
from core.frames.images import Limits
from core.places import check_map_id
from core.storage.archives.building import build, check_sizes
from core.storage.archives.manifest import Manifest
from core.storage.archives.reading import Archive, opening_of
from core.storage.archives.tar_layout import BLOCK
from service.engine.engine import Engine
from service.errors.faults import ClientGone, DigestMismatch, InvalidRequest, TooManyImports, TooManyPlaces
from service.http.bodies import in_pieces
from service.jobs.context import JobContext
from service.jobs.jobs import Jobs
from service.jobs.records import Job
from service.maps.limits import check_free
from service.worker_threads import to_its_end

KIND = "import"
FOLDER = "imports"
THUMBNAIL_BYTES, THUMBNAIL_PIXELS = 4 << 20, 2048 * 2048
"""Of what a service keeps as a thumbnail, at most, however small the frames are that another one takes."""

_DIGEST = re.compile(r"\s*([a-z0-9*_.-]+)\s*=\s*:([A-Za-z0-9+/=]*):\s*")

log = logging.getLogger("placerec.imports")


@dataclass(frozen=True)
class Arrived:
    """A file that is there whole.  map_id: which map is to be made of it."""

    name: str
    map_id: str
    manifest: Manifest
    tag: str
    size: int


Accept = Callable[[Manifest], str]
"""Looks at a manifest before the rest has come: which map it is to be.  Raises what the caller is to be told."""


def wanted_digests(headers: Mapping[str, str]) -> list[bytes]:
    """The SHA-256 that Content-Digest and Repr-Digest (RFC 9530) say the body has; other algorithms are passed over.

    Raises:
        InvalidRequest: one cannot be read.
    """
    found = []
    for header in ("content-digest", "repr-digest"):
        for member in filter(None, headers.get(header, "").split(",")):
            named = _DIGEST.fullmatch(member)
            if named is None:
                raise InvalidRequest(f"{header}: it is not written like sha-256=:…:.")
            if named[1] == "sha-256":
                try:
                    found.append(base64.b64decode(named[2], validate=True))
                except binascii.Error:
                    raise InvalidRequest(f"{header}: it is not base64.") from None
    return found


class Imports:
    """What arrives, and what waits for jobs."""

    def __init__(self, engine: Engine, jobs: Jobs) -> None:
        self._engine, self._jobs = engine, jobs
        self._folder = engine.settings.data_dir / FOLDER
        self._held: set[str] = set()
        """The files that are there, or are arriving."""
        self._building = CapacityLimiter(1)  # each writes as fast as the disk takes it
        jobs.register(KIND, self.run, self._discard)

    def clean(self) -> None:
        """Remove all but what jobs wait for, as a crash left it; call it before the jobs start."""
        waited_for = {job.arguments.get("file") for job in self._jobs.all() if not job.ended}
        if self._folder.is_dir():
            for path in self._folder.iterdir():
                if path.name not in waited_for:
                    with suppress(OSError):
                        path.unlink()
                else:
                    self._held.add(path.name)

    # Arriving

    async def receive(
        self, chunks: AsyncIterator[bytes], announced: int, digests: list[bytes], accept: Accept
    ) -> Arrived:
        """Write a file down as it arrives; it is looked at as soon as its manifest is there.

        Args:
            announced: its length; 0 if that is not known.
            digests: what its SHA-256 has to be.

        Raises:
            TooManyImports, InvalidArchive, ArchiveTooNew, DigestMismatch, StorageFull, StorageFailure.
            Others: what ``accept`` and ``chunks`` raise.  Nothing of the file is left.
        """
        if len(self._held) >= self._engine.settings.max_imports:
            raise TooManyImports("Too many maps are being imported; send this one again in a while.")
        name = secrets.token_hex(8)
        self._held.add(name)
        arriving = _Arriving(self._folder / f".{name}", announced, accept)
        try:
            await to_its_end(arriving.open)
            async for piece in in_pieces(chunks):
                await to_its_end(partial(arriving.add, piece))
            await to_its_end(lambda: arriving.finish(digests, self._folder / name))
        except BaseException:
            await to_its_end(lambda: self._give_up(arriving, name))
            raise
        manifest, tag, map_id = arriving.found
        return Arrived(name, map_id, manifest, tag, arriving.size)

    # Building

    def check(self, manifest: Manifest, map_id: str | None, encoder: str | None) -> str:
        """See, before all of it is there, that a file can become a map here; returns the map's id.

        Args:
            map_id: the one that is asked for; None for the file's own.
            encoder: name or identity that the caller expects.

        Raises:
            WrongEncoder: its encoder is not the one expected, or not installed here.
            InvalidIdentifier, MapExists, TooManyMaps, TooManyPlaces, InvalidArchive.
        """
        record = manifest.map
        if encoder is not None and encoder not in (record.encoder, record.encoder.partition("@")[0]):
            raise WrongEncoder(f"The file's map is bound to {record.encoder[:140]}, not to {encoder[:140]}.")
        installed = next((one for one in self._engine.catalogue.describe() if one.identity == record.encoder), None)
        if installed is None or installed.damaged is not None:
            raise WrongEncoder(f"The file's map is bound to {record.encoder[:140]}, which is not installed here.")
        if (record.dimension, record.local_shape) != (installed.dimension, installed.local_shape):
            raise InvalidArchive("The file's descriptors have another shape than those of its encoder.")
        check_sizes(manifest)
        if manifest.places > self._engine.settings.max_places:
            raise TooManyPlaces(f"The file has {manifest.places} places of at most {self._engine.settings.max_places}.")
        name = record.id if map_id is None else map_id
        check_free(self._engine, self._jobs, check_map_id(name))
        return name

    async def build(self, arrived: Arrived) -> None:
        """Make the map, which is listed when this returns; the file is removed whatever comes.

        Raises:
            InvalidArchive, MapExists, StorageFull, StorageFailure: nothing of the map is left.
        """
        given_up = threading.Event()

        def advance(_done: int, _all: int) -> None:
            if given_up.is_set():
                raise ClientGone("Nobody waits for the map any more.")

        def work() -> None:
            self._make(arrived.name, arrived.map_id, advance)

        try:
            async with self._building:
                await to_its_end(work, CapacityLimiter(1), given_up.set)  # in no thread of the pool
        finally:
            await to_its_end(lambda: self._remove(arrived.name))

    def _make(
        self,
        name: str,
        map_id: str,
        advance: Callable[[int, int], None],
        before_listing: Callable[[Archive], None] = lambda _archive: None,
    ) -> None:
        with disk_errors("read what was sent"):
            archive = Archive(self._folder / name)
        with archive:
            self.check_encoder(archive.manifest)
            try:
                with self._engine.atlas.building(map_id) as folder:
                    largest = self._largest_picture()
                    check = partial(_check_picture, limits=largest)
                    build(
                        archive,
                        folder,
                        map_id,
                        advance=advance,
                        check_picture=check,
                        most_picture_bytes=largest.max_bytes,
                    )
                    before_listing(archive)
            except Damage as damage:
                raise StorageFailure(f"The disk did not keep what was written: {damage}.") from damage
        log.info("map imported", extra={"map": map_id, "places": archive.manifest.places, "manifest": archive.tag})

    def check_encoder(self, manifest: Manifest) -> None:
        """Raise WrongEncoder unless a file's encoder is installed."""
        if all(one.identity != manifest.map.encoder for one in self._engine.catalogue.describe()):
            raise WrongEncoder(f"The file's map is bound to {manifest.map.encoder[:140]}, which is not installed here.")

    def _largest_picture(self) -> Limits:
        """What a frame may have here, and a thumbnail."""
        settings = self._engine.settings
        most_bytes = max(settings.max_image_bytes, THUMBNAIL_BYTES)
        return Limits(most_bytes, max(settings.max_image_pixels, THUMBNAIL_PIXELS), min_side=1)

    def _remove(self, name: str) -> None:
        with suppress(OSError):
            (self._folder / name).unlink(missing_ok=True)
            self._held.discard(name)

    def _give_up(self, arriving: _Arriving, name: str) -> None:
        arriving.discard()
        self._remove(name)

    # As a job

    def submit(self, arrived: Arrived) -> Job:
        """Let a job make the map of a file.

        Raises:
            JobQueueFull, StorageFull, StorageFailure: the file is gone.
        """
        arguments = {"to": arrived.map_id, "file": arrived.name, "manifest": arrived.tag, "bytes": arrived.size}
        try:
            return self._jobs.submit(KIND, arrived.map_id, arguments=arguments)
        except BaseException:
            self._remove(arrived.name)
            raise

    def run(self, context: JobContext) -> Mapping[str, Any]:
        """Do, or do again from the start, what a job says: nothing of an earlier attempt was kept but the file."""
        name, map_id = str(context.arguments["file"]), str(context.arguments["to"])
        if (made := context.notes.get("result")) is not None and self._is_listed(made):
            return dict(made)  # killed between the listing of the map and the end of the job

        def advance(done: int, total: int) -> None:
            context.check_cancelled()
            context.progress(done, total)

        def before_listing(archive: Archive) -> None:
            context.check_cancelled()  # from here on it cannot be undone
            record = archive.manifest.map
            context.remember(
                result={
                    "map": map_id,
                    "encoder": record.encoder,
                    "places": archive.manifest.places,
                    "created_at": record.created_at.isoformat(),
                    "manifest": archive.tag,
                }
            )

        self._make(name, map_id, advance, before_listing)
        return dict(context.notes["result"])

    def _is_listed(self, made: Mapping[str, Any]) -> bool:
        try:
            return self._engine.atlas.find(made["map"]).record.created_at.isoformat() == made["created_at"]
        except UnknownMap:
            return False

    def _discard(self, job: Job) -> None:
        self._remove(str(job.arguments["file"]))


class _Arriving:
    """A file that is being written; from one thread at a time."""

    def __init__(self, path: Path, announced: int, accept: Accept) -> None:
        self._path, self._announced, self._accept = path, announced, accept
        self._hash = hashlib.sha256()
        self._found: tuple[Manifest, str, str] | None = None
        self.size = 0
        self._file = -1

    def open(self) -> None:
        path, announced = self._path, self._announced
        with disk_errors("take in a map"):
            path.parent.mkdir(exist_ok=True)
            # As a file and as a map it is there twice for a moment.
            if shutil.disk_usage(path.parent).free < 2 * announced:
                raise StorageFull(f"The disk has no room for {announced} bytes twice over, as a file and as a map.")
            self._file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)

    @property
    def found(self) -> tuple[Manifest, str, str]:
        """Manifest, its tag, and the id of the map that is to be made."""
        assert self._found is not None
        return self._found

    def add(self, data: bytes) -> None:
        with disk_errors("take in a map"):
            write_at(self._file, data, self.size)
        self._hash.update(data)
        self.size += len(data)
        if self._found is None and self.size >= BLOCK:
            self._look()

    def _look(self) -> None:
        opening = opening_of(os.pread(self._file, BLOCK, 0), lambda offset, size: os.pread(self._file, size, offset))
        if opening is not None:
            manifest, tape, tag = opening
            if self._announced and tape.size != self._announced:
                raise InvalidArchive(f"The file is to have {tape.size} bytes, but {self._announced} are announced.")
            self._found = manifest, tag, self._accept(manifest)

    def finish(self, digests: list[bytes], there: Path) -> None:
        if any(digest != self._hash.digest() for digest in digests):
            raise DigestMismatch("The body does not have the SHA-256 that its header says.")
        if self._found is None:
            raise InvalidArchive(f"The file ends after {self.size} bytes, within its manifest.")
        with disk_errors("take in a map"):
            os.fsync(self._file)
            os.rename(self._path, there)
            sync_folder(there.parent)
            sync_folder(there.parent.parent)
        self._close()

    def discard(self) -> None:
        """Remove what there is of it, unless it has its name already."""
        self._close()
        with suppress(OSError):
            self._path.unlink(missing_ok=True)

    def _close(self) -> None:
        file, self._file = self._file, -1
        if file >= 0:
            os.close(file)


def _check_picture(content: bytes, limits: Limits) -> None:
    header = read_header(content)
    if header.width * header.height > limits.max_pixels:
        raise TooManyPixels(f"it has {header.width}x{header.height} pixels of at most {limits.max_pixels}")
