from __future__ import annotations

import os
import struct
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from core.storage.files.segment_files import (
    HEADER_BYTES,
    Layout,
    append,
    read_checked,
    read_records,
    rewind,
    segment_checksum,
    segment_name,
)
from numpy.typing import NDArray

from core.disk.files import Damage
from tests.core.store.frames import descriptor_of, local_of, packed, stored_of

LAYOUT = Layout(dimension=8, identity="encoder@1", rows_per_segment=4, local_shape=(3, 5))
WITHOUT = Layout(dimension=8, identity="encoder@1", rows_per_segment=4)
SPARE = 8 * 2 + 20  # the offset of the four bytes that nothing uses
RECORD_BYTES = 8 * 2 + 24 + 15


def rows(count: int, start: int = 0) -> list[NDArray[np.float32]]:
    return [stored_of(f"row {start + i}", LAYOUT.dimension) for i in range(count)]


def local(count: int, start: int = 0) -> list[NDArray[np.int8]]:
    return [local_of(f"row {start + i}") for i in range(count)]


def write(folder: Path, first_row: int, count: int, start: int | None = None) -> list[int]:
    """Rows behind the first ones; they show ``start`` and those that follow, by default what their number says."""
    shown = first_row if start is None else start
    records = packed(LAYOUT, rows(count, shown), local(count, shown), first_row)
    append(folder, LAYOUT, first_row, records)
    return [int(checksum) for checksum in records["checksum"]]


def checksum_of(layout: Layout, descriptor: NDArray[np.float32], cells: NDArray[np.int8], row: int) -> int:
    return int(packed(layout, [descriptor], [cells], row)["checksum"][0])


def stored(folder: Path, number: int, count: int, checksum: int) -> NDArray[np.float32]:
    return np.concatenate([part["descriptor"] for part in read_checked(folder, LAYOUT, number, count, checksum)])


def flip(path: Path, offset: int) -> None:
    content = bytearray(path.read_bytes())
    content[offset] ^= 1
    path.write_bytes(content)


def test_what_was_appended_is_read_over_several_segments(tmp_path: Path) -> None:
    checksums = write(tmp_path, 0, 3) + write(tmp_path, 3, 7)
    assert len(checksums) == 10
    assert sorted(os.listdir(tmp_path)) == [segment_name(number) for number in range(3)]
    for number, count in ((0, 4), (1, 4), (2, 2)):
        part = checksums[4 * number : 4 * number + count]
        np.testing.assert_array_equal(stored(tmp_path, number, count, segment_checksum(part)), rows(count, 4 * number))
        found = [records["local"] for records in read_checked(tmp_path, LAYOUT, number, count, segment_checksum(part))]
        np.testing.assert_array_equal(np.concatenate(found), local(count, 4 * number))
    assert (tmp_path / segment_name(2)).stat().st_size == HEADER_BYTES + 2 * RECORD_BYTES


def test_the_checksum_of_a_segment_can_be_continued() -> None:
    assert segment_checksum([1, 2, 3]) == segment_checksum([3], segment_checksum([1, 2]))
    assert segment_checksum([1, 2]) != segment_checksum([2, 1])


def test_the_checksum_of_a_row_is_of_all_that_it_holds() -> None:
    (descriptor,), (cells,) = rows(1), local(1)
    others = [(rows(1, 1)[0], cells, 0), (descriptor, local(1, 1)[0], 0), (descriptor, cells, 1)]
    assert checksum_of(LAYOUT, descriptor, cells, 0) not in [checksum_of(LAYOUT, *other) for other in others]
    parts = [zlib.crc32(part.tobytes() + struct.pack("<Q", 7)) for part in (descriptor.astype("<f2"), cells)]
    assert checksum_of(LAYOUT, descriptor, cells, 7) == zlib.crc32(struct.pack("<II", *parts))


