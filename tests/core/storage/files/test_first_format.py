"""Maps as they were written before there were local descriptors: made here by the rules of that time."""

from __future__ import annotations

import sqlite3
import struct
import zlib
from pathlib import Path

import faiss
import numpy as np
import pytest

from core.errors import MapQuarantined
from core.storage import Atlas
from tests.core.storage.frames import DIMENSION, ENCODER, descriptor_of, digest_of, frame
from tests.core.storage.test_opening import flip

PLACES, ROWS = 6, 4  # a full segment and a tail

TABLES = """
CREATE TABLE map (
    only INTEGER PRIMARY KEY CHECK (only = 1), id TEXT NOT NULL, encoder TEXT NOT NULL,
    dimension INTEGER NOT NULL CHECK (dimension > 0), rows_per_segment INTEGER NOT NULL CHECK (rows_per_segment > 0),
    description TEXT NOT NULL, keep TEXT NOT NULL, same_place_radius REAL NOT NULL,
    same_place_frames INTEGER NOT NULL, calibration TEXT, revision INTEGER NOT NULL, created_at TEXT NOT NULL,
    updated_at TEXT NOT NULL
) STRICT;
CREATE TABLE sequences (code INTEGER PRIMARY KEY AUTOINCREMENT, name TEXT UNIQUE, next_ordinal INTEGER NOT NULL) STRICT;
INSERT INTO sequences VALUES (-1, NULL, 0);
CREATE TABLE segments (
    number INTEGER PRIMARY KEY, rows INTEGER NOT NULL CHECK (rows > 0), checksum INTEGER NOT NULL
) STRICT;
CREATE TABLE places (
    number INTEGER PRIMARY KEY AUTOINCREMENT, id TEXT NOT NULL UNIQUE, row INTEGER NOT NULL UNIQUE CHECK (row >= 0),
    checksum INTEGER NOT NULL, digest BLOB NOT NULL CHECK (length(digest) = 32),
    regions INTEGER NOT NULL CHECK (regions >= 0),
    picture TEXT NOT NULL CHECK (picture IN ('none', 'thumbnail', 'image')),
    x REAL, y REAL, z REAL, latitude REAL, longitude REAL, heading REAL, timestamp TEXT,
    sequence INTEGER NOT NULL REFERENCES sequences (code), ordinal INTEGER NOT NULL, metadata TEXT NOT NULL,
    created_at TEXT NOT NULL, updated_at TEXT NOT NULL
) STRICT;
CREATE INDEX places_of_sequence ON places (sequence, number);
CREATE TABLE pictures (
    place INTEGER PRIMARY KEY REFERENCES places (number) ON DELETE CASCADE,
    digest BLOB NOT NULL CHECK (length(digest) = 32), bytes BLOB NOT NULL
) STRICT;
PRAGMA application_id = 0x504C5243;
PRAGMA user_version = 1;
"""
THEN = "2026-11-20T10:00:00.000000+00:00"


def sealed(content: bytes) -> bytes:
    return content + struct.pack("<I", zlib.crc32(content))


def checksum_of(row: int) -> int:
    return zlib.crc32(descriptor_of(f"p{row}").tobytes() + struct.pack("<Q", row))


def checksum_of_segment(first: int, stop: int) -> int:
    return zlib.crc32(b"".join(struct.pack("<I", checksum_of(row)) for row in range(first, stop)))


def write_segment(path: Path, first: int, stop: int) -> None:
    identity = ENCODER.encode()
    header = struct.pack("<8sI8sIIQH", b"PLRCSEG\x00", 1, b"<f4", DIMENSION, ROWS, first, len(identity)) + identity
    records = [
        descriptor_of(f"p{row}").tobytes() + struct.pack("<QII", row, checksum_of(row), 0) for row in range(first, stop)
    ]
    path.write_bytes(sealed(header.ljust(4092, b"\x00")) + b"".join(records))


