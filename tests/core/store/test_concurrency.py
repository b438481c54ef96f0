"""Many threads at once: writers, searchers, readers, and one that deletes."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from core.errors import MapExists, StorageFailure, UnknownMap, UnknownPlace
from core.store import Directory, Map, Store
from tests.core.store.conftest import OpenStore, on_both
from tests.core.store.frames import DIMENSION, ENCODER, LOCAL_SHAPE, descriptor_of, frame, local_of


def run_together(*works: Callable[[], None]) -> None:
    with ThreadPoolExecutor(len(works)) as pool:
        for future in [pool.submit(work) for work in works]:
            future.result()


@pytest.mark.thorough
@on_both
def test_writers_and_searchers(lab: Map) -> None:
    """What a writer was told is seen at once by whoever looks next; nobody sees half a write."""
    writing = threading.Event()
    writers, each = 4, 15
    left = [writers]
    guard = threading.Lock()

    def write(writer: int) -> Callable[[], None]:
        def work() -> None:
            for i in range(each):
                names = [f"w{writer}-{i}", f"w{writer}-{i}-twin"]
                lab.enrol([frame(name, sequence=f"s{writer}") for name in names])
                snapshot = lab.snapshot()
                for name in names:
                    rows, products = snapshot.search(descriptor_of(name))
                    assert products[0] > 0.999
                    np.testing.assert_array_equal(snapshot.locals_at(rows[:1])[0], local_of(name))
                    (found,) = lab.places_at(rows[:1].tolist())
                    assert found is not None
                    assert found.id == name
                if i % 3 == 0:
                    lab.patch(names[0], {"metadata": {"i": i}})
                    assert lab.place(names[0]).metadata == {"i": i}
                if i % 4 == 0:
                    lab.forget(names[1])
                    assert lab.snapshot().search(descriptor_of(names[1]))[1][0] < 0.999
            with guard:
                left[0] -= 1
                if not left[0]:
                    writing.set()

        return work

    def search() -> None:
        before = 0
        while not writing.is_set():
            snapshot = lab.snapshot()
            assert snapshot.rows % 2 == 0  # twins come together
            assert snapshot.rows >= before
            before = snapshot.rows
            rows, products = snapshot.search(descriptor_of("w0-0"))
            assert len(rows) == len(products) == len(snapshot)
            assert len(snapshot.whereabouts) == snapshot.rows
            best = rows[:3]
            for found, local in zip(lab.places_at(best.tolist()), snapshot.locals_at(best), strict=True):
                if found is not None:  # not forgotten since
                    np.testing.assert_array_equal(local, local_of(found.id))

    def read() -> None:
        while not writing.is_set():
            places, cursor = lab.places(None, 7)
            assert len(places) == 7 or cursor is None
            for summary in lab.sequences(None, 10)[0]:
                assert summary.name.startswith("s")

    def verify() -> None:
        while not writing.is_set():
            report = lab.verify()
            assert report.problems == []

    run_together(*[write(writer) for writer in range(writers)], search, search, read, read, verify)
    assert lab.count_places() == writers * (2 * each - len(range(0, each, 4)))
    assert lab.verify().ok


@on_both
def test_a_map_is_deleted_under_its_users(store: Store, directory: Path) -> None:
    for _ in range(3):
        lab = store.create("lab", ENCODER, DIMENSION, local_shape=LOCAL_SHAPE)
        lab.enrol([frame("p")])
        started = threading.Barrier(4)

        def use(lab: Map = lab, started: threading.Barrier = started) -> None:
            started.wait()
            try:
                for i in range(10_000):
                    lab.enrol([frame(f"q{i % 50}", f"picture {i}")])
                    assert lab.place("p").id == "p"
                    lab.snapshot().search(descriptor_of("p"))
            except UnknownMap:
                return
            raise AssertionError

        def delete(started: threading.Barrier = started) -> None:
            started.wait()
            store.delete("lab")

        run_together(use, use, use, delete)
        assert store.records(None, 10) == ([], None)
        assert not isinstance(store, Directory) or list((directory / "maps").iterdir()) == []


@on_both
def test_one_of_many_makes_a_map(store: Store) -> None:
    made: list[Map] = []

    def make() -> None:
        try:
            made.append(store.create("lab", ENCODER, DIMENSION, local_shape=LOCAL_SHAPE))
        except MapExists:
            assert store.get("lab").record.id == "lab"

    run_together(*[make] * 8)
    assert len(made) == 1


@on_both
def test_a_map_is_read_once_by_many(open_store: OpenStore, store: Store, lab: Map) -> None:
    lab.enrol([frame(f"p{i}") for i in range(9)])
    store.close()
    store = open_store()
    seen: list[object] = []

    def use() -> None:
        lab = store.get("lab")
        seen.append(lab.snapshot())
        assert lab.place("p3").id == "p3"

    run_together(*[use] * 8)
    assert all(snapshot is seen[0] for snapshot in seen)


@on_both
def test_closing_under_load(open_store: OpenStore, store: Store, lab: Map) -> None:
    taken: list[str] = []
    some, started = threading.Event(), threading.Barrier(3)

    def write() -> None:
        started.wait()
        try:
            for i in range(10_000):
                lab.enrol([frame(f"p{i}")])
                taken.append(f"p{i}")
                if i == 5:
                    some.set()
        except StorageFailure:
            return
        raise AssertionError

    def read() -> None:
        started.wait()
        try:
            while True:
                try:
                    lab.place("p0")
                except UnknownPlace:
                    continue
        except StorageFailure:
            return

    def close() -> None:
        started.wait()
        assert some.wait(60)
        store.close()

    run_together(write, read, close)
    assert [place.id for place in open_store().get("lab").places(None, 10_000)[0]] == taken
