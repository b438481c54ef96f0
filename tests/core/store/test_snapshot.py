from __future__ import annotations

import threading

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from core.index.flat import flat_index, vectors
from core.store import Snapshot
from core.store import snapshot as module
from core.store.segment import Location
from tests.core.store.frames import descriptor_of, local_of

DIMENSION, ROWS, SHAPE = 8, 4, (2, 3)


def spot(row: int, kind: int = 1) -> Location:
    return Location(kind, (float(row), 0.5, -1.0), row % 3, row)


def descriptors(count: int, start: int = 0) -> list[NDArray[np.float32]]:
    return [descriptor_of(f"row {start + i}", DIMENSION) for i in range(count)]


def local(count: int, start: int = 0) -> list[NDArray[np.int8]]:
    return [local_of(f"row {start + i}", SHAPE) for i in range(count)]


def grown(snapshot: Snapshot, count: int) -> Snapshot:
    """With so many rows more."""
    start = snapshot.rows
    spots = [spot(start + row) for row in range(count)]
    return snapshot.appended(descriptors(count, start), spots, local(count, start))


def snapshot_of(count: int) -> Snapshot:
    return grown(Snapshot(DIMENSION, ROWS, local_shape=SHAPE), count)


QUERY = descriptor_of("query", DIMENSION)


def expected(rows: list[int], query: NDArray[np.float32] = QUERY) -> list[int]:
    """By brute force."""
    products = {row: float(descriptors(1, row)[0] @ query) for row in rows}
    return sorted(rows, key=lambda row: (-products[row], row))


def test_an_empty_snapshot() -> None:
    snapshot = Snapshot(DIMENSION, ROWS)
    rows, products = snapshot.search(QUERY)
    assert (len(snapshot), snapshot.rows, len(snapshot.whereabouts)) == (0, 0, 0)
    assert (str(rows.dtype), rows.shape) == ("int64", (0,))
    assert (str(products.dtype), products.shape) == ("float32", (0,))
    assert snapshot.search_batch(np.empty((0, DIMENSION), dtype=np.float32)) == []
    assert snapshot.whereabouts.position.shape == (0, 3)


