"""Maps as they were written when descriptors were kept whole: local descriptors behind each, no precision, no tiers."""

from __future__ import annotations

import sqlite3
import struct
import time
import zlib
from pathlib import Path

import numpy as np
import pytest

from core.errors import MapQuarantined
from core.storage import Atlas, Map
from tests.core.storage.files.test_first_format import PLACES, ROWS, TABLES, THEN, sealed
from tests.core.storage.frames import DIMENSION, ENCODER, LOCAL_SHAPE, descriptor_of, digest_of, frame, local_of
from tests.core.storage.test_opening import flip

LOCAL_TABLES = f"""
ALTER TABLE map ADD COLUMN local_cells INTEGER NOT NULL DEFAULT {LOCAL_SHAPE[0]} CHECK (local_cells >= 0);
ALTER TABLE map ADD COLUMN local_values INTEGER NOT NULL DEFAULT {LOCAL_SHAPE[1]} CHECK (local_values >= 0);
PRAGMA user_version = 2;
"""
RECORD = DIMENSION * 4 + 15 + 16


def checksum_of(row: int) -> int:
    content = descriptor_of(f"p{row}").tobytes() + local_of(f"p{row}").tobytes()
    return zlib.crc32(content + struct.pack("<Q", row))


def checksum_of_segment(first: int, stop: int) -> int:
    return zlib.crc32(b"".join(struct.pack("<I", checksum_of(row)) for row in range(first, stop)))


def write_segment(path: Path, first: int, stop: int) -> None:
    identity = ENCODER.encode()
    header = struct.pack("<8sI8sIIQH", b"PLRCSEG\x00", 2, b"<f4", DIMENSION, ROWS, first, len(identity))
    header += struct.pack("<II", *LOCAL_SHAPE) + identity
    records = [
        descriptor_of(f"p{row}").tobytes()
        + local_of(f"p{row}").tobytes()
        + struct.pack("<QII", row, checksum_of(row), 0)
        for row in range(first, stop)
    ]
    path.write_bytes(sealed(header.ljust(4092, b"\x00")) + b"".join(records))


def write_tables(path: Path) -> None:
    connection = sqlite3.connect(path)
    connection.executescript(TABLES + LOCAL_TABLES)
    values = (1, "lab", ENCODER, DIMENSION, ROWS, "as it was", "none", 5.0, 3, None, 1, THEN, THEN, *LOCAL_SHAPE)
    connection.execute(f"INSERT INTO map VALUES ({', '.join('?' * len(values))})", values)
    for number, (first, stop) in enumerate([(0, ROWS), (ROWS, PLACES)]):
        segment = (number, stop - first, checksum_of_segment(first, stop))
        connection.execute("INSERT INTO segments VALUES (?, ?, ?)", segment)
    for row in range(PLACES):
        connection.execute(
            "INSERT INTO places (id, row, checksum, digest, regions, picture, sequence, ordinal, metadata, created_at,"
            " updated_at) VALUES (?, ?, ?, ?, 3, 'none', -1, ?, '{}', ?, ?)",
            (f"p{row}", row, checksum_of(row), digest_of(f"p{row}"), row, THEN, THEN),
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
    return folder


def settled(lab: Map, tier: str) -> None:
    deadline = time.monotonic() + 60
    while (status := lab.index_status()).state == "building" or status.tier != tier:
        assert time.monotonic() < deadline
        time.sleep(0.005)


def check(lab: Map, names: list[str]) -> None:
    """Is every frame found, to the last bit what was enrolled, and nothing else?"""
    found = lab.snapshot()
    assert len(found) == len(names)
    for name in names:
        rows, products = found.search(descriptor_of(name))
        assert [place and place.id for place in lab.places_at(rows[:1].tolist())] == [name]
        assert products[0] == pytest.approx(1, abs=1e-5)
        np.testing.assert_array_equal(found.descriptors_at(rows[:1])[0], descriptor_of(name))
        np.testing.assert_array_equal(found.locals_at(rows[:1])[0], local_of(name))
    report = lab.verify()
    assert (report.ok, report.problems, report.stale_caches) == (True, [], [])


def test_it_goes_on_in_its_own_format_in_every_tier(directory: Path, folder: Path) -> None:
    names = [f"p{row}" for row in range(PLACES)]
    atlas = Atlas(directory)
    lab = atlas.get("lab")
    assert (lab.record.precision, lab.record.local_shape) == ("full", LOCAL_SHAPE)
    check(lab, names)
    for step, tier in enumerate(("compact", "exact")):
        lab.edit({"index": tier})
        settled(lab, tier)
        check(lab, names)
        lab.enrol([frame(f"p{PLACES + step}")])
        lab.forget(names.pop(0))
        names.append(f"p{PLACES + step}")
        check(lab, names)
        atlas.close()
        atlas = Atlas(directory)
        lab = atlas.get("lab")
        check(lab, names)
    atlas.close()
    write_segment(directory / "expected", ROWS, 2 * ROWS)
    assert (folder / "descriptors-000002.seg").read_bytes() == (directory / "expected").read_bytes()


@pytest.mark.parametrize("offset", [3, DIMENSION * 4 + 3], ids=["descriptor", "local"])
def test_its_damage_is_found(directory: Path, folder: Path, offset: int) -> None:
    flip(folder / "descriptors-000002.seg", 4096 + RECORD + offset)
    atlas = Atlas(directory)
    with pytest.raises(MapQuarantined, match=r"descriptors-000002\.seg: row 5 does not match"):
        atlas.get("lab")
    assert not atlas.verify("lab").ok
    atlas.close()
