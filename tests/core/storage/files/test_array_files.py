from __future__ import annotations

import logging
import os
from pathlib import Path

import numpy as np
import pytest
from core.storage.files.array_files import StaleArrays, check_arrays, read_arrays, write_arrays

ARRAYS = {
    "codes": np.arange(24, dtype="<u8").reshape(4, 6),
    "scales": np.linspace(0, 1, 8, dtype="<f4").reshape(4, 2),
    "none": np.empty((0, 3), np.int16),
}


@pytest.fixture
def path(tmp_path: Path) -> Path:
    assert write_arrays(tmp_path / "codes.index", "codes", "these rows", ARRAYS)
    return tmp_path / "codes.index"


def test_arrays_come_back(path: Path) -> None:
    found = read_arrays(path, "codes", "these rows")
    assert list(found) == list(ARRAYS)
    for name, array in ARRAYS.items():
        assert found[name].dtype == array.dtype
        np.testing.assert_array_equal(found[name], array)
    assert check_arrays(path, "codes", "these rows") == path.stat().st_size
    assert list(path.parent.iterdir()) == [path]


def test_every_flipped_byte_is_found(path: Path) -> None:
    content = path.read_bytes()
    for offset in range(len(content)):
        damaged = bytearray(content)
        damaged[offset] ^= 0x40
        path.write_bytes(damaged)
        with pytest.raises(StaleArrays):
            read_arrays(path, "codes", "these rows")


def test_every_shorter_or_longer_file_is_refused(path: Path) -> None:
    content = path.read_bytes()
    for size in range(len(content)):
        path.write_bytes(content[:size])
        with pytest.raises(StaleArrays):
            read_arrays(path, "codes", "these rows")
    path.write_bytes(content + b"\x00")
    with pytest.raises(StaleArrays, match="not as long"):
        read_arrays(path, "codes", "these rows")


@pytest.mark.parametrize(
    ("kind", "made_of", "why"),
    [("lists", "these rows", "another kind"), ("codes", "other rows", "other descriptors")],
)
def test_arrays_of_something_else_are_stale(path: Path, kind: str, made_of: str, why: str) -> None:
    with pytest.raises(StaleArrays, match=why):
        read_arrays(path, kind, made_of)


def test_a_missing_file_is_stale(tmp_path: Path) -> None:
    with pytest.raises(StaleArrays, match="missing"):
        read_arrays(tmp_path / "absent", "codes", "")


def test_a_file_that_cannot_be_written_is_only_logged(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        assert not write_arrays(tmp_path / "absent" / "codes.index", "codes", "", ARRAYS)
    assert "could not be written" in caplog.text
    (tmp_path / "taken").mkdir()
    assert not write_arrays(tmp_path / "taken", "codes", "", ARRAYS)
    assert os.listdir(tmp_path) == ["taken"]


def test_a_file_may_be_removed_while_it_is_checked(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    size, fstat = path.stat().st_size, os.fstat

    def removed(descriptor: int) -> os.stat_result:
        path.unlink(missing_ok=True)
        return fstat(descriptor)

    monkeypatch.setattr(os, "fstat", removed)
    assert check_arrays(path, "codes", "these rows") == size
    with pytest.raises(StaleArrays, match="missing"):
        check_arrays(path, "codes", "these rows")