@pytest.mark.parametrize("count", [1, 3, 4, 5, 8, 11])
def test_every_place_is_ranked(count: int) -> None:
    snapshot = snapshot_of(count)
    rows, products = snapshot.search(QUERY)
    assert (str(rows.dtype), str(products.dtype)) == ("int64", "float32")
    assert rows.tolist() == expected(list(range(count)))
    np.testing.assert_allclose(products, np.array(descriptors(count))[rows] @ QUERY, rtol=1e-5, atol=1e-6)
    assert [len(segment) for segment in snapshot.segments] == [4] * (count // 4) + [count % 4] * (count % 4 > 0)


def test_a_full_segment_holds_exactly_its_rows() -> None:
    index = snapshot_of(9).segments[1].index
    assert (index.ntotal, index.d) == (4, DIMENSION)
    np.testing.assert_array_equal(vectors(index), descriptors(4, 4))


def test_equal_places_are_ranked_by_row() -> None:
    same = [descriptors(1)[0]] * 10
    rows, products = Snapshot(DIMENSION, ROWS).appended(same, [spot(row) for row in range(10)]).search(QUERY)
    assert rows.tolist() == list(range(10))
    assert len(set(products.tolist())) == 1


def test_whereabouts_are_those_of_the_rows() -> None:
    snapshot = snapshot_of(10)
    there = snapshot.whereabouts.take(snapshot.search(QUERY)[0])
    assert there.ordinal.tolist() == expected(list(range(10)))
    assert there.position[:, 0].tolist() == expected(list(range(10)))
    assert there.sequence.tolist() == [row % 3 for row in expected(list(range(10)))]
    dtypes = [array.dtype.name for array in (there.kind, there.position, there.sequence, there.ordinal)]
    assert dtypes == ["int8", "float64", "int32", "int64"]


def test_a_later_write_does_not_change_an_earlier_snapshot() -> None:
    first = snapshot_of(6)
    second = grown(first, 5)
    third = second.without([0, 7]).moved({1: spot(99, kind=2)})
    assert first.search(QUERY)[0].tolist() == expected(list(range(6)))
    assert second.search(QUERY)[0].tolist() == expected(list(range(11)))
    assert third.search(QUERY)[0].tolist() == expected([1, 2, 3, 4, 5, 6, 8, 9, 10])
    assert (second.whereabouts.kind[1], third.whereabouts.kind[1]) == (1, 2)
    assert third.whereabouts.position[1].tolist() == [99.0, 0.5, -1.0]
    assert (len(first), len(second), len(third)) == (6, 11, 9)
    for snapshot in (first, second, third):
        every = np.arange(snapshot.rows)
        np.testing.assert_array_equal(snapshot.locals_at(every), local(snapshot.rows))


def test_a_write_copies_no_full_segment_and_not_the_tail_it_still_fits() -> None:
    snapshot = grown(Snapshot(DIMENSION, 64, local_shape=SHAPE), 65)
    after = grown(snapshot, 1)
    assert [a.index is b.index for a, b in zip(snapshot.segments, after.segments, strict=True)] == [True, True]
    assert [a.local is b.local for a, b in zip(snapshot.segments, after.segments, strict=True)] == [True, True]
    edited = after.moved({65: spot(1)}).without([65])
    assert edited.segments[0] is after.segments[0]
    assert edited.segments[1].index is after.segments[1].index
    assert edited.segments[1].local is after.segments[1].local


def test_a_growing_tail_is_seldom_copied() -> None:
    snapshot, tails, locals_ = Snapshot(DIMENSION, 256, local_shape=SHAPE), set(), set()
    kept = []
    for _ in range(256):
        snapshot = grown(snapshot, 1)
        kept.append(snapshot.segments[-1])  # or an address might be used again
        tails.add(id(kept[-1].index))
        locals_.add(id(kept[-1].local))
        assert len(kept[-1].local) == kept[-1].index.ntotal
    assert len(tails) == len(locals_) == 6  # 8, 16, … 256
    assert snapshot.search(QUERY)[0].tolist() == expected(list(range(256)))
    np.testing.assert_array_equal(snapshot.locals_at(np.arange(256)), local(256))


def test_a_write_that_was_given_up_is_overwritten() -> None:
    snapshot = snapshot_of(5)
    snapshot.appended(descriptors(1, 77), [spot(77)], local(1, 77))
    after = grown(snapshot, 1)
    assert after.search(QUERY)[0].tolist() == expected(list(range(6)))
    np.testing.assert_array_equal(after.locals_at(np.array([5])), local(1, 5))


def test_local_descriptors_come_in_the_order_of_the_rows_and_are_a_copy() -> None:
    snapshot = snapshot_of(11)
    rows = np.array([10, 0, 4, 0, 7])
    found = snapshot.locals_at(rows)
    assert (str(found.dtype), found.shape, found.flags.c_contiguous) == ("int8", (5, *SHAPE), True)
    np.testing.assert_array_equal(found, [local(1, row)[0] for row in rows])
    found[:] = 0
    np.testing.assert_array_equal(snapshot.locals_at(np.array([4]))[0], local(1, 4)[0])
    assert snapshot.locals_at(np.empty(0, np.int64)).shape == (0, *SHAPE)


@pytest.mark.parametrize("row", [-1, 6, 7, 8])
def test_room_that_later_snapshots_use_is_nobodys(row: int) -> None:
    """Row 6 and 7 are there already, in memory that is shared with the later snapshot."""
    snapshot = snapshot_of(6)
    grown(snapshot, 3)
    with pytest.raises(IndexError, match="rows 0 to 5"):
        snapshot.locals_at(np.array([0, row]))


def test_without_local_descriptors_there_is_nothing_of_them() -> None:
    snapshot = Snapshot(DIMENSION, ROWS).appended(descriptors(6), [spot(row) for row in range(6)])
    assert snapshot.search(QUERY)[0].tolist() == expected(list(range(6)))
    assert snapshot.locals_at(np.array([5, 1])).shape == (2, 0, 0)
    assert [segment.local.nbytes for segment in snapshot.segments] == [0, 0]


def test_every_place_has_its_local_descriptors() -> None:
    with pytest.raises(ValueError, match="every place"):
        snapshot_of(3).appended(descriptors(2, 3), [spot(3), spot(4)], local(1, 3))
    with pytest.raises(ValueError, match="every place"):
        snapshot_of(3).appended(descriptors(1, 3), [spot(3)])


def test_a_segment_of_the_dead_is_not_searched() -> None:
    snapshot = snapshot_of(12).without([4, 5, 6, 7, 9])
    assert snapshot.search(QUERY)[0].tolist() == expected([0, 1, 2, 3, 8, 10, 11])
    nobody = snapshot.without([0, 1, 2, 3, 8, 10, 11])
    assert len(nobody) == 0
    assert nobody.search(QUERY)[0].tolist() == []


@pytest.mark.parametrize("queries", [1, 2, 7, 30])
def test_many_queries_are_answered_as_each_alone(queries: int) -> None:
    snapshot = snapshot_of(11).without([2, 8])
    batch = np.array([descriptor_of(f"query {i}", DIMENSION) for i in range(queries)])
    answers = snapshot.search_batch(batch)
    assert len(answers) == queries
    for query, (rows, products) in zip(batch, answers, strict=True):
        alone, alone_products = snapshot.search(query)
        assert rows.tolist() == alone.tolist()
        np.testing.assert_allclose(products, alone_products, rtol=1e-5, atol=1e-6)


def test_halves_are_held_as_they_are_and_ranked_as_floats_are() -> None:
    kept = [row.astype(np.float16).astype(np.float32) for row in descriptors(23)]
    spots = [spot(row) for row in range(23)]
    floats = Snapshot(DIMENSION, 10).appended(kept, spots).without([4])
    halves = (
        Snapshot(DIMENSION, 10, halves=True).appended(kept[:7], spots[:7]).appended(kept[7:], spots[7:]).without([4])
    )
    rows, products = halves.search(QUERY)
    np.testing.assert_array_equal(halves.descriptors_at(np.arange(23)), kept)
    assert rows.tolist() == floats.search(QUERY)[0].tolist()
    np.testing.assert_allclose(products, np.array(kept)[rows] @ QUERY, rtol=1e-5, atol=1e-6)
    held = [
        (half.index.codes.size(), full.index.codes.size())
        for half, full in zip(halves.segments, floats.segments, strict=True)
    ]
    assert all(2 * half == full for half, full in held)


@pytest.mark.parametrize("halves", [False, True])
def test_the_index_of_a_segment_is_one_of_faiss(halves: bool) -> None:
    """It finds by itself what the snapshot finds in it."""
    snapshot = Snapshot(DIMENSION, 32, halves=halves).appended(descriptors(32), [spot(row) for row in range(32)])
    products, rows = snapshot.segments[0].index.search(QUERY[np.newaxis], 32)
    ranked, found = snapshot.search(QUERY)
    assert rows[0].tolist() == ranked.tolist()
    np.testing.assert_allclose(products[0], found, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("queries", [1, 5])
def test_segments_on_several_threads_are_ranked_together(queries: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_SHARED_FROM", 1)
    snapshot = Snapshot(DIMENSION, 10).appended(descriptors(37), [spot(row) for row in range(37)])
    for rows, _ in snapshot.search_batch(np.repeat(QUERY[np.newaxis], queries, axis=0)):
        assert rows.tolist() == expected(list(range(37)))


def test_an_error_in_a_thread_is_the_callers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_SHARED_FROM", 1)

    def fail(*_: object) -> None:
        raise MemoryError

    monkeypatch.setattr(module.Segment, "search", fail)
    with pytest.raises(MemoryError):
        snapshot_of(8).search(QUERY)


@pytest.mark.parametrize(
    "query",
    [np.zeros(DIMENSION - 1), np.full(DIMENSION, np.nan), np.full(DIMENSION, np.inf), np.zeros((1, DIMENSION))],
)
def test_what_is_no_query_is_refused(query: NDArray[np.float64]) -> None:
    with pytest.raises(ValueError, match="finite"):
        snapshot_of(3).search(query.astype(np.float32))


def test_room_for_no_row() -> None:
    assert vectors(flat_index(0, DIMENSION)).shape == (0, DIMENSION)


def test_searches_while_a_writer_appends() -> None:
    newest = [snapshot_of(1)]
    done = threading.Event()
    faults: list[str] = []

    def search() -> None:
        while not done.is_set():
            snapshot = newest[0]
            rows = snapshot.search(QUERY)[0]
            if rows.tolist() != expected(list(range(len(snapshot)))):
                faults.append(str(rows))
            if not np.array_equal(snapshot.locals_at(rows[:5]), [local(1, row)[0] for row in rows[:5].tolist()]):
                faults.append("local descriptors")

    threads = [threading.Thread(target=search) for _ in range(3)]
    for thread in threads:
        thread.start()
    for row in range(1, 60):
        assert newest[0].rows == row
        newest[0] = grown(newest[0], 1)
    done.set()
    for thread in threads:
        thread.join()
    assert faults == []


@settings(max_examples=60)
@given(
    steps=st.lists(
        st.one_of(
            st.tuples(st.just("append"), st.integers(1, 6)),
            st.tuples(st.just("bury"), st.integers(0, 30)),
            st.tuples(st.just("move"), st.integers(0, 30)),
        ),
        max_size=25,
    )
)
def test_any_history_is_searched_as_by_brute_force(steps: list[tuple[str, int]]) -> None:
    snapshot, alive, moved = Snapshot(DIMENSION, ROWS, local_shape=SHAPE), list[int](), dict[int, int]()
    total = 0
    for action, number in steps:
        if action == "append":
            fresh = list(range(total, total + number))
            snapshot = grown(snapshot, number)
            alive, total = alive + fresh, total + number
        elif number in alive and action == "bury":
            snapshot = snapshot.without([number])
            alive.remove(number)
        elif number in alive:
            snapshot = snapshot.moved({number: spot(number + 1000)})
            moved[number] = number + 1000
    assert len(snapshot) == len(alive)
    assert snapshot.rows == total
    rows, _ = snapshot.search(QUERY)
    assert rows.tolist() == expected(alive)
    assert snapshot.locals_at(rows).tolist() == [local(1, row)[0].tolist() for row in rows.tolist()]
    assert snapshot.whereabouts.take(rows).ordinal.tolist() == [moved.get(row, row) for row in rows.tolist()]