def write_index(path: Path) -> None:
    index = faiss.IndexFlatIP(DIMENSION)
    index.add(np.array([descriptor_of(f"p{row}") for row in range(ROWS)]))
    faiss.write_index(index, str(path))
    trailer = struct.pack("<8sIII", b"PLRCIDX\x01", ROWS, DIMENSION, checksum_of_segment(0, ROWS))
    path.write_bytes(sealed(path.read_bytes() + trailer))


def write_tables(path: Path) -> None:
    connection = sqlite3.connect(path)
    connection.executescript(TABLES)
    connection.execute("INSERT INTO sequences (name, next_ordinal) VALUES ('monday', 6)")
    values = (1, "lab", ENCODER, DIMENSION, ROWS, "as it was", "none", 5.0, 3, None, 1, THEN, THEN)
    connection.execute(f"INSERT INTO map VALUES ({', '.join('?' * len(values))})", values)
    for number, (first, stop) in enumerate([(0, ROWS), (ROWS, PLACES)]):
        segment = (number, stop - first, checksum_of_segment(first, stop))
        connection.execute("INSERT INTO segments VALUES (?, ?, ?)", segment)
    for row in range(PLACES):
        connection.execute(
            "INSERT INTO places (id, row, checksum, digest, regions, picture, x, y, sequence, ordinal, metadata,"
            " created_at, updated_at) VALUES (?, ?, ?, ?, 3, 'none', ?, 0, 1, ?, '{}', ?, ?)",
            (f"p{row}", row, checksum_of(row), digest_of(f"p{row}"), float(row), row, THEN, THEN),
        )
    connection.commit()
    connection.close()


@pytest.fixture
def folder(directory: Path) -> Path:
    """Of a map of that time, in a data directory of that time."""
    folder = directory / "maps" / "lab"
    folder.mkdir(parents=True)
    (directory / "FORMAT").write_text("placerec data 1\n")
    write_tables(folder / "map.sqlite")
    write_segment(folder / "descriptors-000001.seg", 0, ROWS)
    write_segment(folder / "descriptors-000002.seg", ROWS, PLACES)
    write_index(folder / "index-000001.faiss")
    return folder


def files(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.suffix == ".seg"}


def test_it_opens_lists_searches_and_verifies(directory: Path, folder: Path) -> None:
    before = files(folder)
    atlas = Atlas(directory)
    assert [(record.id, record.local_shape) for record in atlas.records(None, 10)[0]] == [("lab", (0, 0))]
    lab = atlas.get("lab")
    assert [place.id for place in lab.places(None, 100)[0]] == [f"p{row}" for row in range(PLACES)]
    for row in range(PLACES):
        assert lab.snapshot().search(descriptor_of(f"p{row}"))[0][0] == row
    report = lab.verify()
    assert (report.ok, report.problems, report.stale_caches) == (True, [], [])
    assert lab.record.precision == "full"
    atlas.close()
    assert files(folder) == before
    # Nothing reads the second copy of the descriptors that was kept then.
    assert list(folder.glob("*.faiss")) == []


def test_it_is_written_on_in_its_own_format(directory: Path, folder: Path) -> None:
    atlas = Atlas(directory)
    lab = atlas.get("lab")
    lab.enrol([frame(f"p{row}", local_shape=(0, 0)) for row in range(PLACES, PLACES + 3)])
    with pytest.raises(ValueError, match="local descriptors"):
        lab.enrol([frame("q")])
    atlas.close()
    write_segment(directory / "expected", ROWS, 2 * ROWS)
    assert (folder / "descriptors-000002.seg").read_bytes() == (directory / "expected").read_bytes()
    atlas = Atlas(directory)
    assert atlas.get("lab").count_places() == PLACES + 3
    assert atlas.get("lab").verify().ok
    atlas.close()


def test_its_damage_is_found(directory: Path, folder: Path) -> None:
    flip(folder / "descriptors-000002.seg", 4096 + 3)
    atlas = Atlas(directory)
    with pytest.raises(MapQuarantined, match=r"descriptors-000002\.seg: row 4 does not match"):
        atlas.get("lab")
    assert not atlas.verify("lab").ok
    atlas.close()
