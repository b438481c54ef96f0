"""Codes made anew while the old ones serve."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from core.errors import UnknownMap
from core.index import Coder, Codes
from core.store import Directory
from core.storage.search import indexing, rebuilding, recall, snapshot
from tests.core.store.frames import frame
from tests.core.storage.search.test_indexing import DIMENSION, PLACES, ROWS, finds, make, settled


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("core.storage.search.index_files.GROUP_ROWS", 32)
    monkeypatch.setattr(snapshot, "SHORTLIST", 20)
    monkeypatch.setattr(indexing, "_ROWS_AT_ONCE", 8)
    monkeypatch.setattr(rebuilding, "_ROWS_AT_ONCE", 8)
    monkeypatch.setattr(recall, "QUERIES", 16)


@pytest.fixture
def atlas(directory: Path) -> Iterator[Directory]:
    atlas = Directory(directory, rows_per_segment=ROWS)
    yield atlas
    atlas.close()


def caches(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.glob("*.index"))}


def silent(_done: int, _total: int) -> None:
    """Nobody is told."""


def test_all_is_made_anew_beside_what_serves(atlas: Directory, directory: Path) -> None:
    folder = directory / "maps" / "lab"
    lab = make(atlas, index="compact")
    settled(lab)
    before, served = caches(folder), lab.snapshot().table
    assert served is not None
    for path in folder.glob("codes-*.index"):
        path.write_bytes(b"no codes")
    told: list[tuple[int, int]] = []

    def progress(done: int, total: int) -> None:
        now = lab.snapshot().table
        assert now is not None and now.blocks[0].codes is served.blocks[0].codes, "the old ones serve"
        if done == 64:
            lab.enrol([frame("late", dimension=DIMENSION)])
            assert finds(lab, "late")
        told.append((done, total))

    status = lab.rebuild_index(progress)
    assert status.rows_indexed == lab.snapshot().rows == PLACES + 1
    assert told[0] == (0, PLACES) and max(done for done, _ in told) == PLACES + 1
    now = lab.snapshot().table
    assert now is not None and now.blocks[0].codes is not served.blocks[0].codes
    assert all(finds(lab, name) for name in ("p0", "p149", "late"))
    settled(lab)
    atlas.close()
    after = caches(folder)
    assert set(before) == set(after) and after["codes-000001.index"] == before["codes-000001.index"]
    again = Directory(directory)
    assert again.get("lab").snapshot().coded == PLACES + 1, "what was made is kept"
    assert all(finds(again.get("lab"), name) for name in ("p0", "p149", "late"))
    again.close()


def test_one_that_is_broken_off_leaves_all_as_it_was(atlas: Directory, directory: Path) -> None:
    lab = make(atlas, index="compact")
    settled(lab)
    before, served = caches(directory / "maps" / "lab"), lab.snapshot()

    class Cancelled(Exception):
        pass

    def cancel(done: int, _total: int) -> None:
        if done > 64:
            raise Cancelled

    with pytest.raises(Cancelled):
        lab.rebuild_index(cancel)
    settled(lab)
    now = lab.snapshot()
    assert now.table is served.table
    assert caches(directory / "maps" / "lab") == before
    lab.enrol([frame("new", dimension=DIMENSION)])
    assert finds(lab, "new") and finds(lab, "p0")


def test_a_map_that_is_deleted_or_searched_exactly(atlas: Directory, monkeypatch: pytest.MonkeyPatch) -> None:
    lab = make(atlas)
    assert lab.rebuild_index(silent).tier == "exact"
    lab.edit({"index": "compact"})
    settled(lab)
    reached, gone = threading.Event(), threading.Event()
    encode = Coder.encode

    def slowly(self: Coder, descriptors: NDArray[np.float32]) -> Codes:
        reached.set()
        assert gone.wait(60)
        return encode(self, descriptors)

    monkeypatch.setattr(Coder, "encode", slowly)
    failed: list[Exception] = []

    def work() -> None:
        try:
            lab.rebuild_index(silent)
        except Exception as error:
            failed.append(error)

    thread = threading.Thread(target=work)
    thread.start()
    assert reached.wait(60)
    deleting = threading.Thread(target=atlas.delete, args=("lab",))
    deleting.start()
    gone.set()
    thread.join(60)
    deleting.join(60)
    assert [type(error) for error in failed] == [UnknownMap]


def test_a_failure_to_build_is_logged_and_tried_again(atlas: Directory, monkeypatch: pytest.MonkeyPatch) -> None:
    lab = make(atlas)

    def fail(*_: object) -> None:
        raise RuntimeError("a defect")

    with monkeypatch.context() as broken:
        broken.setattr(indexing, "codes_of", fail)
        lab.edit({"index": "compact"})
        status = settled(lab)
    assert status.rows_indexed == 0 and status.problem is not None and finds(lab, "p0")
    lab.enrol([frame("new", dimension=DIMENSION)])
    status = settled(lab)
    assert (status.tier, status.problem) == ("compact", None) and finds(lab, "new")
