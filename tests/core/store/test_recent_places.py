"""A place that was looked up is known without reading, and never as it was before a write."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import pytest

from core.ledger.maps import places
from core.ledger.maps.connection import MapConnection
from core.ledger.maps.places import StoredPlace
from core.places import PlaceFields, Pose
from core.store import Map
from core.store.map import LONGEST_METADATA, MOST_RECENT, RecentPlaces
from tests.core.store.frames import frame


@contextmanager
def reads(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[list[int]]]:
    """The rows that are looked up in SQLite meanwhile."""
    asked: list[list[int]] = []
    read = places.at_rows

    def watched(connection: MapConnection, rows: list[int]) -> dict[int, StoredPlace]:
        asked.append(rows)
        return read(connection, rows)

    with monkeypatch.context() as patched:
        patched.setattr(places, "at_rows", watched)
        yield asked


def ids(lab: Map, rows: list[int]) -> list[str | None]:
    return [None if place is None else place.id for place in lab.places_at(rows)]


def test_only_what_is_not_known_is_read(lab: Map, monkeypatch: pytest.MonkeyPatch) -> None:
    lab.enrol([frame(f"p{i}") for i in range(5)])
    with reads(monkeypatch) as asked:
        assert ids(lab, [3, 1]) == ["p3", "p1"]
        assert ids(lab, [1, 3]) == ["p1", "p3"]
        assert ids(lab, [1, 4, 3, 77]) == ["p1", "p4", "p3", None]
        assert ids(lab, [4, 1]) == ["p4", "p1"]
        assert lab.places_at([4]) == [lab.place("p4")]
    assert asked == [[3, 1], [4, 77]]


def test_every_write_is_seen_at_once(lab: Map) -> None:
    lab.enrol([frame(f"p{i}", sequence="s" if i == 2 else None) for i in range(6)])
    rows = list(range(6))
    assert None not in lab.places_at(rows)
    lab.forget("p0")
    assert ids(lab, rows) == [None, "p1", "p2", "p3", "p4", "p5"]
    lab.patch("p1", {"metadata": {"door": "open"}})
    assert lab.places_at([1])[0] == lab.place("p1")
    assert lab.place("p1").metadata == {"door": "open"}
    lab.forget_sequence("s")
    assert ids(lab, rows) == [None, "p1", None, "p3", "p4", "p5"]
    lab.set_fields("p3", PlaceFields(pose=Pose(x=1, y=2)))
    (moved,) = lab.places_at([3])
    assert moved is not None and moved.pose == Pose(x=1, y=2)
    lab.enrol([frame("p4", "another picture"), frame("p0")])
    assert ids(lab, [*rows, 6, 7]) == [None, "p1", None, "p3", None, "p5", "p4", "p0"]
    lab.enrol([replace(frame("p5"), fields=PlaceFields(metadata={"lamp": 1}))])
    (lit,) = lab.places_at([5])
    assert lit is not None and lit.metadata == {"lamp": 1}


def test_a_write_that_fails_changes_nothing(lab: Map) -> None:
    lab.enrol([frame("p0"), frame("p1")])
    before = lab.places_at([0, 1])
    with pytest.raises(RuntimeError), lab._writing() as write:
        write.forget(places.expect(write.connection, "p0"))
        assert lab.places_at([0, 1]) == before
        raise RuntimeError
    assert lab.places_at([0, 1]) == before


def test_what_is_remembered_is_bounded(lab: Map) -> None:
    lab.enrol([frame("p0"), replace(frame("p1"), fields=PlaceFields(metadata={"text": "x" * LONGEST_METADATA}))])
    place, long = lab.places_at([0, 1])
    assert place is not None and long is not None
    recent, state = RecentPlaces(), object()
    for first in range(0, 3 * MOST_RECENT, 7):
        recent.keep(state, {first + i: place for i in range(7)})
        assert first in recent.places(state, [first])
        assert len(recent.places(state, range(3 * MOST_RECENT))) <= MOST_RECENT
    recent.keep(state, {5: long})
    assert recent.places(state, [5]).get(5) is not long
    recent.keep(state, dict.fromkeys(range(2 * MOST_RECENT), place))
    assert len(recent.places(state, range(2 * MOST_RECENT))) == MOST_RECENT
    assert recent.places(object(), range(2 * MOST_RECENT)) == {}
