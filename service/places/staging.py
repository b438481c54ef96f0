"""Forms of many frames, written to disk as they arrive, for jobs that work through them later.

staging/<name>/form      the bytes of all parts, one behind the other
staging/<name>/parts     JSON: which bytes are which part, with their digests
staging/.<name>/…        one that is still arriving; nothing waits for it after a crash
"""

from __future__ import annotations

import hashlib
import json
import os
import secrets
import shutil
import threading
from collections.abc import AsyncIterator, Callable, Collection, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

from core.disk.files import disk_errors, sync_folder, write_at, write_file
from core.errors import StorageFailure, StorageFull
from service.errors.faults import StagingFull
from service.http.bodies import in_pieces
from service.http.multipart import FormReader, Part
from service.worker_threads import to_its_end

FOLDER = "staging"

RESERVE = 256 << 20
"""Bytes of the disk that forms leave free, for what the maps have to write meanwhile."""


@dataclass(frozen=True)
class StagedPart:
    """One part of a form on disk: ``size`` bytes from ``offset`` on; none where it was ``oversized``."""

    name: str
    filename: str | None
    content_type: str | None
    oversized: bool
    offset: int
    size: int
    sha256: str


class _Writer(FormReader):
    """Feeds on chunks and puts the parts' bytes into a file; at most one chunk of them is in memory."""

    def __init__(self, content_type: str, max_parts: int, max_part_bytes: int, file: int) -> None:
        super().__init__(content_type, max_parts, max_part_bytes)
        self.staged: list[StagedPart] = []
        self._file, self._start, self._offset, self._hash = file, 0, 0, hashlib.sha256()

    def _begin(self) -> None:
        super()._begin()
        self._start, self._hash = self._offset, hashlib.sha256()

    def _add_data(self, data: bytes, start: int, end: int) -> None:
        self._part.size += end - start
        if self._part.size > self._max_part_bytes:
            self._offset = self._start  # the next part takes its room
            return
        view = memoryview(data)[start:end]
        write_at(self._file, view, self._offset)
        self._hash.update(view)
        self._offset += len(view)

    def _end_part(self) -> None:
        super()._end_part()
        part = self.parts[-1]
        digest = hashlib.sha256() if part.oversized else self._hash
        where = self._start, self._offset - self._start, digest.hexdigest()
        self.staged.append(StagedPart(part.name, part.filename, part.content_type, part.oversized, *where))


class StagedForm:
    """The parts of a form on disk."""

    def __init__(self, folder: Path) -> None:
        """Of a folder of the staging.

        Raises:
            StorageFailure: it is not there, or damaged.
        """
        self._path = folder / "form"
        try:
            with disk_errors(f"read {folder}"):
                listed = json.loads((folder / "parts").read_bytes())
            self.parts = [StagedPart(**part) for part in listed]
        except (ValueError, TypeError) as error:
            raise StorageFailure(f"{folder / 'parts'} is damaged: {error}.") from error

    def read(self, part: StagedPart) -> Part:
        """A part with its bytes.

        Raises:
            StorageFailure: they are not those that came, or cannot be read.
        """
        with disk_errors(f"read {self._path}"), self._path.open("rb") as file:
            file.seek(part.offset)
            data = file.read(part.size)
        if hashlib.sha256(data).hexdigest() != part.sha256:
            raise StorageFailure(f"{self._path}: the part {part.name[:80]!r} is damaged.")
        return Part(part.name, part.filename, part.content_type, data, part.oversized)


