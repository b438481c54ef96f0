"""EXIF blocks as no camera should write them, put into files that are otherwise sound."""

from __future__ import annotations

import random
import struct
from collections.abc import Callable

from tests.fuzz.pictures import jpegs, pngs, webps

PREFIX = b"Exif\0\0"
ORIENTATION, EXIF_FOLDER, GPS_FOLDER = 0x0112, 0x8769, 0x8825

Entry = tuple[int, int, int, bytes]
"""Tag, type, count, the four bytes of its value or offset."""


def block(entries: list[Entry], rest: bytes = b"", order: str = "<", count: int | None = None, after: int = 0) -> bytes:
    """A TIFF file of one directory at position 8 and what follows it."""
    head = (b"II*\0" if order == "<" else b"MM\0*") + struct.pack(order + "I", 8)
    told = len(entries) if count is None else count
    packed = b"".join(struct.pack(order + "HHI", *entry[:3]) + entry[3] for entry in entries)
    return head + struct.pack(order + "H", told) + packed + struct.pack(order + "I", after) + rest


def _number(value: int, order: str = "<") -> bytes:
    return struct.pack(order + "I", value)


def orientations(chance: random.Random) -> bytes:
    """0 to 9 and beyond, in each type and byte order."""
    order, value = chance.choice("<>"), chance.choice((*range(10), 255, 65535))
    kind = chance.choice((1, 2, 3, 4, 5, 7, 9, 13))
    packed = struct.pack(order + "HH", value, 0) if kind == 3 else _number(value, order)
    return block([(ORIENTATION, kind, chance.choice((0, 1, 2, 2**31)), packed)], order=order)


def cycles(chance: random.Random) -> bytes:
    """Directories that lead to themselves and to each other."""
    to = _number(chance.choice((0, 4, 8, 26, 2**32 - 1)))
    entries = [(EXIF_FOLDER, 4, 1, to), (GPS_FOLDER, 4, 1, _number(8)), (0x014A, 4, 1, _number(8))]
    return block(entries, after=chance.choice((8, 2**31)))


def garbage_positions(chance: random.Random) -> bytes:
    """A GPS directory of infinite, absurd and missing numbers."""
    halves = [chance.choice((0, 1, 90, 180, 2**32 - 1)) for _ in range(12)]
    entries: list[Entry] = [
        (1, 2, 2, chance.choice((b"N\0\0\0", b"S\0\0\0", b"\xff\xff\0\0"))),
        (2, chance.choice((5, 10, 2)), 3, _number(90)),
        (3, 2, 2, b"E\0\0\0"),
        (4, 5, chance.choice((3, 2**29, 0)), _number(90)),
        (17, 5, 1, _number(chance.choice((90, 2**32 - 8)))),
    ]
    folder = struct.pack("<H", len(entries))
    folder += b"".join(struct.pack("<HHI", *entry[:3]) + entry[3] for entry in entries) + bytes(4)
    return block([(GPS_FOLDER, 4, 1, _number(26))], folder + struct.pack("<12I", *halves))


def long_directories(chance: random.Random) -> bytes:
    """Counts and offsets past the end; tags by the thousand."""
    many = chance.choice((1, 600, 4000))
    entries = [
        (chance.randrange(65536), chance.randrange(16), chance.choice((1, 2**32 - 1)), chance.randbytes(4))
    ] * many
    return block(entries, count=chance.choice((many, 65535)))


def noise(chance: random.Random) -> bytes:
    """Random bytes behind a right start."""
    return chance.choice((b"II*\0", b"MM\0*", b"II+\0", b"")) + chance.randbytes(chance.choice((0, 3, 40, 2000)))


def clocks(chance: random.Random) -> bytes:
    """Times that do not exist, and zones."""
    when = chance.choice((b"0000:00:00 00:00:00\0", b"9999:12:31 23:59:60\0", b"\xff" * 20, b"2024:02:30 25:00:00\0"))
    zone = chance.choice((b"+99:99\0", b"-14:00\0", b"++:++\0\0"))
    folder = struct.pack("<H", 2) + struct.pack("<HHII", 0x9003, 2, 20, 56) + struct.pack("<HHII", 0x9011, 2, 7, 76)
    return block([(EXIF_FOLDER, 4, 1, _number(26))], folder + bytes(4) + when + zone)


_BLOCKS = (orientations, cycles, garbage_positions, long_directories, noise, clocks)


def _into_jpeg(data: bytes, exif: bytes) -> bytes:
    return data[:2] + jpegs.segment(0xE1, (PREFIX + exif)[:65_000]) + data[2:]


def _into_png(data: bytes, exif: bytes) -> bytes:
    parts = [part for part in pngs.chunks(data) if part[0] != b"eXIf"]
    return pngs.file_of([parts[0], (b"eXIf", exif), *parts[1:]])


def _into_webp(data: bytes, exif: bytes) -> bytes:
    parts = [part for part in webps.chunks(data) if part[0] != b"EXIF"]
    return webps.file_of([*webps.extended(parts, 160, 120, 8), (b"EXIF", exif)])


_INTO = {"jpeg": _into_jpeg, "png": _into_png, "webp": _into_webp}


def in_format(name: str) -> dict[str, Callable[[bytes, random.Random], bytes]]:
    """The mutations of files of one format, by name."""
    into = _INTO[name]

    def putting(make: Callable[[random.Random], bytes]) -> Callable[[bytes, random.Random], bytes]:
        return lambda data, chance: into(data, make(chance))

    return {f"exif_{make.__name__}": putting(make) for make in _BLOCKS}
