"""Maps that are searched by codes: what they answer, and what is left of them after anything that can happen."""

from __future__ import annotations

import logging
import os
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from core.errors import MapQuarantined, UnknownMap
from core.index import Coder, Codes, table
from core.maps import IndexStatus, MapSettings
from core.store import Directory, Map
from core.storage.files import array_files
from core.storage.files.segment_files import HEADER_BYTES
from core.storage.search import indexing, recall, snapshot, tiers
from core.store.snapshot import Snapshot
from tests.core.store.frames import ENCODER, LOCAL_SHAPE, descriptor_of, frame, local_of
from tests.core.storage.test_opening import cut, flip, flip_middle, garbage, remove

DIMENSION, ROWS, PLACES, SHORTLIST = 256, 16, 150, 20
SECONDS = 60.0


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Files of codes of 32 rows, and shortlists that are shorter than the maps here."""
    monkeypatch.setattr("core.storage.search.index_files.GROUP_ROWS", 32)
    monkeypatch.setattr(snapshot, "SHORTLIST", SHORTLIST)
    monkeypatch.setattr(indexing, "_ROWS_AT_ONCE", 8)
    monkeypatch.setattr(recall, "QUERIES", 16)


@pytest.fixture
def atlas(directory: Path) -> Iterator[Directory]:
    atlas = Directory(directory, rows_per_segment=ROWS)
    yield atlas
    atlas.close()


@pytest.fixture
def folder(directory: Path) -> Path:
    return directory / "maps" / "lab"


def make(atlas: Directory, places: int = PLACES, **settings: object) -> Map:
    lab = atlas.create("lab", ENCODER, DIMENSION, MapSettings(**settings), LOCAL_SHAPE)  # type: ignore[arg-type]
    lab.enrol([frame(f"p{i}", dimension=DIMENSION) for i in range(places)])
    return lab


def settled(lab: Map) -> IndexStatus:
    """The status once nothing is being built any more."""
    deadline = time.monotonic() + SECONDS
    while (status := lab.index_status()).state == "building":
        assert time.monotonic() < deadline
        time.sleep(0.005)
    return status


def finds(lab: Map, place_id: str, shown: str | None = None) -> bool:
    """Whether what ``shown`` shows is recognized as the place, its local descriptors beside it."""
    found = lab.snapshot()
    rows, products = found.search(descriptor_of(shown or place_id, DIMENSION))
    if not len(rows):
        return False
    (place,) = lab.places_at(rows[:1].tolist())
    assert (np.diff(products) <= 0).all()
    same = np.array_equal(found.locals_at(rows[:1])[0], local_of(shown or place_id))
    return place is not None and place.id == place_id and same


def nothing_held(found: Snapshot) -> bool:
    return all(segment.held is None for segment in found.segments)


def everything_held(found: Snapshot) -> bool:
    return all(segment.held is not None or segment.removed for segment in found.segments)


def test_a_map_becomes_compact_and_exact_again(atlas: Directory, folder: Path) -> None:
    lab = make(atlas)
    queries = np.array([descriptor_of(f"query {i}", DIMENSION) for i in range(10)])
    exact = lab.snapshot().search_batch(queries)
    before = lab.index_status()
    assert (before.tier, before.state, before.recall) == ("exact", "ready", None)

    lab.edit({"index": "compact"})
    status = settled(lab)
    assert (status.setting, status.tier, status.wanted) == ("compact", "compact", "compact")
    assert (status.rows_indexed, status.progress) == (PLACES, 1.0)
    assert status.recall is not None
    assert (status.recall.queries, status.recall.places) == (16, PLACES)
    assert status.recall.at_1 > 0.9
    assert nothing_held(lab.snapshot())
    held = DIMENSION * 2 + LOCAL_SHAPE[0] * LOCAL_SHAPE[1]
    room = table.ROWS_PER_BLOCK * (DIMENSION // 8 + 8)
    assert status.bytes_in_memory <= before.bytes_in_memory - PLACES * held + room
    for (rows, products), (all_rows, all_products) in zip(lab.snapshot().search_batch(queries), exact, strict=True):
        assert len(rows) == SHORTLIST
        np.testing.assert_allclose(products, all_products[np.argsort(all_rows)][rows], atol=1e-6)
    assert all(finds(lab, f"p{i}") for i in range(PLACES))

    lab.edit({"index": "exact"})
    assert settled(lab).tier == "exact"
    assert not list(folder.glob("*.index"))
    for (rows, products), (all_rows, all_products) in zip(lab.snapshot().search_batch(queries), exact, strict=True):
        assert rows.tolist() == all_rows.tolist()
        np.testing.assert_allclose(products, all_products, atol=1e-6)
    assert lab.verify().ok


def test_a_map_grows_into_its_tier(atlas: Directory, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tiers, "COMPACT_FROM", 60)
    monkeypatch.setattr(tiers, "ON_DISK_FROM", 120)
    lab = make(atlas, 59)
    assert settled(lab).tier == "exact"
    lab.enrol([frame(f"o{i}", dimension=DIMENSION) for i in range(40)])
    assert settled(lab).tier == "compact"
    assert everything_held(lab.snapshot())
    lab.enrol([frame(f"q{i}", dimension=DIMENSION) for i in range(51)])
    assert settled(lab).tier == "compact"
    assert nothing_held(lab.snapshot())
    assert all(finds(lab, name) for name in ("p0", "p58", "o0", "q0", "q50"))
    lab.transfer.forget({f"o{i}": lab.digest(f"o{i}") or b"" for i in range(40)})
    lab.transfer.forget({f"p{i}": lab.digest(f"p{i}") or b"" for i in range(59)})
    lab.enrol([frame("last", dimension=DIMENSION)])
    assert settled(lab).tier == "compact"
    assert everything_held(lab.snapshot())
    assert finds(lab, "last")
    lab.transfer.forget({f"q{i}": lab.digest(f"q{i}") or b"" for i in range(30)})
    assert settled(lab).tier == "exact"
    assert finds(lab, "q40")
    assert lab.verify().ok


def test_codes_are_joined_while_the_map_grows(
    atlas: Directory, directory: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in {"ROWS_PER_BLOCK": 16, "LOOSE_ROWS": 32, "LARGEST_BLOCK": 96, "SCANNED_VALUES": 128}.items():
        monkeypatch.setattr(table, name, value)

    def scanned(lab: Map) -> int:
        settled(lab)
        codes = lab.snapshot().table
        return 0 if codes is None else sum(block.used for block in codes.blocks if block.scan is not None)

    lab = make(atlas, 70, index="compact")
    assert 32 <= scanned(lab) <= 70
    for start in range(0, 80, 20):
        lab.enrol([frame(f"q{start + i}", dimension=DIMENSION) for i in range(20)])
        assert finds(lab, f"q{start}")
    assert 100 <= scanned(lab) <= 150
    lab.forget("p3")
    assert not finds(lab, "p3")
    names = [*(f"p{i}" for i in range(70) if i != 3), *(f"q{i}" for i in range(80))]
    assert np.mean([finds(lab, name) for name in names]) > 0.95
    atlas.close()
    again = Directory(directory)
    assert scanned(again.get("lab")) >= 100
    assert finds(again.get("lab"), "q79")
    again.close()


def test_places_in_memory_are_ranked_by_their_codes_too(atlas: Directory, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tiers, "COMPACT_FROM", 60)
    lab = make(atlas)
    queries = np.array([descriptor_of(f"query {i}", DIMENSION) for i in range(10)])
    assert settled(lab).tier == "compact"
    held = lab.snapshot().search_batch(queries)
    assert everything_held(lab.snapshot())
    lab.edit({"index": "compact"})
    settled(lab)
    assert nothing_held(lab.snapshot())
    for (rows, products), (same, alike) in zip(held, lab.snapshot().search_batch(queries), strict=True):
        assert rows.tolist() == same.tolist()
        np.testing.assert_allclose(products, alike, atol=1e-6)


def test_writes_are_seen_at_once(atlas: Directory) -> None:
    lab = make(atlas, index="compact")
    settled(lab)
    for i in range(20):
        lab.enrol([frame(f"new{i}", dimension=DIMENSION)])
        assert finds(lab, f"new{i}")
        lab.enrol([frame(f"new{i}", f"another {i}", dimension=DIMENSION)])
        assert finds(lab, f"new{i}", f"another {i}")
        lab.forget(f"p{i}")
        rows, _ = lab.snapshot().search(descriptor_of(f"p{i}", DIMENSION))
        assert i not in rows.tolist()
    assert nothing_held(lab.snapshot())
    settled(lab)
    assert lab.snapshot().coded == lab.snapshot().rows
    report = lab.verify()
    assert (report.ok, report.stale_caches, report.problems) == (True, [], [])


def test_an_older_snapshot_stays_what_it_was(atlas: Directory) -> None:
    lab = make(atlas, index="compact")
    settled(lab)
    before, query = lab.snapshot(), descriptor_of("p5", DIMENSION)
    first = before.search(query)
    lab.forget("p5")
    lab.enrol([frame("late", "p5 again", dimension=DIMENSION)])
    assert before.search(query)[0].tolist() == first[0].tolist()
    assert lab.snapshot().search(query)[0].tolist() != first[0].tolist()


@pytest.mark.parametrize("share", [0.0, 0.05, 0.5, 1.0])
def test_only_allowed_places_are_found(atlas: Directory, share: float) -> None:
    lab = make(atlas, index="compact")
    settled(lab)
    found = lab.snapshot()
    allowed = np.random.default_rng(0).random(found.rows) < share
    for i in (3, 77):
        rows, _ = found.search(descriptor_of(f"p{i}", DIMENSION), allowed)
        assert allowed[rows].all()
        assert len(rows) == min(SHORTLIST, int(allowed.sum()))
        if allowed[i]:
            assert rows[0] == i


def test_searches_and_writes_go_on_while_codes_are_made(atlas: Directory, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every step of the making waits to be told, and between any two of them the map is asked and written to."""
    lab = make(atlas, 60)
    waiting, step, encode = threading.Semaphore(0), threading.Semaphore(0), Coder.encode

    def by_step(self: Coder, descriptors: NDArray[np.float32]) -> Codes:
        if threading.current_thread().name == "index":
            waiting.release()
            assert step.acquire(timeout=SECONDS)
        return encode(self, descriptors)

    monkeypatch.setattr(Coder, "encode", by_step)
    lab.edit({"index": "compact"})
    progress = []
    for i in range(7):
        assert waiting.acquire(timeout=SECONDS)
        assert all(finds(lab, f"p{j}") for j in range(50))
        lab.enrol([frame(f"new{i}", dimension=DIMENSION)])
        assert finds(lab, f"new{i}")
        lab.forget(f"p{59 - i}")
        assert not finds(lab, f"p{59 - i}")
        assert lab.index_status().state == "building"
        progress.append(lab.index_status().progress)
        step.release()
    step.release(1000)
    assert settled(lab).tier == "compact"
    assert progress == sorted(progress)
    assert len(set(progress)) >= 6
    assert all(finds(lab, name) for name in ("p0", "p49", "new0", "new6"))
    assert nothing_held(lab.snapshot())


