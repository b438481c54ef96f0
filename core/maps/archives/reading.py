"""Reading an export file from an untrusted source: everything in it is checked."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from types import TracebackType
from typing import Self

from core.errors import InvalidArchive
from core.maps.archives.lines import MOST_LINE_BYTES
from core.maps.archives.manifest import MANIFEST, SEAL, ArchivePart, Manifest, read_manifest, seal_of, tag_of
from core.maps.archives.tar_layout import (
    BLOCK,
    END_BYTES,
    Member,
    TarLayout,
    describe,
    header,
    manifest_size,
    padded,
)

CHUNK_BYTES = 1 << 20


class Archive:
    """An export file, open for reading; close it, or use it in a ``with`` statement.

    Raises:
        InvalidArchive: it is not an export file, or not as long as its manifest says.
        ArchiveTooNew: a later version of placerec wrote it.
        OSError: the disk refuses.
    """

    def __init__(self, path: Path) -> None:
        self._file = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
        try:
            self.size = os.fstat(self._file).st_size
            found = opening_of(self._read_at(0, BLOCK), self._read_at)
            if found is None:
                raise InvalidArchive("The file ends within its manifest.")
            self.manifest, self.tape, self.tag = found
            self._members = {member.name: member for member in self.tape.members}
            self._check_size()
        except BaseException:
            os.close(self._file)
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        os.close(self._file)

    def part(self, part: ArchivePart) -> PartReader:
        """A reader of a part, from its beginning to its end."""
        return PartReader(self._read_at, self._members[part.name], part)

    def check_end(self) -> None:
        """Raise InvalidArchive unless the file ends as a tar file must."""
        if any(self._read_at(self.tape.end, END_BYTES)):
            raise InvalidArchive("The end of the file is damaged.")

    def _check_size(self) -> None:
        if self.size < self.tape.size:
            raise InvalidArchive(f"The file is cut: it has {self.size} of its {self.tape.size} bytes.")
        if self.size > self.tape.size:
            member = self._read_at(self.tape.end, BLOCK)
            more = "more members than the manifest names" if any(member) else "bytes after its end"
            raise InvalidArchive(f"The file has {more}: {self.size} bytes instead of {self.tape.size}.")

    def _read_at(self, offset: int, size: int) -> bytes:
        parts = []
        while size and (part := os.pread(self._file, min(size, CHUNK_BYTES), offset)):
            parts.append(part)
            offset, size = offset + len(part), size - len(part)
        return b"".join(parts)


def opening_of(first: bytes, read_at: Callable[[int, int], bytes]) -> tuple[Manifest, TarLayout, str] | None:
    """The manifest, layout and tag of a file, read from its beginning; None if it ends within the manifest.

    Args:
        first: the first block of the file.
        read_at: returns bytes of the file by offset and size, fewer at its end.

    Raises:
        InvalidArchive, ArchiveTooNew.
    """
    if len(first) < BLOCK:
        return None
    size = manifest_size(first)
    text = read_at(BLOCK, size)
    if len(text) < size:
        return None
    rest = padded(size) - size + BLOCK + padded(len(seal_of(text)))
    following = read_at(BLOCK + size, rest)
    if len(following) < rest:
        return None
    expected = bytes(padded(size) - size) + header(SEAL, len(seal_of(text))) + seal_of(text)
    if following != expected.ljust(rest, b"\0"):
        raise InvalidArchive(f"{MANIFEST} is damaged: it does not match {SEAL}.")
    manifest = read_manifest(text)
    tape = TarLayout(manifest, size)
    return manifest, tape, tag_of(text)


class PartReader:
    """Reads one part in order; its data is trustworthy only when :meth:`finish` has returned."""

    def __init__(self, read_at: Callable[[int, int], bytes], member: Member, part: ArchivePart) -> None:
        self._read_at, self._member, self._part = read_at, member, part
        block = read_at(member.start - BLOCK, BLOCK)
        if block != header(member.name, member.size):
            raise InvalidArchive(f"The file is not what its manifest says: {describe(block, member)}.")
        self._position = 0
        self._digest = hashlib.sha256()

    @property
    def name(self) -> str:
        """The name of the part."""
        return self._part.name

    def read(self, size: int) -> bytes:
        """The next ``size`` bytes.

        Raises:
            InvalidArchive: fewer are left.
        """
        if size > self._member.size - self._position:
            raise InvalidArchive(f"{self.name} is shorter than its content needs.")
        data = self._read_at(self._member.start + self._position, size)
        if len(data) < size:
            raise InvalidArchive(f"The file is cut within {self.name}.")
        self._position += size
        self._digest.update(data)
        return data

    def lines(self) -> Iterator[bytes]:
        """The rest of the part, line by line, without line ends.

        Raises:
            InvalidArchive: a line is too long, or the last one has no line end.
        """
        rest = b""
        while left := self._member.size - self._position:
            *whole, rest = (rest + self.read(min(left, CHUNK_BYTES))).split(b"\n")
            if max(map(len, (*whole, rest))) > MOST_LINE_BYTES:
                raise InvalidArchive(f"{self.name} has a line of more than {MOST_LINE_BYTES} bytes.")
            yield from whole
        if rest:
            raise InvalidArchive(f"{self.name} does not end with a line end.")

    def skip(self) -> None:
        """Read the rest only for its checksum."""
        while left := self._member.size - self._position:
            self.read(min(left, CHUNK_BYTES))

    def finish(self) -> None:
        """Check that all of the part was read, and that it has the SHA-256 in the manifest.

        Raises:
            InvalidArchive: it was not, or has not.
        """
        if self._position != self._member.size:
            raise InvalidArchive(f"{self.name} is longer than its content.")
        if self._digest.hexdigest() != self._part.sha256:
            raise InvalidArchive(f"{self.name} is damaged: it does not match its SHA-256.")
        end = self._member.start + self._member.size
        if any(self._read_at(end, self._member.end - end)):
            raise InvalidArchive(f"{self.name}: the padding after it is not zero.")


def check(archive: Archive, advance: Callable[[int, int], None] = lambda _done, _all: None) -> None:
    """Read all of a file and compare it with its checksums.

    Args:
        advance: is called with the number of bytes read and of all.

    Raises:
        InvalidArchive: it is damaged; the text names the part.
        OSError: the disk refuses.
    """
    for part, member in zip(archive.manifest.parts, archive.tape.members[2:], strict=True):
        reader = archive.part(part)
        reader.skip()
        reader.finish()
        advance(member.end, archive.tape.size)
    archive.check_end()
