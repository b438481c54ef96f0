"""Files that arrive: complete under their final name, or not there at all."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from core.errors import StorageFull
from service.http.arrivals import Arrival, arriving

pytestmark = [pytest.mark.anyio, pytest.mark.parametrize("inside", [None, "form"])]


def nothing() -> None:
    """There is room."""


def full(*_: object) -> None:
    raise OSError(28, "No space left on device")


async def test_a_complete_file_has_its_final_name(tmp_path: Path, inside: str | None) -> None:
    arrival = Arrival(tmp_path / "files", "store it", inside)
    async with arriving(arrival, nothing):
        os.write(arrival.file, b"content")
        assert [path.name for path in (tmp_path / "files").iterdir()] == [f".{arrival.name}"]
        assert arrival.complete() == 7
    path = arrival.final if inside is None else arrival.final / inside
    assert path.read_bytes() == b"content" and arrival.file == -1
    assert [path.name for path in (tmp_path / "files").iterdir()] == [arrival.name]


async def test_a_file_that_fails_is_removed(
    tmp_path: Path, inside: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(StorageFull, match="store it"):
        async with arriving(Arrival(tmp_path, "store it", inside), full):
            raise AssertionError("there is no room for the file")
    for is_complete in (False, True):
        arrival = Arrival(tmp_path, "store it", inside)
        with pytest.raises(KeyError):
            async with arriving(arrival, nothing):
                if is_complete:
                    arrival.complete()
                raise KeyError
        assert arrival.file == -1
    monkeypatch.setattr(os, "fsync", full)
    arrival = Arrival(tmp_path, "store it", inside)
    with pytest.raises(StorageFull):
        async with arriving(arrival, nothing):
            arrival.complete()
    assert arrival.file == -1 and list(tmp_path.iterdir()) == []
