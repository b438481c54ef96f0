"""Codes and lists made anew while the old ones serve; and lists that are of other rows than they seem."""

from __future__ import annotations

import shutil
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from core.errors import UnknownMap
from core.index import Coder
from core.storage import Atlas
from core.storage.search import indexing, rebuilding, recall, snapshot
from tests.core.storage.frames import frame
from tests.core.storage.search.test_indexing import DIMENSION, PLACES, ROWS, finds, make, settled


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("core.storage.search.index_files.GROUP_ROWS", 32)
    monkeypatch.setattr(snapshot, "SHORTLIST", 20)
    monkeypatch.setattr(indexing, "_ROWS_AT_ONCE", 8)
    monkeypatch.setattr(rebuilding, "_ROWS_AT_ONCE", 8)
    monkeypatch.setattr(recall, "QUERIES", 16)


@pytest.fixture
def atlas(directory: Path) -> Iterator[Atlas]:
    atlas = Atlas(directory, rows_per_segment=ROWS)
    yield atlas
    atlas.close()


def caches(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.glob("*.index"))}


def silent(_done: int, _total: int) -> None:
    """Nobody is told."""


@pytest.mark.parametrize("tier", ["compact", "inverted"])
def test_all_is_made_anew_beside_what_serves(atlas: Atlas, directory: Path, tier: str) -> None:
    folder = directory / "maps" / "lab"
    lab = make(atlas, index=tier)
    settled(lab)
    before, served = caches(folder), lab.snapshot()
    assert served.table is not None
    # Codes were learnt from the first places; by now the map shows something else.
    lab.enrol([frame(f"new{i}", dimension=DIMENSION) for i in range(PLACES)])
    settled(lab)
    told: list[tuple[int, int]] = []

    def progress(done: int, total: int) -> None:
        now = lab.snapshot()
        assert now.table is not None and now.table.coder is served.table.coder, "the old ones serve"  # type: ignore[union-attr]
        if done == 64:
            lab.enrol([frame("late", dimension=DIMENSION)])
            assert finds(lab, "late")
        told.append((done, total))

    status = lab.rebuild_index(progress)
    assert status.tier == tier and status.rows_indexed == lab.snapshot().rows == 2 * PLACES + 1
    assert told[0] == (0, 2 * PLACES) and max(done for done, _ in told) == 2 * PLACES + 1
    now = lab.snapshot()
    assert now.table is not None and now.table.coder is not served.table.coder
    assert all(finds(lab, name) for name in ("p0", "p149", "new0", "new149", "late"))
    settled(lab)
    atlas.close()
    after = caches(folder)
    assert set(before) <= set(after) and after["coder.index"] != before["coder.index"]
    again = Atlas(directory)
    assert again.get("lab").snapshot().coded == 2 * PLACES + 1, "what was made is kept"
    assert all(finds(again.get("lab"), name) for name in ("p0", "new149", "late"))
    again.close()


def test_one_that_is_broken_off_leaves_all_as_it_was(atlas: Atlas, directory: Path) -> None:
    lab = make(atlas, index="inverted")
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
    assert now.table is served.table and now.lists is served.lists
    assert caches(directory / "maps" / "lab") == before
    lab.enrol([frame("new", dimension=DIMENSION)])
    assert finds(lab, "new") and finds(lab, "p0")


def test_a_map_that_is_deleted_or_searched_exactly(atlas: Atlas, monkeypatch: pytest.MonkeyPatch) -> None:
    lab = make(atlas)
    assert lab.rebuild_index(silent).tier == "exact"
    lab.edit({"index": "compact"})
    settled(lab)
    reached, gone = threading.Event(), threading.Event()
    encode = Coder.encode

    def slowly(self: Coder, descriptors: NDArray[np.float32]) -> object:
        reached.set()
        assert gone.wait(30)
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
    assert reached.wait(30)
    deleting = threading.Thread(target=atlas.delete, args=("lab",))
    deleting.start()
    gone.set()
    thread.join(30)
    deleting.join(30)
    assert [type(error) for error in failed] == [UnknownMap]


def test_lists_of_another_history_are_not_believed(atlas: Atlas, directory: Path, tmp_path: Path) -> None:
    """A backup that is put back together with a later lists.index: the coder is the same, the rows are not."""
    folder = directory / "maps" / "lab"
    settled(make(atlas, places=100, index="inverted"))
    atlas.close()
    shutil.copytree(directory, tmp_path / "backup")
    first = Atlas(directory)
    first.get("lab").enrol([frame(f"one{i}", dimension=DIMENSION) for i in range(200)])
    settled(first.get("lab"))
    first.close()
    foreign = (folder / "lists.index").read_bytes()

    other = tmp_path / "backup" / "maps" / "lab"
    second = Atlas(tmp_path / "backup")
    second.get("lab").enrol([frame(f"two{i}", dimension=DIMENSION) for i in range(200)])
    settled(second.get("lab"))
    second.close()
    own = (other / "lists.index").read_bytes()
    assert (other / "coder.index").read_bytes() == (folder / "coder.index").read_bytes() and own != foreign
    (other / "lists.index").write_bytes(foreign)

    again = Atlas(tmp_path / "backup")
    lab = again.get("lab")
    assert lab.snapshot().lists is None, "they list other rows"
    assert lab.verify().ok
    settled(lab)
    assert all(finds(lab, name, name) for name in ("p0", "two0", "two199"))
    again.close()
    rebuilt = (other / "lists.index").read_bytes()
    assert rebuilt != foreign
    last = Atlas(tmp_path / "backup")
    assert last.get("lab").snapshot().lists is not None
    last.close()


def test_what_cannot_be_built_is_told_and_tried_again(atlas: Atlas, monkeypatch: pytest.MonkeyPatch) -> None:
    lab = make(atlas)

    def fail(_: object) -> None:
        raise RuntimeError("a defect")

    with monkeypatch.context() as broken:
        broken.setattr(indexing, "fitted_coder", fail)
        lab.edit({"index": "compact"})
        status = settled(lab)
    assert status.tier == "exact" and status.problem is not None and finds(lab, "p0")
    lab.enrol([frame("new", dimension=DIMENSION)])
    status = settled(lab)
    assert (status.tier, status.problem) == ("compact", None) and finds(lab, "new")


def test_what_comes_while_lists_are_made_is_encoded_before_the_lock_is_taken(atlas: Atlas) -> None:
    lab = make(atlas)
    begun: list[int] = []

    def progress(done: int, _total: int) -> None:
        begun.append(done)
        if begun.count(0) == 2 and done == 0:  # codes begin, lists begin
            lab.enrol([frame(f"late{i}", dimension=DIMENSION) for i in range(20)])

    made = rebuilding.rebuilt(lab.snapshot, True, progress)
    assert len(made.table) == lab.snapshot().rows == PLACES + 20
    assert made.lists is not None and made.lists.rows == PLACES
