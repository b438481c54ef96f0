"""Maps that are searched by codes: what they answer, through writes, restarts, damage and rebuilding."""

from __future__ import annotations

import gc
import logging
import weakref

import numpy as np
import pytest
from numpy.typing import NDArray

from core.errors import UnknownMap, UnknownPlace
from core.index import Coder, Codes, table
from core.ledger.maps import rows, writing
from core.maps import MapSettings
from core.maps.forms import COMPRESSED
from core.store import Map, Snapshot, Store, following, recall, snapshot, tiers
from core.store import map as map_module
from tests.core.store.conftest import OpenStore, execute, on_both
from tests.core.store.frames import ENCODER, LOCAL_SHAPE, descriptor_of, frame, local_of
from tests.service.wire import eventually

DIMENSION, PLACES, SHORTLIST = 256, 150, 20


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Shortlists that are shorter than the maps here, and codes that are read in several parts."""
    monkeypatch.setattr(snapshot, "SHORTLIST", SHORTLIST)
    monkeypatch.setattr(following, "CODES_AT_ONCE", 32)
    for reading in (following, map_module):
        monkeypatch.setattr(reading, "DESCRIPTORS_AT_ONCE", 8)
    monkeypatch.setattr(recall, "QUERIES", 16)


def make(store: Store, places: int = PLACES, **settings: object) -> Map:
    lab = store.create("lab", ENCODER, DIMENSION, MapSettings(**settings), LOCAL_SHAPE)  # type: ignore[arg-type]
    lab.enrol([frame(f"p{i}", dimension=DIMENSION) for i in range(places)])
    return lab


def finds(lab: Map, place_id: str, shown: str | None = None) -> bool:
    """Whether what ``shown`` shows is recognized as the place, its local descriptors beside it."""
    found = lab.snapshot()
    ranked, products = found.search(descriptor_of(shown or place_id, DIMENSION))
    if not len(ranked):
        return False
    (place,) = lab.places_at(ranked[:1].tolist())
    assert (np.diff(products) <= 0).all()
    same = np.array_equal(found.locals_at(ranked[:1])[0], local_of(shown or place_id))
    return place is not None and place.id == place_id and same


def codes_are_right(lab: Map) -> bool:
    """Whether what is searched by, and what is stored, is what the stored descriptors give."""
    found = lab.snapshot()
    assert found.table is not None and found.coded == found.rows
    living = np.flatnonzero(found.alive)
    right = found.table.coder.encode(found.descriptors_at(living))
    with lab.viewing() as (connection, _):
        stored = rows.at(connection, "codes", living.tolist())
    in_memory = np.array_equal(found.table.codes(0, found.rows)[living], right)
    return in_memory and [stored[row] for row in living.tolist()] == [bytes(code) for code in right]


def everything_held(found: Snapshot) -> bool:
    return all(segment.held is not None for segment in found.segments)


def nothing_held(found: Snapshot) -> bool:
    return all(segment.held is None for segment in found.segments)


@on_both
def test_a_map_becomes_compact_and_exact_again(store: Store) -> None:
    lab = make(store)
    queries = np.array([descriptor_of(f"query {i}", DIMENSION) for i in range(10)])
    exact, before = lab.snapshot().search_batch(queries), lab.index_status()
    assert (before.tier, before.state, before.recall) == ("exact", "ready", None)
    held = [weakref.ref(segment.held) for segment in lab.snapshot().segments]
    assert all(one() is not None for one in held)

    lab.edit({"index": "compact"})
    for (found, products), (every, all_products) in zip(lab.snapshot().search_batch(queries), exact, strict=True):
        assert len(found) == SHORTLIST
        np.testing.assert_allclose(products, all_products[np.argsort(every)][found], atol=1e-6)
    gc.collect()
    assert [one() for one in held] == [None] * len(held), "descriptors in memory are given up"
    status = lab.index_status()
    assert (status.setting, status.tier, status.wanted) == ("compact", "compact", "compact")
    assert (status.rows_indexed, status.progress, status.recall) == (PLACES, 1.0, None)
    in_memory = DIMENSION * 2 + LOCAL_SHAPE[0] * LOCAL_SHAPE[1]
    room = table.ROWS_PER_BLOCK * (DIMENSION // 8 + 8)
    assert status.bytes_in_memory <= before.bytes_in_memory - PLACES * in_memory + room
    assert nothing_held(lab.snapshot()) and codes_are_right(lab) and all(finds(lab, f"p{i}") for i in range(PLACES))

    lab.edit({"index": "exact"})
    for (found, products), (every, all_products) in zip(lab.snapshot().search_batch(queries), exact, strict=True):
        assert found.tolist() == every.tolist()
        np.testing.assert_allclose(products, all_products, atol=1e-6)
    assert lab.index_status().tier == "exact" and everything_held(lab.snapshot()) and lab.verify().ok


@on_both
def test_a_map_grows_into_its_tier_and_shrinks(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    for module in (tiers, writing):
        monkeypatch.setattr(module, "COMPACT_FROM", 60)
    monkeypatch.setattr(tiers, "ON_DISK_FROM", 120)
    lab = make(store, 59)

    def expect(tier: str, held: bool) -> None:
        found = lab.snapshot()
        assert lab.index_status().tier == lab.index_status().wanted == tier
        assert (everything_held if held else nothing_held)(found)
        assert tier == "exact" or codes_are_right(lab)

    def forget(letter: str, count: int) -> None:
        lab.transfer.forget({f"{letter}{i}": lab.digest(f"{letter}{i}") or b"" for i in range(count)})

    expect("exact", True)
    for _ in range(2):
        lab.enrol([frame(f"o{i}", dimension=DIMENSION) for i in range(40)])
        expect("compact", True)
        forget("o", 40)
        expect("compact", True)  # a map of about that size is not read anew again and again
    forget("p", 30)
    expect("exact", True)
    lab.enrol(
        [frame(f"{letter}{i}", dimension=DIMENSION) for letter, many in (("p", 30), ("o", 40)) for i in range(many)]
    )
    expect("compact", True)
    queries = np.array([descriptor_of(f"query {i}", DIMENSION) for i in range(10)])
    ranked = lab.snapshot().search_batch(queries)
    lab.edit({"index": "compact"})
    expect("compact", False)
    for (found, products), (same, alike) in zip(ranked, lab.snapshot().search_batch(queries), strict=True):
        assert found.tolist() == same.tolist()
        np.testing.assert_allclose(products, alike, atol=1e-6)
    lab.edit({"index": "auto"})
    lab.enrol([frame(f"q{i}", dimension=DIMENSION) for i in range(51)])
    expect("compact", False)
    assert all(finds(lab, name) for name in ("p0", "p58", "o0", "q0", "q50"))
    forget("o", 40)
    expect("compact", False)
    forget("p", 59)
    expect("exact", True)
    assert finds(lab, "q40") and lab.verify().ok


def test_codes_are_joined_while_the_map_grows(
    open_store: OpenStore, store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in {"ROWS_PER_BLOCK": 16, "LOOSE_ROWS": 32, "LARGEST_BLOCK": 96, "SCANNED_VALUES": 128}.items():
        monkeypatch.setattr(table, name, value)

    def scanned(lab: Map) -> int:
        """Rows in joined blocks, when the thread that joins them has ended."""
        assert eventually(lambda: (codes := lab.snapshot().table) is not None and not codes.is_loose, 60)
        codes = lab.snapshot().table
        return 0 if codes is None else sum(block.used for block in codes.blocks if block.scan is not None)

    lab = make(store, 70, index="compact")
    assert 32 <= scanned(lab) <= 70
    for start in range(0, 80, 20):
        lab.enrol([frame(f"q{start + i}", dimension=DIMENSION) for i in range(20)])
        assert finds(lab, f"q{start}")
    assert 100 <= scanned(lab) <= 150
    lab.forget("p3")
    assert not finds(lab, "p3")
    names = [*(f"p{i}" for i in range(70) if i != 3), *(f"q{i}" for i in range(80))]
    assert np.mean([finds(lab, name) for name in names]) > 0.95
    store.close()
    again = open_store().get("lab")
    assert scanned(again) >= 100 and finds(again, "q79")


@on_both
def test_writes_are_seen_at_once(store: Store) -> None:
    lab = make(store, index="compact")
    lab.snapshot()
    for i in range(6):
        lab.enrol([frame(f"new{i}", dimension=DIMENSION)])
        assert finds(lab, f"new{i}")
        lab.enrol([frame(f"new{i}", f"another {i}", dimension=DIMENSION)])
        assert finds(lab, f"new{i}", f"another {i}")
        lab.forget(f"p{i}")
        assert i not in lab.snapshot().search(descriptor_of(f"p{i}", DIMENSION))[0].tolist()
    assert nothing_held(lab.snapshot()) and codes_are_right(lab)
    report = lab.verify()
    assert (report.ok, report.stale_caches, report.problems) == (True, [], [])


def test_an_older_snapshot_stays_what_it_was_until_its_rows_are_deleted(
    store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    lab = make(store, index="compact")
    before, query = lab.snapshot(), descriptor_of("p5", DIMENSION)
    first = before.search(query)
    lab.forget("p5")
    lab.enrol([frame("late", "p5 again", dimension=DIMENSION)])
    assert before.search(query)[0].tolist() == first[0].tolist()
    assert lab.snapshot().search(query)[0].tolist() != first[0].tolist()
    monkeypatch.setattr(rows, "LEFT_SECONDS", -1)
    lab.forget("p6")
    lab._cache._values.clear()
    with pytest.raises(UnknownPlace, match="deleted while it was read"):
        before.search(query)
    assert finds(lab, "p7")


@pytest.mark.parametrize("share", [0.0, 0.05, 0.5, 1.0])
def test_only_allowed_places_are_found(store: Store, share: float) -> None:
    found = make(store, index="compact").snapshot()
    allowed = np.random.default_rng(0).random(found.rows) < share
    for i in (3, 77):
        ranked, _ = found.search(descriptor_of(f"p{i}", DIMENSION), allowed)
        assert allowed[ranked].all()
        assert len(ranked) == min(SHORTLIST, int(allowed.sum()))
        if allowed[i]:
            assert ranked[0] == i


@on_both
def test_a_start_reads_codes_and_makes_none(
    open_store: OpenStore, store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    lab = make(store, index="compact")
    assert lab.rebuild_index().recall is not None
    store.close()

    def refuse(*_: object, **__: object) -> None:
        raise AssertionError

    with monkeypatch.context() as patched:
        patched.setattr(Coder, "encode", refuse)
        again = open_store().get("lab")
        assert again.snapshot().coded == PLACES
        assert all(finds(again, f"p{i}") for i in (0, 31, 32, PLACES - 1))
        status = again.index_status()
        assert (status.tier, status.recall is not None) == ("compact", True)
    assert codes_are_right(again)


@on_both
def test_damaged_and_missing_codes_are_made_again(
    open_store: OpenStore, store: Store, caplog: pytest.LogCaptureFixture
) -> None:
    """They are no reason to put a map out of service."""
    lab = make(store, index="compact")
    with lab._transaction() as connection:
        stored = rows.at(connection, "codes", [3, 4, 5])
        rows.replace(connection, "codes", {3: stored[4], 5: stored[5][:-1]})  # 5: of another length, but sealed
    execute(lab, "DELETE FROM codes WHERE row = 7")
    if not lab.database.shared:
        execute(
            lab,
            "UPDATE codes SET bytes = CAST(x'ff' || substr(bytes, 2) AS BLOB) WHERE row IN (8, 9)",
            "UPDATE codes SET bytes = x'' WHERE row = 10",
        )
    else:
        execute(
            lab,
            "UPDATE codes SET bytes = set_byte(bytes, 0, get_byte(bytes, 0) # 255) WHERE row IN (8, 9)",
            "UPDATE codes SET bytes = '' WHERE row = 10",
        )
    report = lab.verify()
    assert report.ok and len(report.stale_caches) == 3
    assert all(f"the code of place 'p{row}' does not match" in " ".join(report.stale_caches) for row in (8, 9, 10))
    store.close()
    store = open_store()
    lab = store.get("lab")
    with caplog.at_level(logging.ERROR):
        found = lab.snapshot()
    assert "The codes of 3 rows of map lab are damaged and made again" in caplog.text
    assert store.quarantined() == {} and found.table is not None
    codes, right = found.table.codes(0, PLACES), found.table.coder.encode(found.descriptors_at(np.arange(PLACES)))
    assert np.flatnonzero((codes != right).any(axis=1)).tolist() == [3], "another's, with its own checksum"
    lab.rebuild_index()
    report = lab.verify()
    assert (report.ok, report.stale_caches) == (True, []) and codes_are_right(lab)


@on_both
def test_codes_are_made_again_while_writes_and_searches_go_on(store: Store) -> None:
    lab = make(store, index="compact")
    lab.snapshot()
    done: list[tuple[int, int]] = []

    def progress(count: int, total: int) -> None:
        if count == 64:
            lab.enrol([frame("late", dimension=DIMENSION)])
            lab.forget("p149")
        assert finds(lab, "p0") and (count < 64 or finds(lab, "late"))
        done.append((count, total))

    status = lab.rebuild_index(progress)
    assert status.recall is not None and status.recall.at_1 > 0.9
    assert (status.recall.queries, status.recall.places) == (16, PLACES)
    assert status.rows_indexed == PLACES + 1 and done[-1] == (PLACES, PLACES) and len(done) > PLACES // 8
    assert all(finds(lab, name) for name in ("p0", "p148", "late")) and not finds(lab, "p149")
    assert codes_are_right(lab) and lab.verify().ok


def test_one_that_is_broken_off_leaves_a_map_that_is_searched(store: Store) -> None:
    lab = make(store, index="compact")
    execute(lab, "UPDATE codes SET bytes = x''")

    def cancel(done: int, _total: int) -> None:
        if done > 64:
            raise InterruptedError

    with pytest.raises(InterruptedError):
        lab.rebuild_index(cancel)
    with lab.viewing() as (connection, _):
        damaged: set[int] = set()
        assert len(rows.at(connection, "codes", range(PLACES), damaged)) == 72 and len(damaged) == PLACES - 72
    lab.enrol([frame("new", dimension=DIMENSION)])
    assert finds(lab, "new") and finds(lab, "p0") and finds(lab, "p149")


def test_a_map_that_is_deleted_while_codes_are_made(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    lab, encode = make(store, index="compact"), Coder.encode
    before = lab.snapshot()

    def deleted(self: Coder, descriptors: NDArray[np.float32]) -> Codes:
        monkeypatch.undo()
        return encode(self, descriptors)

    monkeypatch.setattr(Coder, "encode", deleted)
    with pytest.raises(UnknownMap):
        lab.rebuild_index(lambda done, total: store.delete("lab"))
    with pytest.raises(UnknownMap):
        before.search(descriptor_of("p8", DIMENSION))


@on_both
def test_an_empty_map_waits_for_its_first_place(store: Store) -> None:
    lab = store.create("lab", ENCODER, DIMENSION, MapSettings(index="compact"), LOCAL_SHAPE)
    assert len(lab.snapshot()) == 0 and lab.index_status().tier == "exact"
    assert lab.rebuild_index().recall is None
    lab.enrol([frame("first", dimension=DIMENSION)])
    assert finds(lab, "first") and lab.index_status().tier == "compact" and codes_are_right(lab)
    lab.forget("first")
    assert lab.snapshot().search(descriptor_of("first", DIMENSION))[0].tolist() == []


def test_whereabouts_of_a_few_rows_are_those_of_all(store: Store) -> None:
    lab = make(store, index="compact")
    lab.enrol([frame(f"at{i}", dimension=DIMENSION, x=i) for i in range(5)])
    found, some = lab.snapshot(), np.array([PLACES + 3, 0, PLACES + 1])
    few, every = found.whereabouts_at(some), found.whereabouts.take(some)
    for name, column in vars(few).items():
        np.testing.assert_array_equal(column, getattr(every, name))
    assert len(found.whereabouts_at(np.arange(found.rows))) == found.rows
    assert len(found.whereabouts_at(np.empty(0, np.int64))) == 0


@on_both
def test_compressed_maps_answer_too(store: Store) -> None:
    lab = store.create("lab", ENCODER, DIMENSION, MapSettings(index="compact"), LOCAL_SHAPE, precision=COMPRESSED)
    lab.enrol([frame(f"p{i}", dimension=DIMENSION) for i in range(PLACES)])
    first = [int(lab.snapshot().search(descriptor_of(f"p{i}", DIMENSION))[0][0]) for i in range(PLACES)]
    assert first == list(range(PLACES)) and lab.index_status().tier == "compact"
    assert lab.verify().ok
    assert lab.storage_status().descriptors == PLACES * (2 * (2 + 96) + 3 * (1 + 3))


def test_rows_are_read_once_and_the_cache_stays_within_its_bytes(store: Store) -> None:
    lab = make(store, index="compact")
    found, cache = lab.snapshot(), lab._cache
    found.locals_at(np.arange(50))
    misses, hits = cache.misses, cache.hits
    found.locals_at(np.arange(50))
    assert misses >= 50 and (cache.misses, cache.hits) == (misses, hits + 50)
    small = following.RowCache(1000)
    for number in range(100):
        small.put({number: bytes(100)})
        assert small.size <= 1000
    assert 0 < len(small) < 10 and not small.get([0]) and small.get([99])
