from __future__ import annotations

import logging
import os
import struct
import zlib
from pathlib import Path

import faiss
import numpy as np
import pytest

from core.storage.caches import StaleCache, check_cache, load_cache, write_cache
from core.storage.descriptors import Layout
from core.storage.snapshot import flat_index, vectors
from tests.core.storage.frames import descriptor_of, local_of

ROWS, DIMENSION, CHECKSUM = 5, 8, 1234
LAYOUT = Layout(DIMENSION, "encoder@1", ROWS, local_shape=(2, 3))
WITHOUT = Layout(DIMENSION, "encoder@1", ROWS)
LOCAL = np.array([local_of(str(row), (2, 3)) for row in range(ROWS)])
NO_LOCAL = np.empty((ROWS, 0, 0), np.int8)


@pytest.fixture
def index() -> faiss.IndexFlatIP:
    index = flat_index(ROWS, DIMENSION)
    vectors(index)[:] = [descriptor_of(str(row), DIMENSION) for row in range(ROWS)]
    return index


@pytest.fixture
def path(tmp_path: Path, index: faiss.IndexFlatIP) -> Path:
    write_cache(tmp_path / "index-000001.faiss", index, LOCAL, CHECKSUM)
    return tmp_path / "index-000001.faiss"


def test_a_cache_comes_back_and_is_a_plain_faiss_file(path: Path, index: faiss.IndexFlatIP) -> None:
    found, local = load_cache(path, LAYOUT, CHECKSUM)
    np.testing.assert_array_equal(local, LOCAL)
    assert local.dtype == np.int8
    for each in (found, faiss.read_index(str(path))):
        assert isinstance(each, faiss.IndexFlatIP)
        np.testing.assert_array_equal(vectors(each), vectors(index))
    assert check_cache(path, LAYOUT, CHECKSUM) == path.stat().st_size
    assert list(path.parent.iterdir()) == [path]


def test_a_cache_without_local_descriptors_is_as_it_always_was(tmp_path: Path, index: faiss.IndexFlatIP) -> None:
    path = tmp_path / "index-000001.faiss"
    write_cache(path, index, NO_LOCAL, CHECKSUM)
    faiss.write_index(index, str(tmp_path / "plain"))
    plain = (tmp_path / "plain").read_bytes() + struct.pack("<8sIII", b"PLRCIDX\x01", ROWS, DIMENSION, CHECKSUM)
    assert path.read_bytes() == plain + struct.pack("<I", zlib.crc32(plain))
    found, local = load_cache(path, WITHOUT, CHECKSUM)
    np.testing.assert_array_equal(vectors(found), vectors(index))
    assert local.shape == (ROWS, 0, 0)


def test_with_and_without_local_descriptors_are_told_apart(path: Path, index: faiss.IndexFlatIP) -> None:
    with pytest.raises(StaleCache, match="not whole"):
        load_cache(path, WITHOUT, CHECKSUM)
    write_cache(path, index, NO_LOCAL, CHECKSUM)
    with pytest.raises(StaleCache, match="not whole"):
        load_cache(path, LAYOUT, CHECKSUM)


def test_every_flipped_byte_is_found(path: Path) -> None:
    content = path.read_bytes()
    for offset in range(len(content)):
        damaged = bytearray(content)
        damaged[offset] ^= 0x40
        path.write_bytes(damaged)
        with pytest.raises(StaleCache):
            load_cache(path, LAYOUT, CHECKSUM)


def test_every_shorter_or_longer_file_is_refused(path: Path) -> None:
    content = path.read_bytes()
    for size in range(len(content)):
        path.write_bytes(content[:size])
        with pytest.raises(StaleCache):
            load_cache(path, LAYOUT, CHECKSUM)
    path.write_bytes(content + b"\x00")
    with pytest.raises(StaleCache):
        load_cache(path, LAYOUT, CHECKSUM)


@pytest.mark.parametrize(
    ("rows", "dimension", "local_shape", "checksum"),
    [(4, 8, (2, 3), 1234), (5, 9, (2, 3), 1234), (5, 8, (3, 2), 1234), (5, 8, (2, 3), 4321)],
)
def test_a_cache_of_other_descriptors_is_stale(
    path: Path, rows: int, dimension: int, local_shape: tuple[int, int], checksum: int
) -> None:
    with pytest.raises(StaleCache, match="other descriptors"):
        load_cache(path, Layout(dimension, "encoder@1", rows, local_shape), checksum)


def test_a_missing_cache(tmp_path: Path) -> None:
    with pytest.raises(StaleCache, match="missing"):
        load_cache(tmp_path / "absent", LAYOUT, CHECKSUM)


def test_an_index_of_another_kind_is_refused(tmp_path: Path) -> None:
    other = faiss.IndexFlatL2(DIMENSION)
    other.add(np.zeros((ROWS, DIMENSION), dtype=np.float32))
    write_cache(tmp_path / "c", other, LOCAL, CHECKSUM)  # type: ignore[arg-type]
    with pytest.raises(StaleCache, match="another kind"):
        load_cache(tmp_path / "c", LAYOUT, CHECKSUM)


def test_a_cache_that_cannot_be_written_is_only_logged(
    tmp_path: Path, index: faiss.IndexFlatIP, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING):
        write_cache(tmp_path / "absent" / "index.faiss", index, LOCAL, CHECKSUM)
    assert "could not be written" in caplog.text
    (tmp_path / "taken").mkdir()
    write_cache(tmp_path / "taken", index, LOCAL, CHECKSUM)
    assert os.listdir(tmp_path) == ["taken"]
