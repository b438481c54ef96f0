"""Checking SQLite's write-ahead log of a map, before SQLite opens it, for committed transactions that are damaged.

SQLite reads a log up to the first frame that fails its checksum and ignores the rest, because that is what a crash
leaves.  A crash can only affect the last transaction, since each is synced before the next begins.  If further
transactions follow the first damaged frame, the log was damaged later, and acknowledged writes would be lost silently.

After the last transaction there may be frames of one that was rolled back: it was too large for memory and was written
before its end, or its sync failed.  They look like other frames, but each frame's checksum continues that of the frame
before it, and theirs do not continue the last transaction's.  After such a break, frames are not known to have been
committed after what precedes them.

The log is a header of 32 bytes and frames of 24 bytes and a page: https://www.sqlite.org/fileformat2.html#walformat
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from core.disk.files import Damage

_HEADER = struct.Struct(">8I")
_FRAME = struct.Struct(">6I")
_MAGIC = 0x377F0682  # the lowest bit is set if checksums are computed of big-endian words
_WORD = 0xFFFFFFFF

Sums = tuple[int, int]


def _sums(content: bytes, order: str, before: Sums) -> Sums:
    first, second = before
    for even, odd in struct.iter_unpack(f"{order}II", content):
        first = (first + even + second) & _WORD
        second = (second + odd + first) & _WORD
    return first, second


@dataclass(frozen=True)
class _Log:
    order: str
    page: int
    salts: tuple[int, int]
    sums: Sums


def _header(file: BinaryIO, name: str) -> _Log | None:
    """The header of a log; None for a log in which nothing was ever committed."""
    head = file.read(_HEADER.size)
    if len(head) < _HEADER.size:
        return None
    magic, _, page, _, *salts, first, second = _HEADER.unpack(head)
    order = ">" if magic & 1 else "<"
    is_sound = magic & ~1 == _MAGIC and _sums(head[:24], order, (0, 0)) == (first, second)
    if not is_sound or page < 512 or page & (page - 1):
        if file.read(1):
            raise Damage(f"{name}: its header does not match its checksum")
        return None
    return _Log(order, page, (salts[0], salts[1]), (first, second))


def _frames(file: BinaryIO, log: _Log) -> Iterator[tuple[bytes, bytes]]:
    while len(head := file.read(_FRAME.size)) == _FRAME.size and len(page := file.read(log.page)) == log.page:
        yield head, page


def check_log(path: Path) -> None:
    """Check the log of a database that is not open; nothing happens if there is none.

    Raises:
        Damage: transactions that were committed and synced cannot be read any more.
        OSError: the disk refuses.
    """
    try:
        file = path.open("rb")
    except FileNotFoundError:
        return
    with file:
        log = _header(file, path.name)
        if log is None:
            return
        broken, commits = 0, 0  # the first damaged frame, and how many transactions end from there on
        before = {log.sums}  # checksums that the next frame's may continue
        for number, (head, page) in enumerate(_frames(file, log), start=1):
            _, size, *salts, first, second = _FRAME.unpack(head)
            is_ours = (salts[0], salts[1]) == log.salts
            if broken and not is_ours:
                before, commits = set(), 0
                continue
            found = {_sums(page, log.order, _sums(head[:8], log.order, sums)) for sums in before}
            follows = (first, second) in found
            before = {(first, second)}
            if not broken:
                if is_ours and follows:
                    continue
                broken = number
                before |= found  # it may be the checksum itself that is damaged
            elif not follows:
                commits = 0
            elif commits:
                raise Damage(f"{path.name}: frame {broken} is damaged, and what was committed after it is lost")
            commits += size > 0 and (is_ours or follows)