def test_only_the_requested_rows_count(tmp_path: Path) -> None:
    checksums = write(tmp_path, 0, 3)
    with (tmp_path / segment_name(0)).open("ab") as file:
        file.write(b"half a record")
    assert len(stored(tmp_path, 0, 3, segment_checksum(checksums))) == 3


def test_rows_behind_are_overwritten(tmp_path: Path) -> None:
    first = write(tmp_path, 0, 3)
    second = write(tmp_path, 2, 1, 77)
    found = stored(tmp_path, 0, 3, segment_checksum([*first[:2], *second]))
    np.testing.assert_array_equal(found[2], rows(1, 77)[0])


@pytest.mark.parametrize(("kept", "files", "size"), [(0, 0, 0), (2, 1, 2), (4, 1, 4), (5, 2, 1), (9, 3, 1), (10, 3, 2)])
def test_rewinding_cuts_and_removes(tmp_path: Path, kept: int, files: int, size: int) -> None:
    write(tmp_path, 0, 10)
    (tmp_path / "map.sqlite").touch()
    rewind(tmp_path, LAYOUT, kept)
    left = sorted(tmp_path.glob("*.seg"))
    assert len(left) == files
    if left:
        assert left[-1].stat().st_size == HEADER_BYTES + size * RECORD_BYTES
    assert (tmp_path / "map.sqlite").exists()


@pytest.mark.parametrize("offset", [0, 8, 12, 31, 44, 60, HEADER_BYTES - 1])
def test_a_damaged_header_is_found(tmp_path: Path, offset: int) -> None:
    checksums = write(tmp_path, 0, 2)
    flip(tmp_path / segment_name(0), offset)
    with pytest.raises(Damage, match=r"descriptors-000001\.seg: the header"):
        stored(tmp_path, 0, 2, segment_checksum(checksums))


@pytest.mark.parametrize("offset", [*range(SPARE), *range(SPARE + 4, RECORD_BYTES)])
def test_every_flipped_bit_of_a_record_is_found(tmp_path: Path, offset: int) -> None:
    checksums = write(tmp_path, 0, 3)
    flip(tmp_path / segment_name(0), HEADER_BYTES + RECORD_BYTES + offset)
    with pytest.raises(Damage, match="row 1 does not match"):
        stored(tmp_path, 0, 3, segment_checksum(checksums))


def test_records_that_changed_places_are_found(tmp_path: Path) -> None:
    checksums = write(tmp_path, 0, 3)
    path = tmp_path / segment_name(0)
    content = path.read_bytes()
    a, b = (content[HEADER_BYTES + i * RECORD_BYTES : HEADER_BYTES + (i + 1) * RECORD_BYTES] for i in (0, 1))
    path.write_bytes(content[:HEADER_BYTES] + b + a + content[HEADER_BYTES + 2 * RECORD_BYTES :])
    with pytest.raises(Damage, match="row 0"):
        stored(tmp_path, 0, 3, segment_checksum(checksums))


def test_good_records_that_are_not_the_named_ones_are_found(tmp_path: Path) -> None:
    write(tmp_path, 0, 3, 50)
    checksum = segment_checksum(packed(LAYOUT, rows(3), local(3), 0)["checksum"])
    with pytest.raises(Damage, match="not those that map"):
        stored(tmp_path, 0, 3, checksum)


def test_a_file_that_is_missing_or_short(tmp_path: Path) -> None:
    with pytest.raises(Damage, match="missing"):
        stored(tmp_path, 0, 1, 0)
    write(tmp_path, 0, 3)
    path = tmp_path / segment_name(0)
    os.truncate(path, path.stat().st_size - 1)
    with pytest.raises(Damage, match="ends after 2 of 3 rows"):
        stored(tmp_path, 0, 3, 0)
    os.truncate(path, 100)
    with pytest.raises(Damage, match="within its header"):
        stored(tmp_path, 0, 3, 0)


