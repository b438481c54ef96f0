from __future__ import annotations

import logging
import os
from pathlib import Path

import faiss
import numpy as np
import pytest

from core.storage.caches import StaleCache, check_cache, load_cache, write_cache
from core.storage.snapshot import flat_index, vectors
from tests.core.storage.frames import descriptor_of

ROWS, DIMENSION, CHECKSUM = 5, 8, 1234


@pytest.fixture
def index() -> faiss.IndexFlatIP:
    index = flat_index(ROWS, DIMENSION)
    vectors(index)[:] = [descriptor_of(str(row), DIMENSION) for row in range(ROWS)]
    return index


@pytest.fixture
def path(tmp_path: Path, index: faiss.IndexFlatIP) -> Path:
    write_cache(tmp_path / "index-000001.faiss", index, CHECKSUM)
    return tmp_path / "index-000001.faiss"


def test_a_cache_comes_back_and_is_a_plain_faiss_file(path: Path, index: faiss.IndexFlatIP) -> None:
    for found in (load_cache(path, ROWS, DIMENSION, CHECKSUM), faiss.read_index(str(path))):
        assert isinstance(found, faiss.IndexFlatIP)
        np.testing.assert_array_equal(vectors(found), vectors(index))
    assert check_cache(path, ROWS, DIMENSION, CHECKSUM) == path.stat().st_size
    assert list(path.parent.iterdir()) == [path]


def test_every_flipped_byte_is_found(path: Path) -> None:
    content = path.read_bytes()
    for offset in range(len(content)):
        damaged = bytearray(content)
        damaged[offset] ^= 0x40
        path.write_bytes(damaged)
        with pytest.raises(StaleCache):
            load_cache(path, ROWS, DIMENSION, CHECKSUM)


def test_every_shorter_or_longer_file_is_refused(path: Path) -> None:
    content = path.read_bytes()
    for size in range(len(content)):
        path.write_bytes(content[:size])
        with pytest.raises(StaleCache):
            load_cache(path, ROWS, DIMENSION, CHECKSUM)
    path.write_bytes(content + b"\x00")
    with pytest.raises(StaleCache):
        load_cache(path, ROWS, DIMENSION, CHECKSUM)


@pytest.mark.parametrize(("rows", "dimension", "checksum"), [(4, 8, 1234), (5, 9, 1234), (5, 8, 4321)])
def test_a_cache_of_other_descriptors_is_stale(path: Path, rows: int, dimension: int, checksum: int) -> None:
    with pytest.raises(StaleCache, match="other descriptors"):
        load_cache(path, rows, dimension, checksum)


def test_a_missing_cache(tmp_path: Path) -> None:
    with pytest.raises(StaleCache, match="missing"):
        load_cache(tmp_path / "absent", ROWS, DIMENSION, CHECKSUM)


def test_an_index_of_another_kind_is_refused(tmp_path: Path) -> None:
    other = faiss.IndexFlatL2(DIMENSION)
    other.add(np.zeros((ROWS, DIMENSION), dtype=np.float32))
    write_cache(tmp_path / "c", other, CHECKSUM)  # type: ignore[arg-type]
    with pytest.raises(StaleCache, match="another kind"):
        load_cache(tmp_path / "c", ROWS, DIMENSION, CHECKSUM)


def test_a_cache_that_cannot_be_written_is_only_logged(
    tmp_path: Path, index: faiss.IndexFlatIP, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING):
        write_cache(tmp_path / "absent" / "index.faiss", index, CHECKSUM)
    assert "could not be written" in caplog.text
    (tmp_path / "taken").mkdir()
    write_cache(tmp_path / "taken", index, CHECKSUM)
    assert os.listdir(tmp_path) == ["taken"]
