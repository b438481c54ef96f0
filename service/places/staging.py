"""Staging: forms of many frames are written to disk as they arrive; jobs read them later.

staging/<name>/form      the bytes of all parts, one after the other
staging/<name>/parts     JSON: the position, size and digest of each part
staging/.<name>/…        a form that is still arriving; it is removed after a crash
"""

from __future__ import annotations

import hashlib
import json
import shutil
import threading
from collections import Counter
from collections.abc import AsyncIterator, Collection, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

from core.disk.files import disk_errors, write_at, write_file
from core.errors import StorageFailure, StorageFull
from service.errors.faults import StagingFull
from service.fairness import CALLER
from service.http.arrivals import Arrival, arriving
from service.http.bodies import in_pieces
from service.http.multipart import FormPart, FormReader
from service.worker_threads import to_its_end

FOLDER = "staging"

RESERVE = 256 << 20
"""Bytes of the disk that forms leave free for the maps."""


@dataclass(frozen=True)
class StagedPart:
    """One part of a form on disk: ``size`` bytes from ``offset``; an ``oversized`` part has no bytes on disk."""

    name: str
    filename: str | None
    content_type: str | None
    oversized: bool
    offset: int
    size: int
    sha256: str


class _Writer(FormReader):
    """Parses a form from chunks and writes the bytes of its parts to a file; it holds at most one chunk in memory."""

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
            self._offset = self._start  # the next part overwrites this one
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
        """Open the form in a folder.

        Raises:
            StorageFailure: the form is missing or damaged.
        """
        self._path = folder / "form"
        try:
            with disk_errors("read frames that wait"):
                listed = json.loads((folder / "parts").read_bytes())
            self.parts = [StagedPart(**part) for part in listed]
        except (ValueError, TypeError) as error:
            raise StorageFailure(f"The frames that wait are damaged: {error}.") from error

    def read(self, part: StagedPart) -> FormPart:
        """A part with its bytes.

        Raises:
            StorageFailure: the bytes cannot be read, or differ from those that arrived.
        """
        with disk_errors("read frames that wait"), self._path.open("rb") as file:
            file.seek(part.offset)
            data = file.read(part.size)
        if hashlib.sha256(data).hexdigest() != part.sha256:
            raise StorageFailure(f"The part {part.name[:80]!r} of the frames that wait is damaged.")
        return FormPart(part.name, part.filename, part.content_type, data, part.oversized)


class Staging:
    """The forms that wait on disk for jobs.  Thread-safe.

    Args:
        directory: the data directory.
        capacity: the most bytes that all forms together may have; when they have as many, further ones are taken of
            callers that have less than an equal share of them.
        reserve: bytes of the disk that forms leave free.
    """

    def __init__(self, directory: Path, capacity: int, reserve: int = RESERVE) -> None:
        self._folder, self.capacity, self._reserve = directory / FOLDER, capacity, reserve
        self._lock = threading.Lock()
        self._sizes: dict[str, int] = {}
        """The bytes of each form; of a form that is still arriving, the announced bytes."""
        self._callers: dict[str, str] = {}
        """The caller that sent each form; one from before a restart counts as anyone's."""
        self._coming: dict[str, int] = {}
        """The bytes that have not arrived yet of each form that is arriving."""

    def open(self, name: str) -> StagedForm:
        """A form that has arrived completely.

        Raises:
            StorageFailure: the form is missing or damaged.
        """
        return StagedForm(self._folder / name)

    def remove(self, name: str) -> None:
        """Remove a form, if it exists.

        Raises:
            StorageFull, StorageFailure: the disk refuses.
        """
        with disk_errors("remove frames that waited"):
            if (self._folder / name).exists():
                shutil.rmtree(self._folder / name)
        with self._lock:
            self._sizes.pop(name, None)
            self._callers.pop(name, None)

    def clean(self, waited_for: Collection[str]) -> None:
        """Remove the forms that a crash left behind; call it before any form arrives.

        Args:
            waited_for: the names of the forms that jobs wait for; these stay.
        """
        if self._folder.is_dir():
            for found in self._folder.iterdir():
                if found.name not in waited_for:
                    shutil.rmtree(found, ignore_errors=True)
                else:
                    with suppress(OSError):  # the job will report that the form is missing
                        self._sizes[found.name] = (found / "form").stat().st_size

    def size(self) -> int:
        """The bytes of all forms, including announced bytes that have not arrived yet."""
        with self._lock:
            return sum(self._sizes.values())

    def _claim(self, name: str, size: int) -> None:
        with self._lock:
            caller, held = CALLER.get(), Counter[str]()
            for form, its_size in self._sizes.items():
                held[self._callers.get(form, caller)] += its_size
            share = self.capacity // len({*held, caller})
            if held.total() + size > self.capacity and held[caller] + size > share:
                raise StagingFull("Too many frames are waiting to be enrolled already; send these again later.")
            self._sizes[name] = self._coming[name] = size
            self._callers[name] = caller

    def _expect_room(self) -> None:
        """Check that the disk has room for all bytes that are still to arrive, and for the reserve."""
        with self._lock:
            coming = sum(self._coming.values())
        if shutil.disk_usage(self._folder).free < coming + self._reserve:
            raise StorageFull(f"The disk has no room for {coming} bytes of waiting frames beside the maps.")

    async def receive(
        self,
        chunks: AsyncIterator[bytes],
        content_type: str,
        announced: int,
        max_parts: int,
        max_part_bytes: int,
    ) -> str:
        """Write a form to disk as it arrives; returns its name when the form is complete and synced.

        If an error is raised, nothing of the form is left.

        Args:
            announced: how many bytes the form has, or may have at most.

        Raises:
            StagingFull: too many bytes are waiting already.
            MalformedBody: the form is not multipart, or incomplete.
            BodyTooLarge: the form has too many parts.
            StorageFull, StorageFailure: the disk is full or refuses.
            Others: errors of ``chunks``.
        """
        arrival = Arrival(self._folder, "store the frames", inside="form")
        name = arrival.name
        self._claim(name, announced)
        try:
            async with arriving(arrival, self._expect_room):
                writer = _Writer(content_type, max_parts, max_part_bytes, arrival.file)
                async for piece in in_pieces(chunks):
                    await to_its_end(partial(_feed, writer, piece))
                    self._coming[name] = max(0, self._coming[name] - len(piece))
                writer.close()
                size = await to_its_end(lambda: _complete(arrival, writer.staged))
        except BaseException:
            with self._lock:
                del self._sizes[name], self._coming[name], self._callers[name]
            raise
        with self._lock:
            del self._coming[name]
            self._sizes[name] = size
        return name


def _complete(arrival: Arrival, staged: Sequence[StagedPart]) -> int:
    """Write the list of the parts beside their bytes, and complete the form; returns the bytes of the parts."""
    with disk_errors("store the frames"):
        write_file(arrival.temporary / "parts", json.dumps([asdict(part) for part in staged]).encode())
    return arrival.complete()


def _feed(writer: _Writer, data: bytes) -> None:
    with disk_errors("store the frames"):
        writer.feed(data)
