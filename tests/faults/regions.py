"""The regions of an SQLite file and of its log: one byte of every kind, named by what lies there."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

HEADER = {
    0: "magic", 15: "magic's end", 16: "page size", 18: "write version", 19: "read version", 20: "reserved bytes",
    21: "largest payload", 22: "smallest payload", 23: "payload of leaves", 27: "changes", 31: "pages",
    35: "first free page", 39: "free pages", 43: "schema cookie", 47: "schema format", 51: "cache size",
    55: "largest root", 59: "text encoding", 63: "version of the tables", 67: "vacuum", 71: "kind of file",
    80: "reserved", 95: "valid for", 99: "version of SQLite",
}  # fmt: skip
"""The fields of the first hundred bytes, each by a byte of it (https://www.sqlite.org/fileformat2.html)."""

_INNER = (2, 5)
_BTREE = (2, 5, 10, 13)
_LOG_HEADER, _FRAME = 32, 24

BLOBS: Mapping[str, str] = {
    "descriptors": "bytes", "locals": "bytes", "codes": "bytes", "pictures": "bytes", "keypoints": "record",
    "review_pictures": "bytes",
}  # fmt: skip
"""The tables of long values, and their columns."""


@dataclass(frozen=True)
class Region:
    """A byte of a file, and what it is part of."""

    name: str
    offset: int


def pages_of(path: Path) -> Iterator[Region]:
    """The header, and of each page of every table and index, and of each free page, some bytes of every kind."""
    yield from (Region(f"the header's {name}", offset) for offset, name in HEADER.items())
    content = path.read_bytes()
    with closing(sqlite3.connect(path)) as connection:
        ((size,),) = connection.execute("PRAGMA page_size").fetchall()
        owners = dict(connection.execute("SELECT pageno, name || ' ' || pagetype FROM dbstat").fetchall())
    for number in range(1, len(content) // size + 1):
        name, start = f"page {number}, {owners.get(number, 'free')}", (number - 1) * size
        page = content[start : start + size]
        found = _of_page(page, 100 if number == 1 else 0, owners.get(number, "free").split()[-1])
        yield from (Region(f"{name}: {what}", start + offset) for what, offset in found.items())


def _of_page(page: bytes, start: int, kind: str) -> dict[str, int]:
    if kind in ("free", "overflow") or page[start] not in _BTREE:
        middle = len(page) // 2
        return {"next page": 3, "count": 7, "first page": 11, "middle": middle, "end": len(page) - 1}
    inner, cells = page[start] in _INNER, int.from_bytes(page[start + 3 : start + 5], "big")
    found = {
        "kind": start, "free block": start + 2, "cells": start + 4, "content": start + 6, "fragments": start + 7,
    }  # fmt: skip
    first = start + (12 if inner else 8)
    if inner:
        found["right page"] = first - 1
    places = sorted(int.from_bytes(page[at : at + 2], "big") for at in range(first, first + 2 * cells, 2))
    if not places:
        return found
    found |= {"first pointer": first + 1, "last pointer": first + 2 * cells - 2}
    found["unused"] = (first + 2 * cells + places[0]) // 2
    for number in sorted({0, cells // 2, cells - 1}):
        begin, end = places[number], [*places, len(page)][number + 1]
        for what, offset in (("length", 0), ("key", 1), ("types", 4), ("first value", 12)):
            found[f"cell {number}'s {what}"] = min(begin + offset, end - 1)
        found[f"cell {number}'s middle"], found[f"cell {number}'s end"] = (begin + end) // 2, end - 1
    return found


def blobs_of(path: Path) -> Iterator[Region]:
    """First, middle and last byte of the first, the middle and the last long value of each table.

    A map whose places are compared whole has no codes.
    """
    content = path.read_bytes()
    with closing(sqlite3.connect(path)) as connection:
        for table, column in BLOBS.items():
            values = [value for (value,) in connection.execute(f"SELECT {column} FROM {table}").fetchall()]
            assert values or table == "codes", table
            for number in sorted({0, len(values) // 2, len(values) - 1} if values else ()):
                value = values[number]
                for what, at in {"first": 0, "middle": len(value) // 2, "last": len(value) - 1}.items():
                    yield Region(f"value {number} of {table}: its {what} byte", _found(content, value, at))


def _found(content: bytes, value: bytes, at: int) -> int:
    """Where a byte of a value lies, which may take several pages."""
    part = slice(0, len(value)) if len(value) < 10_000 else slice(max(0, at - 64), at + 64)
    assert content.count(value[part]) == 1
    return content.index(value[part]) + at - part.start


def log_of(path: Path) -> Iterator[Region]:
    """The header of a write-ahead log, and of each frame its header and its page."""
    content = path.read_bytes()
    size = int.from_bytes(content[8:12], "big")
    for name, offset in {"magic": 0, "version": 7, "page size": 10, "salt": 16, "checksum": 24, "end": 31}.items():
        yield Region(f"the log's {name}", offset)
    for number, start in enumerate(range(_LOG_HEADER, len(content) - _FRAME - size + 1, _FRAME + size), start=1):
        parts = {
            "page": 3, "size": 7, "salt": 11, "checksum": 19, "first byte": _FRAME, "middle": _FRAME + size // 2,
            "last byte": _FRAME + size - 1,
        }  # fmt: skip
        yield from (Region(f"frame {number}: its {name}", start + offset) for name, offset in parts.items())