def test_a_start_reads_codes_and_makes_none(
    atlas: Directory, directory: Path, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make(atlas, index="compact")
    settled(atlas.get("lab"))
    atlas.close()
    before = {path.name: path.read_bytes() for path in folder.glob("*.index")}
    codes = [f"codes-00000{i}.index" for i in range(1, 6)]
    assert sorted(before) == [*codes, "recall.index"]

    def refuse(*_: object, **__: object) -> None:
        raise AssertionError

    monkeypatch.setattr(Coder, "encode", refuse)
    again = Directory(directory)
    lab = again.get("lab")
    assert lab.snapshot().coded == PLACES  # from the first query on
    assert all(finds(lab, f"p{i}") for i in (0, 31, 32, PLACES - 1))
    status = settled(lab)
    assert (status.tier, status.recall is not None) == ("compact", True)
    again.close()
    assert {path.name: path.read_bytes() for path in folder.glob("*.index")} == before


def of_another_group(path: Path) -> None:
    path.write_bytes(path.with_name("codes-000003.index").read_bytes())


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("name", "spoil"),
    [
        ("codes-000001.index", flip_middle),
        ("codes-000001.index", of_another_group),
        ("codes-000002.index", cut),
        ("codes-000004.index", remove),
        ("codes-000003.index", garbage),
    ],
)
def test_a_bad_file_is_logged_and_made_again(
    atlas: Directory, directory: Path, folder: Path, name: str, spoil: Callable[[Path], None]
) -> None:
    make(atlas, index="compact")
    settled(atlas.get("lab"))
    atlas.close()
    good = (folder / name).read_bytes()
    spoil(folder / name)
    again = Directory(directory)
    lab = again.get("lab")
    assert all(finds(lab, f"p{i}") for i in (0, 40, PLACES - 1))
    settled(lab)
    assert (folder / name).read_bytes() == good
    report = lab.verify()
    assert (report.ok, report.stale_caches) == (True, [])
    spoil(folder / name)
    report = lab.verify()
    assert report.ok
    assert any(found.startswith(name) for found in report.stale_caches)
    again.close()


