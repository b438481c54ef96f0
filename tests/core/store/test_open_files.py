"""Only a number of the maps of a data directory are open together, and each is used as if it were open."""

from __future__ import annotations

import os
import random
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from core.errors import StorageFailure
from core.ledger.maps import places
from core.store import Directory, Map
from tests.core.store.conftest import file_of
from tests.core.store.frames import DIMENSION, ENCODER, LOCAL_SHAPE, descriptor_of, frame

MOST, NAMES = 2, [f"m{number}" for number in range(5)]


@pytest.fixture
def store(directory: Path) -> Iterator[Directory]:
    """Five maps, of which two may be open."""
    made = Directory(directory, most_open=MOST, rows_per_segment=4)
    for name in NAMES:
        made.create(name, ENCODER, DIMENSION, local_shape=LOCAL_SHAPE).enrol([frame(f"{name}-{i}") for i in range(6)])
    yield made
    made.close()


def descriptors_of(folder: Path) -> dict[str, int]:
    """How many descriptors of this process are open on the files of each map."""
    found: dict[str, int] = {}
    for one in Path("/proc/self/fd").iterdir():
        try:
            path = Path(os.readlink(one))
        except FileNotFoundError:
            continue  # that of the listing itself
        if folder in path.parents:
            name = path.relative_to(folder).parts[0]
            found[name] = found.get(name, 0) + 1
    return found


def finds(map_: Map, place_id: str) -> bool:
    rows, _ = map_.snapshot().search(descriptor_of(place_id))
    (place,) = map_.places_at(rows[:1].tolist())
    return place is not None and place.id == place_id


def test_those_used_least_are_closed_and_all_of_them_answer(store: Directory, directory: Path) -> None:
    maps = directory / "maps"
    for turn in range(2):
        for name in NAMES:
            assert finds(store.get(name), f"{name}-{turn}") and store.get(name).place(f"{name}-0").id == f"{name}-0"
            assert name in descriptors_of(maps) and len(descriptors_of(maps)) == store.open_maps == MOST
    assert set(descriptors_of(maps)) == {"m3", "m4"}
    assert [store.opened(name) is not None for name in NAMES] == [False, False, False, True, True]
    assert finds(store.get("m3"), "m3-0")  # it is used again
    store.get("m0").enrol([frame("new")])
    assert set(descriptors_of(maps)) == {"m3", "m0"}
    assert not store.find("m4").is_open and store.find("m4").count_places() == 6
    for name in NAMES:
        assert store.verify(name).ok


def test_files_in_use_stay_open_and_are_closed_later(store: Directory, directory: Path) -> None:
    maps = directory / "maps"
    m0, m1, m2 = (store.get(name) for name in NAMES[:3])
    with m0.viewing() as (connection, state), m1._writing() as write:
        for name in NAMES[2:]:
            assert finds(store.get(name), f"{name}-1")
        assert {"m0", "m1"} <= set(descriptors_of(maps)), "one is being read, the other written to"
        assert state.places == len(places.listed(connection, -1, 10)) == 6
        write.enrol(frame("late"))
    assert m0.count_places() == 6 and finds(m1, "late")
    for name in ("m3", "m4"):
        assert finds(store.get(name), f"{name}-1")
    assert set(descriptors_of(maps)) == {"m3", "m4"} and len(m2.snapshot()) == 6


def test_a_snapshot_is_searched_although_its_file_was_closed(store: Directory) -> None:
    held = store.get("m0").snapshot()
    for name in NAMES[1:]:
        store.get(name).snapshot()
    assert store.opened("m0") is None
    rows, _ = held.search(descriptor_of("m0-3"))
    assert rows[0] == 3
    lab = store.get("m1")
    lab.edit({"index": "compact"})  # its descriptors are read from the file
    compact = lab.snapshot()
    for name in NAMES[2:]:
        store.get(name).snapshot()
    assert store.opened("m1") is None and compact.search(descriptor_of("m1-2"))[0][0] == 2


@pytest.mark.thorough
def test_many_threads_use_more_maps_than_may_be_open(store: Directory, directory: Path) -> None:
    written: dict[str, list[str]] = {name: [f"{name}-{i}" for i in range(6)] for name in NAMES}
    guard = threading.Lock()

    def work(which: int) -> None:
        order = random.Random(which)
        for turn in range(25):
            name = order.choice(NAMES)
            map_, place_id = store.get(name), f"t{which}-{turn}"
            map_.enrol([frame(place_id)])
            with guard:
                written[name].append(place_id)
            assert finds(map_, place_id) and map_.place(place_id).id == place_id
            other = order.choice(NAMES)
            assert finds(store.get(other), f"{other}-{order.randrange(6)}")

    with ThreadPoolExecutor(6) as pool:
        for done in [pool.submit(work, which) for which in range(6)]:
            done.result()
    for name in NAMES:
        map_ = store.get(name)
        assert sorted(place.id for place in map_.places(None, 1000)[0]) == sorted(written[name])
        assert map_.verify().ok
    assert len(descriptors_of(directory / "maps")) == store.open_maps == MOST


def test_a_closed_directory_has_no_descriptor_left(store: Directory, directory: Path) -> None:
    for name in NAMES:
        store.get(name).snapshot()
    lab = store.get("m0")
    store.close()
    assert descriptors_of(directory) == {}
    with pytest.raises(StorageFailure, match="closed"):
        lab.place("m0-0")
    assert descriptors_of(directory) == {}


def test_deleted_and_published_maps_leave_none_open(store: Directory, directory: Path) -> None:
    store.get("m0").snapshot()
    store.delete("m0")
    made = store.create("new", ENCODER, DIMENSION, local_shape=LOCAL_SHAPE, unlisted=True)
    made.enrol([frame("a")])
    assert finds(store.publish("new"), "a")
    store.create("gone", ENCODER, DIMENSION, local_shape=LOCAL_SHAPE, unlisted=True).enrol([frame("a")])
    store.abandon("gone")
    assert all(not name.startswith(".") and name != "m0" for name in descriptors_of(directory / "maps"))
    assert store.open_maps <= MOST and file_of(store.get("new")).path.is_file()
