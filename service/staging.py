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
from collections.abc import AsyncIterator, Collection, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

from anyio import to_thread

from core.errors import StorageFailure
from core.storage.disk import refusals, sync_folder, write_at, write_file
from service.faults import StagingFull
from service.multipart import FormReader, Part

FOLDER = "staging"
AT_ONCE = 1 << 20
"""Bytes that are gathered before they are parsed and written."""


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
            with refusals(f"read {folder}"):
                listed = json.loads((folder / "parts").read_bytes())
            self.parts = [StagedPart(**part) for part in listed]
        except (ValueError, TypeError) as error:
            raise StorageFailure(f"{folder / 'parts'} is damaged: {error}.") from error

    def read(self, part: StagedPart) -> Part:
        """A part with its bytes.

        Raises:
            StorageFailure: they are not those that came, or cannot be read.
        """
        with refusals(f"read {self._path}"), self._path.open("rb") as file:
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
    """

    def __init__(self, directory: Path, capacity: int) -> None:
        self._folder, self.capacity = directory / FOLDER, capacity
        self._lock = threading.Lock()
        self._claimed = 0

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
        with refusals(f"remove {self._folder / name}"):
            if (self._folder / name).exists():
                shutil.rmtree(self._folder / name)

    def clean(self, waited_for: Collection[str]) -> None:
        """Remove all but what is waited for, as a crash left it; call it before anything arrives."""
        if self._folder.is_dir():
            for found in self._folder.iterdir():
                if found.name not in waited_for:
                    shutil.rmtree(found, ignore_errors=True)

    def size(self) -> int:
        """Bytes that lie there now."""
        if not self._folder.is_dir():
            return 0
        with refusals(f"look at {self._folder}"):
            forms = [path for path in self._folder.glob("*/form") if not path.parent.name.startswith(".")]
            return sum(path.stat().st_size for path in forms)

    @contextmanager
    def _room(self, size: int) -> Iterator[None]:
        with self._lock:
            if self.size() + self._claimed + size > self.capacity:
                raise StagingFull("Too much waits to be enrolled already; send this again later.")
            self._claimed += size
        try:
            yield
        finally:
            with self._lock:
                self._claimed -= size

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
        with self._room(announced):
            name = secrets.token_hex(8)
            arriving = self._folder / f".{name}"
            try:
                file = await to_thread.run_sync(lambda: _made(arriving))
                try:
                    writer = _Writer(content_type, max_parts, max_part_bytes, file)
                    gathered = bytearray()
                    async for chunk in chunks:
                        gathered += chunk
                        if len(gathered) >= AT_ONCE:
                            await to_thread.run_sync(lambda data=bytes(gathered): _fed(writer, data))  # type: ignore[misc]
                            gathered.clear()
                    await to_thread.run_sync(lambda: _fed(writer, bytes(gathered)))
                    writer.close()
                    await to_thread.run_sync(lambda: _finished(writer, file, arriving, self._folder / name))
                finally:
                    os.close(file)
            except BaseException:
                shutil.rmtree(arriving, ignore_errors=True)
                raise
        return name


def _made(folder: Path) -> int:
    with refusals(f"write {folder}"):
        folder.mkdir(parents=True)
        return os.open(folder / "form", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)


def _fed(writer: _Writer, data: bytes) -> None:
    with refusals("write down what arrives"):
        writer.feed(data)


def _finished(writer: _Writer, file: int, arriving: Path, there: Path) -> None:
    with refusals(f"write {there}"):
        os.fsync(file)
        write_file(arriving / "parts", json.dumps([asdict(part) for part in writer.staged]).encode())
        os.rename(arriving, there)
        sync_folder(there.parent)
        sync_folder(there.parent.parent)
