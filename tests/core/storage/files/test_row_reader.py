"""Rows read from the segment files one by one."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from core.storage.files.row_reader import RowReader
from core.storage.files.segment_files import HEADER_BYTES, Layout, append, segment_name
from numpy.typing import NDArray

from core.disk.files import Damage
from core.maps.records import Precision
from tests.core.store.frames import descriptor_of, local_of, packed

SHAPE, ROWS = (3, 5), 10


def layout_of(precision: Precision) -> Layout:
    return Layout(dimension=32, identity="encoder@1", rows_per_segment=4, local_shape=SHAPE, precision=precision)


def filled(folder: Path, precision: Precision) -> tuple[RowReader, NDArray[np.void]]:
    """A reader of ten rows in three segments, and their records."""
    layout = layout_of(precision)
    names = [f"row {row}" for row in range(ROWS)]
    records = packed(layout, [descriptor_of(name, 32) for name in names], [local_of(name) for name in names], 0)
    append(folder, layout, 0, records)
    return RowReader(folder, layout), records


EVERY: list[Precision] = ["half", "compressed"]


@pytest.mark.parametrize("precision", EVERY)
@pytest.mark.parametrize("rows", [[0], [9, 0, 4, 4, 3], list(range(10)), []])
def test_rows_come_in_the_order_requested(tmp_path: Path, precision: Precision, rows: list[int]) -> None:
    reader, records = filled(tmp_path, precision)
    wanted, named = np.array(rows, np.int64), records["checksum"][rows] if rows else np.empty(0, np.uint32)
    layout = layout_of(precision)
    stored = layout.descriptors_of(records)[rows] if rows else np.empty((0, 32), np.float32)
    np.testing.assert_array_equal(reader.descriptors(wanted, named), stored)
    np.testing.assert_array_equal(reader.locals(wanted, named), layout.locals_of(records)[wanted])
    queries = np.array([descriptor_of("a", 32), descriptor_of("b", 32)])
    np.testing.assert_allclose(reader.inner_products(queries, wanted, named), queries @ stored.T, atol=1e-6)


@pytest.mark.parametrize("precision", EVERY)
def test_a_map_without_local_descriptors_has_none_to_read(tmp_path: Path, precision: Precision) -> None:
    layout = Layout(dimension=32, identity="encoder@1", rows_per_segment=4, precision=precision)
    records = packed(layout, [descriptor_of("a", 32)], [np.empty((0, 0), np.int8)], 0)
    append(tmp_path, layout, 0, records)
    reader, row = RowReader(tmp_path, layout), np.array([0])
    np.testing.assert_array_equal(reader.descriptors(row, records["checksum"]), layout.descriptors_of(records))
    assert reader.locals(row, records["checksum"]).shape == (1, 0, 0)


@pytest.mark.parametrize("precision", EVERY)
def test_a_flipped_bit_is_found_when_its_row_is_read(tmp_path: Path, precision: Precision) -> None:
    reader, records = filled(tmp_path, precision)
    path, size = tmp_path / segment_name(1), records.dtype.itemsize
    good = path.read_bytes()
    assert records.dtype.fields is not None
    spare = records.dtype.fields["reserved"][1]
    row, named = np.array([6]), records["checksum"][6:7]
    for offset in set(range(size)) - set(range(spare, spare + 4)):
        damaged = bytearray(good)
        damaged[HEADER_BYTES + 2 * size + offset] ^= 4
        path.write_bytes(damaged)
        found = []
        for read in (reader.descriptors, reader.locals):
            try:
                read(row, named)
            except Damage as damage:
                found.append(str(damage))
        assert found, offset
        assert all(r"descriptors-000002.seg: row 6" in text for text in found)
        reader.descriptors(np.array([5, 7]), records["checksum"][[5, 7]])


@pytest.mark.parametrize("precision", EVERY)
def test_a_good_row_of_another_frame_is_found(tmp_path: Path, precision: Precision) -> None:
    reader, _ = filled(tmp_path, precision)
    reader.descriptors(np.array([6]), np.array([0], np.uint32))  # nobody says of which frame it is
    for read in (reader.descriptors, reader.locals):
        with pytest.raises(Damage, match="row 6 is of another frame"):
            read(np.array([6]), np.array([12345], np.uint32))


def test_a_file_that_was_cut_or_lost_is_damage_and_no_crash(tmp_path: Path) -> None:
    reader, records = filled(tmp_path, "half")
    os.truncate(tmp_path / segment_name(1), HEADER_BYTES + 3 * records.dtype.itemsize - 1)
    (tmp_path / segment_name(2)).unlink()
    unnamed = np.zeros(1, np.uint32)
    reader.descriptors(np.array([5]), unnamed)
    with pytest.raises(Damage, match=r"descriptors-000002\.seg: the file ends before row 6"):
        reader.locals(np.array([6]), unnamed)
    with pytest.raises(Damage, match=r"descriptors-000003\.seg: the file is missing"):
        reader.descriptors(np.array([9]), unnamed)


def test_files_are_checked_without_reading_them(tmp_path: Path) -> None:
    reader, records = filled(tmp_path, "half")
    for number, rows in ((0, 4), (1, 4), (2, 2)):
        reader.check(number, rows)
    with pytest.raises(Damage, match=r"descriptors-000003\.seg: the file ends after 2 of 3 rows"):
        reader.check(2, 3)
    with pytest.raises(Damage, match="missing"):
        reader.check(3, 1)
    os.truncate(tmp_path / segment_name(1), HEADER_BYTES + 4 * records.dtype.itemsize - 1)
    with pytest.raises(Damage, match="ends after 3 of 4"):
        reader.check(1, 4)
    os.rename(tmp_path / segment_name(0), tmp_path / segment_name(1))
    with pytest.raises(Damage, match="that of another map, encoder, segment or version"):
        reader.check(1, 4)
