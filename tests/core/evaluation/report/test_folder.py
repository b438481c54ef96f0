from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from core.errors import StorageFailure, StorageFull
from core.evaluation.report.folder import write_files


def test_files_are_replaced_and_others_stay(tmp_path: Path) -> None:
    (tmp_path / "index.html").write_text("old")
    (tmp_path / "notes.txt").write_text("mine")
    write_files(tmp_path, {"pr.png": b"png", "index.html": b"new"})
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == {
        "index.html": b"new",
        "notes.txt": b"mine",
        "pr.png": b"png",
    }


@pytest.mark.parametrize(
    ("number", "error", "sentence"),
    [(errno.ENOSPC, StorageFull, "The disk is full"), (errno.EACCES, StorageFailure, "cannot be written")],
)
def test_failed_write_changes_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int, error: type[Exception], sentence: str
) -> None:
    (tmp_path / "index.html").write_text("old")
    write = Path.write_bytes

    def fail(path: Path, data: bytes) -> int:
        if data == b"new":
            write(path, data[:1])
            raise OSError(number, os.strerror(number))
        return write(path, data)

    monkeypatch.setattr(Path, "write_bytes", fail)
    with pytest.raises(error, match=sentence):
        write_files(tmp_path, {"pr.png": b"png", "index.html": b"new"})
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {"index.html": "old"}


def test_failed_rename_leaves_no_temporary_file(tmp_path: Path) -> None:
    (tmp_path / "index.html").mkdir()
    with pytest.raises(StorageFailure):
        write_files(tmp_path, {"pr.png": b"png", "index.html": b"new"})
    assert sorted(path.name for path in tmp_path.iterdir()) == ["index.html", "pr.png"]