def test_codes_of_another_make_are_made_again(atlas: Directory, directory: Path, folder: Path) -> None:
    make(atlas, index="compact")
    settled(atlas.get("lab"))
    atlas.close()
    bits = {"sketches": np.zeros((32, 8), np.uint64), "bits": np.zeros((32, 4), np.uint64)}
    array_files.write_arrays(folder / "codes-000001.index", "codes", "others", bits)
    again = Directory(directory)
    lab = again.get("lab")
    assert settled(lab).rows_indexed == PLACES
    assert all(finds(lab, f"p{i}") for i in (0, 40, PLACES - 1))
    assert lab.verify().stale_caches == []
    again.close()


def test_a_disk_that_is_full_for_codes_leaves_the_map_serving(
    atlas: Directory, directory: Path, folder: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patched, caplog.at_level(logging.WARNING):
        patched.setattr(array_files, "_written", full)
        lab = make(atlas, index="compact")
        assert settled(lab).tier == "compact"
        assert all(finds(lab, f"p{i}") for i in (0, PLACES - 1))
        atlas.close()
    assert "could not be written and will be made again" in caplog.text
    assert not [*folder.glob("*.index"), *folder.glob("*.tmp")]
    again = Directory(directory)
    assert finds(again.get("lab"), "p7")
    assert settled(again.get("lab")).tier == "compact"
    again.close()


def test_damage_on_disk_takes_the_map_out_of_service(atlas: Directory, directory: Path, folder: Path) -> None:
    make(atlas, index="compact")
    atlas.create("hall", ENCODER, 16, local_shape=(0, 0)).enrol([frame("h", local_shape=(0, 0))])
    settled(atlas.get("lab"))
    atlas.close()
    flip(folder / "descriptors-000002.seg", HEADER_BYTES + 5)
    again = Directory(directory)
    lab = again.get("lab")
    assert finds(lab, "p0")
    with pytest.raises(MapQuarantined, match=r"descriptors-000002\.seg: row 16 does not match"):
        lab.snapshot().search(descriptor_of("p16", DIMENSION))
    with pytest.raises(MapQuarantined):
        again.get("lab")
    assert list(again.quarantined()) == ["lab"]
    assert not again.verify("lab").ok
    assert again.get("hall").count_places() == 1
    again.close()


@pytest.mark.parametrize("spoil", [remove, cut])
def test_a_lost_or_cut_segment_is_found_at_the_start(
    atlas: Directory, directory: Path, folder: Path, spoil: Callable[[Path], None]
) -> None:
    make(atlas, index="compact")
    settled(atlas.get("lab"))
    atlas.close()
    spoil(folder / "descriptors-000002.seg")
    again = Directory(directory)
    with pytest.raises(MapQuarantined, match=r"descriptors-000002\.seg: the file"):
        again.get("lab")
    again.close()


def test_a_deleted_map_says_so_to_those_that_still_search_it(atlas: Directory) -> None:
    lab = make(atlas, index="compact")
    settled(lab)
    before = lab.snapshot()
    atlas.delete("lab")
    with pytest.raises(UnknownMap):
        before.search(descriptor_of("p8", DIMENSION))


def test_a_map_is_closed_while_it_is_built(atlas: Directory, directory: Path) -> None:
    make(atlas, 60)
    atlas.get("lab").edit({"index": "compact"})
    atlas.close()
    again = Directory(directory)
    assert finds(again.get("lab"), "p59")
    assert settled(again.get("lab")).tier == "compact"
    assert again.get("lab").verify().ok
    again.close()


def test_who_writes_faster_than_codes_are_made_makes_them(atlas: Directory, monkeypatch: pytest.MonkeyPatch) -> None:
    """Otherwise the descriptors that wait for their codes would fill the memory."""
    monkeypatch.setattr(indexing, "MOST_BEHIND", 3 * ROWS)
    monkeypatch.setattr(tiers, "COMPACT_FROM", 60)
    monkeypatch.setattr(tiers, "ON_DISK_FROM", PLACES + 10)
    lab = make(atlas)
    settled(lab)
    assert lab.indexer is not None and everything_held(lab.snapshot())
    with lab.indexer._building:  # nobody else makes codes
        for start in range(0, 200, 20):
            lab.enrol([frame(f"q{start + i}", dimension=DIMENSION) for i in range(20)])
            found = lab.snapshot()
            assert found.rows - found.coded <= 3 * ROWS
            assert sum(segment.held is not None for segment in found.segments) <= 5
        assert finds(lab, "q0") and finds(lab, "q199")
    settled(lab)
    assert lab.snapshot().coded == lab.snapshot().rows == PLACES + 200


def test_codes_that_a_snapshot_lacks_are_not_written_as_whole(atlas: Directory, folder: Path) -> None:
    lab = make(atlas, index="compact")
    settled(lab)
    assert lab.indexer is not None
    last = lab.indexer._map.entries()[-1]
    before = {path: path.stat().st_mtime_ns for path in folder.glob("codes-*")}
    lab.indexer._written.clear()
    lab.indexer._keep_group([replace(last, rows=last.rows + 1)])  # one more was committed just now
    assert {path: path.stat().st_mtime_ns for path in folder.glob("codes-*")} == before
    assert not lab.indexer._written


def test_an_empty_map_waits_for_its_first_place(atlas: Directory) -> None:
    lab = atlas.create("lab", ENCODER, DIMENSION, MapSettings(index="compact"), LOCAL_SHAPE)
    assert settled(lab).tier == "exact"
    lab.enrol([frame("first", dimension=DIMENSION)])
    assert finds(lab, "first")
    assert settled(lab).tier == "compact"
    assert finds(lab, "first")
    lab.forget("first")
    assert lab.snapshot().search(descriptor_of("first", DIMENSION))[0].tolist() == []


def test_whereabouts_of_a_few_rows_are_those_of_all(atlas: Directory) -> None:
    lab = make(atlas, index="compact")
    lab.enrol([frame(f"at {i}".replace(" ", ""), dimension=DIMENSION, x=i) for i in range(5)])
    found, rows = lab.snapshot(), np.array([PLACES + 3, 0, PLACES + 1])
    few, every = found.whereabouts_at(rows), found.whereabouts.take(rows)
    for name, column in vars(few).items():
        np.testing.assert_array_equal(column, getattr(every, name))
    assert len(found.whereabouts_at(np.arange(found.rows))) == found.rows
    assert len(found.whereabouts_at(np.empty(0, np.int64))) == 0


def test_compressed_maps_answer_too(directory: Path) -> None:
    atlas = Directory(directory, rows_per_segment=ROWS)
    lab = atlas.create("lab", ENCODER, DIMENSION, MapSettings(index="compact"), LOCAL_SHAPE, precision="compressed")
    lab.enrol([frame(f"p{i}", dimension=DIMENSION) for i in range(PLACES)])
    assert settled(lab).tier == "compact"
    rows = [int(lab.snapshot().search(descriptor_of(f"p{i}", DIMENSION))[0][0]) for i in range(PLACES)]
    assert rows == list(range(PLACES))
    assert lab.verify().ok
    atlas.close()
    size = os.path.getsize(directory / "maps" / "lab" / "descriptors-000001.seg") - HEADER_BYTES
    assert size == ROWS * (2 * (2 + 96) + 24 + 3 * (1 + 3))
