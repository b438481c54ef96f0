"""Damage to the chunks of WebP files: sizes, canvas, flags, key frames."""

from __future__ import annotations

import random
from collections.abc import Callable

Chunks = list[tuple[bytes, bytes]]


def chunks(data: bytes) -> Chunks:
    """(kind, content) of each chunk."""
    found, position = [], 12
    while position + 8 <= len(data):
        end = position + 8 + int.from_bytes(data[position + 4 : position + 8], "little")
        found.append((data[position : position + 4], data[position + 8 : end]))
        position = end + (end - position) % 2
    return found


def file_of(parts: Chunks) -> bytes:
    """A WebP file of these chunks."""
    body = b"".join(
        kind + len(content).to_bytes(4, "little") + content + b"\0" * (len(content) % 2) for kind, content in parts
    )
    return b"RIFF" + (len(body) + 4).to_bytes(4, "little") + b"WEBP" + body


def extended(parts: Chunks, width: int, height: int, flags: int = 0) -> Chunks:
    """The same chunks under a VP8X header."""
    canvas = bytes([flags, 0, 0, 0]) + (width - 1).to_bytes(3, "little") + (height - 1).to_bytes(3, "little")
    return [(b"VP8X", canvas), *(part for part in parts if part[0] != b"VP8X")]


def lie_about_the_file(data: bytes, chance: random.Random) -> bytes:
    """The size in the RIFF header."""
    size = len(data) - 8
    told = chance.choice((0, 1, 4, size - 1, size + 1, size - 2, size + 2, size // 2, 2**31, 2**32 - 1))
    return data[:4] + told.to_bytes(4, "little") + data[8:]


def lie_about_a_length(data: bytes, chance: random.Random) -> bytes:
    """The size of the first or of a later chunk."""
    at = 12
    for _, content in chunks(data)[: chance.randrange(3)]:
        at += 8 + len(content) + len(content) % 2
    told = chance.choice((0, 1, 3, 10, 2**16, 2**31 - 1, 2**32 - 1, 2**32 - 9))
    return data[: at + 4] + told.to_bytes(4, "little") + data[at + 8 :]


def lie_about_the_canvas(data: bytes, chance: random.Random) -> bytes:
    """A VP8X header of another size, or with flags of what is not there."""
    side = chance.choice((1, 16, 159, 161, 6000, 2**14, 2**24))
    return file_of(extended(chunks(data), side, chance.choice((120, side)), chance.choice((0, 2, 4, 8, 16, 32, 255))))


def damage_the_picture(data: bytes, chance: random.Random) -> bytes:
    """Bytes of the head of the coded data: its size, its partitions, its transforms."""
    parts = chunks(data)
    at = chance.choice([i for i, (kind, _) in enumerate(parts) if kind in (b"VP8 ", b"VP8L", b"ALPH", b"ANMF")])
    content = bytearray(parts[at][1])
    for _ in range(chance.choice((1, 2, 8))):
        content[chance.randrange(min(len(content), chance.choice((12, 60, len(content)))))] = chance.randrange(256)
    parts[at] = (parts[at][0], bytes(content))
    return file_of(parts)


def cut_the_picture(data: bytes, chance: random.Random) -> bytes:
    """Coded data that ends early, with every size told rightly."""
    parts = chunks(data)
    at = chance.choice([i for i, (kind, _) in enumerate(parts) if kind in (b"VP8 ", b"VP8L", b"ALPH", b"ANMF")])
    parts[at] = (parts[at][0], parts[at][1][: chance.randrange(len(parts[at][1]))])
    return file_of(parts)


def shuffle(data: bytes, chance: random.Random) -> bytes:
    """The chunks in another order, twice, with one gone."""
    parts = chunks(data)
    which, at = chance.choice(("order", "twice", "gone")), chance.randrange(len(parts))
    if which == "order":
        chance.shuffle(parts)
    elif which == "twice":
        parts.insert(at, parts[chance.randrange(len(parts))])
    else:
        del parts[at]
    return file_of(parts)


def flood(data: bytes, chance: random.Random) -> bytes:
    """Unknown chunks by the thousand."""
    return file_of([*chunks(data), *([(b"JUNK", bytes(chance.choice((0, 3))))] * chance.choice((100, 17_000)))])


MUTATIONS: dict[str, Callable[[bytes, random.Random], bytes]] = {
    f"webp_{one.__name__}": one
    for one in (
        lie_about_the_file, lie_about_a_length, lie_about_the_canvas, damage_the_picture, cut_the_picture, shuffle,
        flood,
    )
}  # fmt: skip
"""By name."""