@pytest.mark.parametrize(
    "other",
    [
        replace(LAYOUT, dimension=9),
        replace(LAYOUT, identity="encoder@2"),
        replace(LAYOUT, rows_per_segment=5),
        replace(LAYOUT, local_shape=(5, 3)),
        replace(LAYOUT, precision="compressed"),
        WITHOUT,
    ],
)
def test_a_segment_of_another_map_is_refused(tmp_path: Path, other: Layout) -> None:
    write(tmp_path, 0, 4)
    with pytest.raises(Damage, match="another map, encoder, segment or version"):
        list(read_records(tmp_path, other, 0, 1))
    (tmp_path / segment_name(0)).rename(tmp_path / segment_name(1))
    with pytest.raises(Damage, match="another"):
        list(read_records(tmp_path, LAYOUT, 1, 1))


@pytest.mark.parametrize("shape", [(0, 5), (3, 0), (-3, -5), (-1, 0)])
def test_local_descriptors_of_no_shape(shape: tuple[int, int]) -> None:
    with pytest.raises(ValueError, match="cannot have"):
        replace(LAYOUT, local_shape=shape)


@pytest.mark.parametrize("layout", [LAYOUT, WITHOUT], ids=["with local descriptors", "without"])
def test_a_file_written_out_by_its_rules(tmp_path: Path, layout: Layout) -> None:
    cells = [local_of(f"row {row}", layout.local_shape) for row in (4, 5)]
    append(tmp_path, layout, 4, packed(layout, rows(2, 4), cells, 4))
    head = struct.pack("<8sI8sIIQHII", b"PLRCSEG\x00", 3, b"<f2", 8, 4, 4, 9, *layout.local_shape) + b"encoder@1"
    expected = head.ljust(4092, b"\x00") + struct.pack("<I", zlib.crc32(head.ljust(4092, b"\x00")))
    for row, (halves, local_bytes) in enumerate(
        [(rows(1, row)[0].astype("<f2").tobytes(), cells[row - 4].tobytes()) for row in (4, 5)], start=4
    ):
        sums = [zlib.crc32(part + struct.pack("<Q", row)) for part in (halves, local_bytes)]
        expected += halves + struct.pack("<QIIII", row, zlib.crc32(struct.pack("<II", *sums)), *sums, 0) + local_bytes
    assert (tmp_path / segment_name(1)).read_bytes() == expected


@pytest.mark.parametrize(("version", "kept"), [(1, b"<f4"), (2, b"<f4"), (4, b"<f2")])
def test_a_file_of_a_version_that_no_release_wrote_is_refused(tmp_path: Path, version: int, kept: bytes) -> None:
    write(tmp_path, 0, 1)
    path = tmp_path / segment_name(0)
    content = bytearray(path.read_bytes())
    content[8:20] = struct.pack("<I8s", version, kept)
    content[HEADER_BYTES - 4 : HEADER_BYTES] = struct.pack("<I", zlib.crc32(content[: HEADER_BYTES - 4]))
    path.write_bytes(content)
    with pytest.raises(Damage, match="another map, encoder, segment or version"):
        list(read_records(tmp_path, LAYOUT, 0, 1))


def test_what_comes_back_is_the_descriptor_to_half_precision() -> None:
    given = [descriptor_of(f"row {i}", LAYOUT.dimension) for i in range(5)]
    records = packed(LAYOUT, given, local(5), 0)
    np.testing.assert_array_equal(LAYOUT.descriptors_of(records), np.array(given).astype(np.float16))
    np.testing.assert_allclose(LAYOUT.descriptors_of(records), given, rtol=2**-11)
    np.testing.assert_array_equal(LAYOUT.locals_of(records), local(5))
    types = [str(part.dtype) for part in (LAYOUT.descriptors_of(records), LAYOUT.locals_of(records))]
    assert types == ["float32", "int8"]


def test_an_identity_has_its_limit() -> None:
    Layout(dimension=8, identity="x" * 1024, rows_per_segment=4).header(0)
    with pytest.raises(ValueError, match="1024"):
        Layout(dimension=8, identity="x" * 1025, rows_per_segment=4)
