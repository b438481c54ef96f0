"""Damage to the chunks of PNG files; checksums are corrected unless they are what is damaged."""

from __future__ import annotations

import random
import zlib
from collections.abc import Callable

from core.frames.containers import PNG_SIGNATURE

Chunks = list[tuple[bytes, bytes]]

BOMB = zlib.compress(bytes(20_000_000), 9)
"""Twenty megabytes of zeros in as many kilobytes."""


def chunks(data: bytes) -> Chunks:
    """(kind, content) of each chunk up to the first that is cut."""
    found, position = [], len(PNG_SIGNATURE)
    while position + 12 <= len(data):
        end = position + 8 + int.from_bytes(data[position : position + 4], "big")
        if end + 4 > len(data):
            break
        found.append((data[position + 4 : position + 8], data[position + 8 : end]))
        position = end + 4
    return found


def chunk(kind: bytes, content: bytes) -> bytes:
    """A chunk with its length and checksum."""
    return len(content).to_bytes(4, "big") + kind + content + zlib.crc32(kind + content).to_bytes(4, "big")


def file_of(parts: Chunks) -> bytes:
    """A PNG file of these chunks."""
    return PNG_SIGNATURE + b"".join(chunk(kind, content) for kind, content in parts)


def _index(parts: Chunks, kind: bytes) -> int:
    return [one for one, _ in parts].index(kind)


def lie_in_the_header(data: bytes, chance: random.Random) -> bytes:
    """Width, height, depth, colour type, interlace: with a right checksum."""
    parts = chunks(data)
    header = bytearray(parts[0][1])
    at = chance.choice((0, 4, 8, 9, 10, 11, 12))
    if at < 8:
        old = int.from_bytes(header[at : at + 4], "big")
        told = chance.choice((0, 1, 16, old + 1, old - 1, old * 2, 6000, 65_536, 2**31 - 1, 2**31, 2**32 - 1))
        header[at : at + 4] = told.to_bytes(4, "big")
    else:
        header[at] = chance.choice((0, 1, 2, 3, 4, 6, 7, 8, 16, 32, 255))
    parts[0] = (b"IHDR", bytes(header))
    return file_of(parts)


def lie_about_a_checksum(data: bytes, chance: random.Random) -> bytes:
    """One bit of a chunk or of its checksum."""
    changed = bytearray(data)
    changed[chance.randrange(len(PNG_SIGNATURE), len(changed))] ^= 1 << chance.randrange(8)
    return bytes(changed)


def lie_about_a_length(data: bytes, chance: random.Random) -> bytes:
    """The length of a chunk: too much, too little, more than there are bytes."""
    at = len(PNG_SIGNATURE)
    for _, content in chunks(data)[: chance.randrange(4)]:
        at += 12 + len(content)
    told = chance.choice((0, 1, 12, 14, 2**16, 2**31 - 1, 2**31, 2**32 - 1))
    return data[:at] + told.to_bytes(4, "big") + data[at + 4 :]


def damage_the_data(data: bytes, chance: random.Random) -> bytes:
    """Deflated rows under right checksums: a flipped bit, a cut, nothing, far too much."""
    parts = chunks(data)
    at = _index(parts, b"IDAT")
    content = parts[at][1]
    flipped = bytearray(content)
    flipped[chance.randrange(len(flipped))] ^= 1 << chance.randrange(8)
    cut = content[: chance.randrange(len(content))]
    again = chance.choice((bytes(flipped), cut, b"", BOMB, content + content, zlib.compress(b"\x09" * 10_000)))
    return file_of([*parts[:at], (b"IDAT", again), *parts[at + 1 :]])


def shuffle(data: bytes, chance: random.Random) -> bytes:
    """The chunks in another order, some twice, one gone."""
    parts = chunks(data)
    which = chance.choice(("order", "twice", "gone", "split"))
    at = chance.randrange(len(parts))
    if which == "order":
        chance.shuffle(parts)
    elif which == "twice":
        parts.insert(at, parts[chance.randrange(len(parts))])
    elif which == "gone":
        del parts[at]
    else:
        at = _index(parts, b"IDAT")
        content = parts[at][1]
        parts[at : at + 1] = [(b"IDAT", content[i : i + 97]) for i in range(0, len(content), 97)]
    return file_of(parts)


def flood(data: bytes, chance: random.Random) -> bytes:
    """Chunks that a decoder need not know, by the thousand; or text and profiles that unpack to much."""
    parts = chunks(data)
    text, profile = (b"zTXt", b"Comment\0\0" + BOMB), (b"iCCP", b"profile\0\0" + BOMB)
    international = (b"iTXt", b"Comment\0\x01\0\0\0" + BOMB)
    floods: tuple[Chunks, ...] = (
        [(b"tEXt", b"k\0v")] * 2000, [(b"vpAg", b"")] * 17_000, [text], [profile], [international], [text] * 8,
        [(b"sPLT", b"p\0\x08" + bytes(600))] * 50, [(b"hIST", bytes(512))], [(b"sBIT", b"\xff\xff\xff")],
    )  # fmt: skip
    return file_of([parts[0], *chance.choice(floods), *parts[1:]])


def damage_the_palette(data: bytes, chance: random.Random) -> bytes:
    """Too short, too long, of a part of a colour, none, transparency of more entries than it has."""
    kept = [part for part in chunks(data) if part[0] not in (b"PLTE", b"tRNS")]
    colours = bytes(chance.choice((0, 1, 3, 5, 768, 771)))
    clear = chance.randbytes(chance.choice((0, 1, 2, 6, 256, 300)))
    added: Chunks = [(b"PLTE", colours)] if chance.random() < 0.7 else []
    return file_of([kept[0], *added, (b"tRNS", clear), *kept[1:]])


def animate(data: bytes, chance: random.Random) -> bytes:
    """Control chunks of an animation."""
    parts = chunks(data)
    return file_of([parts[0], (b"acTL", chance.randbytes(8)), (b"fcTL", chance.randbytes(26)), *parts[1:]])


MUTATIONS: dict[str, Callable[[bytes, random.Random], bytes]] = {
    f"png_{one.__name__}": one
    for one in (
        lie_in_the_header, lie_about_a_checksum, lie_about_a_length, damage_the_data, shuffle, flood,
        damage_the_palette, animate,
    )
}  # fmt: skip
"""By name."""
