"""Damage to the parts of JPEG files: lengths, frame headers, tables, scans."""

from __future__ import annotations

import random
from collections.abc import Callable

SOI, EOI, SOS, DQT, DHT, DRI, COM, APP2 = 0xD8, 0xD9, 0xDA, 0xDB, 0xC4, 0xDD, 0xFE, 0xE2
FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}


def segments(data: bytes) -> list[tuple[int, int, int]]:
    """(marker, start, end) of each part up to the first scan's header; start is that of the FF."""
    found, position = [], 2
    while position + 4 <= len(data) and data[position] == 0xFF:
        marker = data[position + 1]
        end = position + 2 + int.from_bytes(data[position + 2 : position + 4], "big")
        found.append((marker, position, end))
        if marker == SOS:
            break
        position = end
    return found


def segment(marker: int, content: bytes) -> bytes:
    """A part with its length."""
    return bytes([0xFF, marker]) + (len(content) + 2).to_bytes(2, "big") + content


def _one(data: bytes, chance: random.Random, *markers: int) -> tuple[int, int, int]:
    return chance.choice([one for one in segments(data) if not markers or one[0] in markers])


def _put(data: bytes, at: int, content: bytes) -> bytes:
    return data[:at] + content + data[at + len(content) :]


def lie_about_a_length(data: bytes, chance: random.Random) -> bytes:
    """The length field of a part."""
    _, start, end = _one(data, chance)
    length = end - start - 2
    told = chance.choice((0, 1, 2, 3, length - 1, length + 1, length * 2, 0x7FFF, 0xFFFF, chance.randrange(65536)))
    return _put(data, start + 2, max(0, min(told, 65535)).to_bytes(2, "big"))


def lie_about_the_size(data: bytes, chance: random.Random) -> bytes:
    """Width and height of the frame header: more than the data holds, less, none, as many as can be."""
    _, start, _ = _one(data, chance, *FRAMES)
    at = start + 5 + 2 * chance.randrange(2)
    old = int.from_bytes(data[at : at + 2], "big")
    told = chance.choice((0, 1, 15, 16, old - 1, old + 1, old + 8, old * 2, old // 2, 4000, 65535))
    return _put(data, at, max(0, min(told, 65535)).to_bytes(2, "big"))


def raise_the_height(data: bytes, chance: random.Random) -> bytes:
    """Of the frame header alone, by so much that the picture's data ends before the picture."""
    _, start, _ = _one(data, chance, *FRAMES)
    old = int.from_bytes(data[start + 5 : start + 7], "big")
    return _put(data, start + 5, min(65535, old + chance.choice((8, 16, 32, old))).to_bytes(2, "big"))


def change_the_frame(data: bytes, chance: random.Random) -> bytes:
    """Another SOF, precision, number of components, sampling."""
    _, start, end = _one(data, chance, *FRAMES)
    at = chance.choice((start + 1, start + 4, start + 9, *range(start + 10, end)))
    value = chance.choice((*FRAMES,)) if at == start + 1 else chance.choice((0, 1, 2, 4, 8, 12, 16, 0x11, 0x44, 255))
    return _put(data, at, bytes([value]))


def damage_a_table(data: bytes, chance: random.Random) -> bytes:
    """Bytes of a quantization or Huffman table."""
    _, start, end = _one(data, chance, DQT, DHT)
    at = chance.randrange(start + 4, end)
    return _put(data, at, chance.choice((b"\0", b"\xff", b"\x10", chance.randbytes(1), chance.randbytes(4))))


def drop_a_part(data: bytes, chance: random.Random) -> bytes:
    """A table, the frame header, the scan header."""
    _, start, end = _one(data, chance)
    return data[:start] + data[end:]


def double_a_part(data: bytes, chance: random.Random) -> bytes:
    """The same: two frame headers, two scan headers."""
    _, start, end = _one(data, chance)
    return data[:end] + data[start:end] + data[end:]


def begin_again(data: bytes, chance: random.Random) -> bytes:
    """A second start marker, or the whole file within itself."""
    _, start, _ = _one(data, chance)
    return data[:start] + chance.choice((bytes([0xFF, SOI]), data, data[: len(data) // 2])) + data[start:]


def flood(data: bytes, chance: random.Random) -> bytes:
    """Thousands of empty parts, or comments of 64 KiB, before the picture."""
    many, filling = chance.choice(((5000, b""), (300, b"x" * 100), (3, b"y" * 65_000)))
    return data[:2] + segment(chance.choice((COM, APP2, 0xEF)), filling) * many + data[2:]


def add_scans(data: bytes, chance: random.Random) -> bytes:
    """The last scan again and again."""
    last = data.rfind(bytes([0xFF, SOS]))
    if last < 0 or len(data) - last > 20_000:
        return data
    return data[:-2] + data[last:-2] * chance.choice((1, 8, 40)) + data[-2:]


def damage_the_scan(data: bytes, chance: random.Random) -> bytes:
    """Coded data: a marker in it, restart markers out of order, some of it missing while the end marker stands."""
    start = segments(data)[-1][2]
    at = chance.randrange(start, len(data) - 2)
    restart = bytes([0xFF, 0xD0 + chance.randrange(8)])
    what = chance.choice(("cut", "restart", "restart", "end", "flip"))
    if what == "cut":
        return data[:at] + data[-2:]
    if what == "flip":
        return data[:at] + bytes([data[at] ^ (1 << chance.randrange(8))]) + data[at + 1 :]
    return data[:at] + (restart if what == "restart" else bytes([0xFF, EOI])) + data[at:]


def set_restarts(data: bytes, chance: random.Random) -> bytes:
    """An interval that the data does not keep."""
    interval = chance.choice((0, 1, 2, 1000, 65535)).to_bytes(2, "big")
    return data[:2] + segment(DRI, interval) + data[2:]


MUTATIONS: dict[str, Callable[[bytes, random.Random], bytes]] = {
    f"jpeg_{one.__name__}": one
    for one in (
        lie_about_a_length, lie_about_the_size, raise_the_height, change_the_frame, damage_a_table, drop_a_part,
        double_a_part, begin_again, flood, add_scans, damage_the_scan, set_restarts,
    )
}  # fmt: skip
"""By name."""
