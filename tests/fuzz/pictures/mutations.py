"""Damaged pictures by number: the same seed, number and originals always give the same bytes."""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from tests.fuzz.pictures import exifs, jpegs, pngs, webps
from tests.fuzz.pictures.originals import Original

Mutation = Callable[[bytes, random.Random], bytes]

BLIND_SHARE = 0.4
"""Of the mutants that know nothing of their format; the others change a field that means something."""

FLOOD = 40_000
"""Bytes of a mutation that makes a file longer, at most."""


@dataclass(frozen=True)
class Mutant:
    """A damaged file: which original, what was done to it, what it is sent as."""

    index: int
    original: str
    format: str
    kind: str
    data: bytes


def mutant(seed: int, index: int, originals: Sequence[Original]) -> Mutant:
    """The mutant of a number; of some, two or three mutations meet in one file."""
    chance = random.Random(f"{seed}/{index}")
    original = chance.choice(originals)
    data, kinds = original.data, []
    for _ in range(chance.choice((1, 1, 1, 1, 2, 3))):
        blind = chance.random() < BLIND_SHARE
        name, mutation = chance.choice(_BLIND if blind else _KNOWING[original.format])
        kinds.append(name)
        data = _applied(mutation, data, chance)
    if chance.random() < 0.04:
        name, data = "polyglot", _polyglot(data, originals, chance)
        kinds.append(name)
    return Mutant(index, original.name, original.format, kinds[0] if len(kinds) == 1 else "several", data)


def _applied(mutation: Mutation, data: bytes, chance: random.Random) -> bytes:
    """A mutation of a field that an earlier one took away leaves the bytes as they are."""
    try:
        return mutation(data, chance)
    except (LookupError, ValueError, OverflowError):
        return data


def _place(data: bytes, chance: random.Random) -> int:
    return chance.randrange(len(data) + 1)


def flip_bits(data: bytes, chance: random.Random) -> bytes:
    """One to thirty-two bits."""
    changed = bytearray(data)
    for _ in range(chance.choice((1, 1, 2, 4, 8, 32)) if changed else 0):
        changed[chance.randrange(len(changed))] ^= 1 << chance.randrange(8)
    return bytes(changed)


def flip_head(data: bytes, chance: random.Random) -> bytes:
    """One to eight bits among the first 700 bytes, where headers and tables stand."""
    return flip_bits(data[:700], chance) + data[700:]


def overwrite(data: bytes, chance: random.Random) -> bytes:
    """A few bytes by extreme ones."""
    at, many = _place(data, chance), chance.choice((1, 2, 4, 8, 64))
    filling = chance.choice((b"\0", b"\xff", b"\x7f", b"\x80", None))
    return data[:at] + (chance.randbytes(many) if filling is None else filling * many) + data[at + many :]


def truncate(data: bytes, chance: random.Random) -> bytes:
    """Anywhere, or within its head."""
    return data[: chance.randrange(min(len(data), chance.choice((64, 1024, len(data) or 1))) + 1)]


def truncate_and_close(data: bytes, chance: random.Random) -> bytes:
    """Cut, with the end marker of a whole file behind the cut."""
    ends = {b"\xff\xd8": b"\xff\xd9", b"\x89P": b"\0\0\0\0IEND\xaeB`\x82"}
    return data[: _place(data, chance)] + ends.get(data[:2], b"")


def cut_out(data: bytes, chance: random.Random) -> bytes:
    """Some bytes from the middle."""
    at = _place(data, chance)
    return data[:at] + data[at + chance.choice((1, 2, 7, 100, 2000)) :]


def insert(data: bytes, chance: random.Random) -> bytes:
    """Random bytes somewhere."""
    at = _place(data, chance)
    return data[:at] + chance.randbytes(chance.choice((1, 2, 5, 50, 3000))) + data[at:]


def repeat(data: bytes, chance: random.Random) -> bytes:
    """A stretch, up to many times."""
    at = _place(data, chance)
    stretch = data[at : at + chance.choice((1, 16, 300))]
    times = min(chance.choice((1, 2, 50, 1000)), FLOOD // max(1, len(stretch)))
    return data[:at] + stretch * times + data[at:]


def splice(data: bytes, chance: random.Random) -> bytes:
    """Its own halves the wrong way round."""
    a, b = sorted((_place(data, chance), _place(data, chance)))
    return data[:a] + data[b:] + data[a:b]


def empty(_data: bytes, chance: random.Random) -> bytes:
    """Nothing, or next to nothing."""
    return chance.choice((b"", b"\0", b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n", b"RIFF\0\0\0\0WEBP"))


def append(data: bytes, chance: random.Random) -> bytes:
    """Bytes after the end; a receiver may tolerate them."""
    return data + chance.choice((b"\0" * 10_000, chance.randbytes(500), data))


def untouched(data: bytes, _chance: random.Random) -> bytes:
    """None: sound files among the damaged have to be answered as ever."""
    return data


def _polyglot(data: bytes, originals: Sequence[Original], chance: random.Random) -> bytes:
    """Two files in one: behind each other, or one within the other, or behind a head of another kind."""
    other = chance.choice(originals).data
    heads = (b"%PDF-1.7\n", b"PK\x03\x04", b"GIF89a", b"<svg/>", b"#!/bin/sh\n", b"BM" + bytes(16))
    at = _place(data, chance)
    return chance.choice((data + other, data[:at] + other + data[at:], chance.choice(heads) + data, data[:at] + other))


_BLIND: list[tuple[str, Mutation]] = [
    (one.__name__, one)
    for one in (
        flip_bits, flip_head, overwrite, truncate, truncate_and_close, cut_out, insert, repeat, splice, empty, append,
        untouched,
    )
]  # fmt: skip

_KNOWING: dict[str, list[tuple[str, Mutation]]] = {
    "jpeg": [*jpegs.MUTATIONS.items(), *exifs.in_format("jpeg").items()],
    "png": [*pngs.MUTATIONS.items(), *exifs.in_format("png").items()],
    "webp": [*webps.MUTATIONS.items(), *exifs.in_format("webp").items()],
}

KINDS = sorted({name for name, _ in _BLIND} | {name for kinds in _KNOWING.values() for name, _ in kinds} | {"several"})
"""Names of all kinds of damage."""
