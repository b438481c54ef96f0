"""Lines of the audit trail, and files of them: read backwards from the latest line, over those that were moved away.

A line is found again by its file (the inode, which it keeps under its new name) and the position of its first byte, so
that lines which are written between two pages, and files which are moved away, shift nothing.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

from core.disk.files import disk_errors
from core.errors import InvalidCursor

BLOCK = 64 * 1024
"""Bytes that are read at a time."""

LONGEST_LINE = 256 * 1024
"""Longer lines are skipped; the trail writes none."""

MOST_FILES = 1000
"""Files that were moved away and are still read, the latest ones."""

COMPRESSED = (".gz", ".xz", ".zst", ".bz2")
"""Endings of files that cannot be read from their end."""


@dataclass(frozen=True)
class Position:
    """Where a line begins.

    file: inode of its file; 0 for lines in memory or in a table.
    offset: of its first byte; of a line in memory, how many were written when it was; of one in a table, its number.
    """

    file: int
    offset: int

    def text(self) -> str:
        """The position as text."""
        return f"{self.file}:{self.offset}"

    @classmethod
    def parsed(cls, text: str) -> Position:
        """The position of a text that :meth:`text` made.

        Raises:
            InvalidCursor: the text is none.
        """
        file, _, offset = text.partition(":")
        if not all(part.isascii() and part.isdigit() and len(part) < 20 for part in (file, offset)):
            raise InvalidCursor("The cursor was not made by this listing.")
        return cls(int(file), int(offset))


@dataclass(frozen=True)
class AuditLine:
    """One line of the trail.

    size: its bytes.
    fields: the JSON object; None if it is none, such as a line that a crash has torn, or one that is too long.
    """

    position: Position
    size: int
    fields: dict[str, Any] | None


def lines_of_files(path: Path, before: Position | None) -> Iterator[AuditLine]:
    """The lines of the trail from the latest to the oldest.

    Args:
        path: of the present file; files of its folder whose names begin with its name are older parts.
        before: only lines before this one; None: all.

    Raises:
        StorageFailure: a file cannot be read.
    """
    with disk_errors("read the audit trail", path.name):
        files = _files(path)
        if before is not None:
            known = [number for number, (_, inode) in enumerate(files) if inode == before.file]
            files = files[known[0] :] if known else []
        for number, (file, inode) in enumerate(files):
            try:
                opened = file.open("rb")
            except FileNotFoundError:
                continue  # it was removed meanwhile
            with opened:
                for offset, line in _backwards(opened, before.offset if number == 0 and before is not None else None):
                    yield AuditLine(Position(inode, offset), len(line), _parsed(line))


def _files(path: Path) -> list[tuple[Path, int]]:
    """The present file and those that were moved away, the latest first, with their inodes."""
    found: dict[int, tuple[bool, int, Path]] = {}
    with os.scandir(path.parent) as entries:
        for entry in entries:
            older = entry.name.startswith((f"{path.name}.", f"{path.name}-")) and not entry.name.endswith(COMPRESSED)
            if (older or entry.name == path.name) and entry.is_file(follow_symlinks=False):
                status = entry.stat(follow_symlinks=False)
                found[status.st_ino] = (entry.name == path.name, status.st_mtime_ns, Path(entry.path))
    ordered = sorted(((*traits, inode) for inode, traits in found.items()), reverse=True)
    return [(file, inode) for _, _, file, inode in ordered[:MOST_FILES]]


def _backwards(file: BinaryIO, end: int | None) -> Iterator[tuple[int, bytes]]:
    """The whole lines of a file from the last to the first, each with the position of its first byte.

    The text after the last newline is being written, or torn, and left out.  Of a line that is too long only pieces are
    given, so that the caller can count what was read.

    Args:
        end: only lines before this position, which is the beginning of a line; None: all.
    """
    size = file.seek(0, os.SEEK_END)
    start = size if end is None or end > size else end
    block, stop, torn = b"", 0, start == size and end != size  # block[:stop] are the bytes from start on
    while True:
        cut = block.rfind(b"\n", 0, max(0, stop - 1))
        if cut >= 0 or start == 0:
            if stop and not torn:
                yield start + cut + 1, block[cut + 1 : stop].removesuffix(b"\n")
            stop, torn = cut + 1, False
            if cut < 0:
                return
            continue
        if stop > LONGEST_LINE:
            yield start, block[:stop]
            block, stop, torn = b"", 0, True
        before = max(0, start - BLOCK)
        file.seek(before)
        block = file.read(start - before) + block[:stop]
        start, stop = before, len(block)
        if torn:  # nothing is known of the end of the block before its last newline
            stop = block.rfind(b"\n") + 1
            torn = stop == 0
            if torn:
                yield start, block
                block = b""


def _parsed(line: bytes) -> dict[str, Any] | None:
    try:
        found = json.loads(line)
    except (ValueError, RecursionError):
        return None
    return found if isinstance(found, dict) else None
