"""No statement walks over all places of a map, or all rows of another table, to find a few of them."""

from __future__ import annotations

import re
import sqlite3
from collections.abc import Callable
from datetime import UTC, datetime

import numpy as np
import pytest

from core.ledger.maps import rows
from core.maps import ReviewSetting, SameFrame
from core.maps.forms import Form
from core.maps.place_filter import PlaceFilter
from core.maps.selection import Conditions, RecentFrames, Selection
from core.places import PlaceFields
from core.store import Map
from core.store.file import MapFile
from core.store.rows import RowCache, Rows
from tests.core.store.frames import frame

NOON = datetime(2026, 11, 20, 12, tzinfo=UTC)
LAST = RecentFrames("s", 3)

LARGE = "places|tokens|pictures|keypoints|descriptors|locals|codes|dead_rows|review_pictures"

ACTIONS: dict[str, Callable[[Map], object]] = {
    "enrol": lambda lab: lab.enrol([frame("new", sequence="s", metadata={"floor": 1}, camera="front")]),
    "enrol again": lambda lab: lab.enrol([frame("p1", sequence="s", metadata={"floor": 1})]),
    "the same frame": lambda lab: lab.enrol([SameFrame("p2", PlaceFields(metadata={"n": 1}), frame("p2").digest)]),
    "another frame": lambda lab: lab.enrol([frame("p3", "another", sequence="s")]),
    "another sequence": lambda lab: lab.patch("p4", {"sequence": "t"}),
    "another pose": lambda lab: lab.patch("p5", {"pose": {"x": 1, "y": 2}}),
    "forget": lambda lab: lab.forget("p6"),
    "edit": lambda lab: lab.edit({"description": "another"}),
    "keypoints": lambda lab: lab.keypoints_at([1, 2, 3]),
    "places": lambda lab: lab.places_at([1, 2, 3]),
    "place": lambda lab: lab.place("p7"),
    "rows": lambda lab: lab.rows_of(["p1", "p7"]),
    "digest": lambda lab: lab.digest("p1"),
    "picture": lambda lab: lab.picture("p1"),
    "a page": lambda lab: lab.places(None, 5),
    "a page of some": lambda lab: lab.places(None, 5, PlaceFilter(ids=("p1", "p2"))),
    "a page of a sequence": lambda lab: lab.places(None, 5, PlaceFilter(sequence="s")),
    "a page by metadata": lambda lab: lab.places(None, 5, PlaceFilter(metadata={"floor": 1})),
    "names of sequences": lambda lab: lab.unknown_sequences(["s", "u"]),
    "a scope": lambda lab: lab.scope(Selection(Conditions(sequences=("s",), metadata={"floor": 1}), recent=LAST)),
    "descriptors": lambda lab: Rows(lab._glancing, Form.of(lab.record), RowCache()).descriptors(np.array([1, 2])),
    "followed": lambda lab: lab.enrol([frame("next")]) and lab.snapshot(),
    "cleared": lambda lab: lab.transfer.forget({"p8": frame("p8").digest}) and lab.edit({"description": "cleared"}),
    "a frame for review": lambda lab: lab.review.keep(b"frame", {}, ReviewSetting()),
    "frames for review": lambda lab: lab.review.page(None, 5),
    "cameras": lambda lab: lab.cameras.put("front", None),
}


@pytest.fixture
def walked(lab: Map, monkeypatch: pytest.MonkeyPatch) -> Map:
    monkeypatch.setattr(rows, "LEFT_SECONDS", 0)
    lab.enrol([frame(f"p{i}", sequence="s", metadata={"floor": i % 3}, timestamp=NOON) for i in range(10)])
    lab.enrol([frame("alone", x=1.0)])
    return lab


@pytest.mark.parametrize("action", ACTIONS.values(), ids=ACTIONS)
def test_rows_are_found_by_an_index(walked: Map, action: Callable[[Map], object]) -> None:
    executed: set[str] = set()
    file = walked.database
    assert isinstance(file, MapFile) and file._writer is not None and len(walked.snapshot()) == 11
    connections = [file._writer, *file._idle]
    assert len(connections) >= 2
    for one in connections:
        one.set_trace_callback(executed.add)
    action(walked)
    for one in connections:
        one.set_trace_callback(None)
    assert executed
    for statement in executed:
        for line in plan_of(file._writer, statement):
            assert not re.search(rf"SCAN ({LARGE})\b", line), (line, statement)
            assert not re.search(rf"\b({LARGE}) USING .*\(map=\?\)", line), (line, statement)


def plan_of(connection: sqlite3.Connection, statement: str) -> list[str]:
    if statement.split()[0] not in ("SELECT", "INSERT", "UPDATE", "DELETE"):
        return []
    return [line for *_, line in connection.execute(f"EXPLAIN QUERY PLAN {statement}")]