class Staging:
    """What waits on disk for jobs.  From any thread.

    Args:
        directory: that of the data.
        capacity: bytes that all of it may take.
        reserve: bytes of the disk that it leaves to the maps.
    """

    def __init__(self, directory: Path, capacity: int, reserve: int = RESERVE) -> None:
        self._folder, self.capacity, self._reserve = directory / FOLDER, capacity, reserve
        self._lock = threading.Lock()
        self._sizes: dict[str, int] = {}
        """Bytes of each form; of one that is still arriving those that are announced."""
        self._coming: dict[str, int] = {}
        """Of those that are still arriving: bytes that are not there yet."""

    def open(self, name: str) -> StagedForm:
        """A form that arrived whole.

        Raises:
            StorageFailure: it is not there, or damaged.
        """
        return StagedForm(self._folder / name)

    def remove(self, name: str) -> None:
        """Remove a form; nothing happens if there is none.

        Raises:
            StorageFull, StorageFailure: the disk refuses.
        """
        with disk_errors(f"remove {self._folder / name}"):
            if (self._folder / name).exists():
                shutil.rmtree(self._folder / name)
        with self._lock:
            self._sizes.pop(name, None)

    def clean(self, waited_for: Collection[str]) -> None:
        """Remove all but what is waited for, as a crash left it; call it before anything arrives."""
        if self._folder.is_dir():
            for found in self._folder.iterdir():
                if found.name not in waited_for:
                    shutil.rmtree(found, ignore_errors=True)
                else:
                    with suppress(OSError):  # the job will say what it lacks
                        self._sizes[found.name] = (found / "form").stat().st_size

    def size(self) -> int:
        """Bytes that lie there now, or are announced."""
        with self._lock:
            return sum(self._sizes.values())

    def _claim(self, name: str, size: int) -> None:
        with self._lock:
            if sum(self._sizes.values()) + size > self.capacity:
                raise StagingFull("Too much waits to be enrolled already; send this again later.")
            self._sizes[name] = self._coming[name] = size

    def _expect_room(self) -> None:
        """See that the disk has room for all that is still to come, and the reserve besides."""
        with self._lock:
            coming = sum(self._coming.values())
        if shutil.disk_usage(self._folder).free < coming + self._reserve:
            raise StorageFull(f"The disk has no room for {coming} bytes of frames that are to wait, and for the maps.")

    async def receive(
        self,
        chunks: AsyncIterator[bytes],
        content_type: str,
        announced: int,
        max_parts: int,
        max_part_bytes: int,
    ) -> str:
        """Write a form down as it arrives; its name, once it is there whole and synced.

        Args:
            announced: bytes that it has, or may have.

        Raises:
            StagingFull: too much waits already.
            MalformedBody: it is not multipart, or cut short.
            BodyTooLarge: it has too many parts.
            StorageFull, StorageFailure: nothing of it is left.
            Others: what ``chunks`` raises; nothing of it is left either.
        """
        name = secrets.token_hex(8)
        self._claim(name, announced)
        form = _Arriving(self._folder / f".{name}", self._folder / name)
        try:
            await to_its_end(lambda: form.open(self._expect_room))
            writer = _Writer(content_type, max_parts, max_part_bytes, form.file)
            async for piece in in_pieces(chunks):
                await to_its_end(partial(_feed, writer, piece))
                self._coming[name] = max(0, self._coming[name] - len(piece))
            writer.close()
            size = await to_its_end(lambda: form.finish(writer.staged))
        except BaseException:
            await to_its_end(form.discard)
            with self._lock:
                del self._sizes[name], self._coming[name]
            raise
        with self._lock:
            del self._coming[name]
            self._sizes[name] = size
        return name


class _Arriving:
    """The folder of a form that is being written; from one thread at a time."""

    def __init__(self, folder: Path, there: Path) -> None:
        self._folder, self._there = folder, there
        self.file = -1

    def open(self, expect_room: Callable[[], None]) -> None:
        with disk_errors(f"write {self._folder}"):
            self._folder.mkdir(parents=True)
            expect_room()
            self.file = os.open(self._folder / "form", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)

    def finish(self, staged: Sequence[StagedPart]) -> int:
        """Sync it and give it its name; its size."""
        with disk_errors(f"write {self._there}"):
            os.fsync(self.file)
            size = os.fstat(self.file).st_size
            write_file(self._folder / "parts", json.dumps([asdict(part) for part in staged]).encode())
            os.rename(self._folder, self._there)
            sync_folder(self._there.parent)
            sync_folder(self._there.parent.parent)
        self._close()
        return size

    def discard(self) -> None:
        """Remove what there is of it, under either name."""
        self._close()
        for folder in (self._folder, self._there):
            shutil.rmtree(folder, ignore_errors=True)

    def _close(self) -> None:
        file, self.file = self.file, -1
        if file >= 0:
            os.close(file)


def _feed(writer: _Writer, data: bytes) -> None:
    with disk_errors("write down what arrives"):
        writer.feed(data)
