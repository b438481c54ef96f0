"""Where in an export file each part lies: the tar around the parts, which follows from the manifest to the last bit.

Because it does, a reader need not trust a tar: it knows beforehand what every header must be, and takes no other.
"""

from __future__ import annotations

import tarfile
from dataclasses import dataclass

from core.errors import InvalidArchive
from core.maps.archives.manifest import MANIFEST, MOST_MANIFEST_BYTES, SEAL, Manifest, seal_of

BLOCK = 512
END_BYTES = 2 * BLOCK
_SEAL_BYTES = len(seal_of(b""))


def header(name: str, size: int) -> bytes:
    """The header of a plain file of ``size`` bytes: 512 bytes that no time, owner or machine changes."""
    info = tarfile.TarInfo(name)
    info.size, info.mode, info.mtime = size, 0o644, 0
    return info.tobuf(tarfile.USTAR_FORMAT, "ascii", "strict")


def padded(size: int) -> int:
    """The length of a member of ``size`` bytes behind its header, padding included."""
    return -(-size // BLOCK) * BLOCK


@dataclass(frozen=True)
class Member:
    """A part, and where it begins; its header stands before that, zeros behind it up to a whole block."""

    name: str
    size: int
    start: int

    @property
    def end(self) -> int:
        """Behind the zeros."""
        return self.start + padded(self.size)


class TarLayout:
    """The members of a file in their order, and its length in bytes."""

    def __init__(self, manifest: Manifest, manifest_bytes: int) -> None:
        """The layout for a manifest that is written in ``manifest_bytes`` bytes."""
        sizes = [(MANIFEST, manifest_bytes), (SEAL, _SEAL_BYTES), *((part.name, part.bytes) for part in manifest.parts)]
        self.members: list[Member] = []
        position = 0
        for name, size in sizes:
            self.members.append(Member(name, size, position + BLOCK))
            position = self.members[-1].end
        self.end = position
        self.size = position + END_BYTES


def manifest_size(first: bytes) -> int:
    """How long the manifest is, by the first block of a file.

    Raises:
        InvalidArchive: the file does not begin with one.
    """
    try:
        found = tarfile.TarInfo.frombuf(first, "ascii", "strict")
    except (tarfile.TarError, ValueError):
        raise InvalidArchive("The file is not an export of a map: it does not begin as a tar does.") from None
    if not 0 < found.size <= MOST_MANIFEST_BYTES or first != header(MANIFEST, found.size):
        raise InvalidArchive(f"The file is not an export of a map: {MANIFEST}, a plain file, must come first.")
    return found.size


def describe(block: bytes, expected: Member) -> str:
    """The content in the place of a member's header, described for people."""
    if not any(block):
        return f"{expected.name} is missing: the tar ends before it"
    try:
        found = tarfile.TarInfo.frombuf(block, "utf-8", "surrogateescape")
    except (tarfile.TarError, ValueError):
        return f"the header of {expected.name} is damaged"
    name = repr(found.name[:80].encode("ascii", "backslashreplace").decode())
    if not found.isreg() or found.type == tarfile.GNUTYPE_SPARSE:
        return f"in the place of {expected.name} is {name}, which is not a plain file"
    if found.name != expected.name:
        return f"in the place of {expected.name} is {name}"
    return f"the header of {expected.name} is not as it must be"
