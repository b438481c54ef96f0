"""Places found by metadata and by sequence: against a walk over all places, through every kind of write."""

from __future__ import annotations

import sqlite3
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from core.ledger.maps.places import LONGEST_TEXT
from core.maps import Enrolment
from core.maps.place_filter import Scalar
from core.places import PlaceFields, Pose
from core.storage import Atlas, Map
from core.storage.database.connections import FILE
from tests.core.storage import frames

DIMENSION = 4

scalars = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-3, 3),
    st.sampled_from([0.5, 1.0, 2.0]),
    st.sampled_from(["", "a", "1", "x" * 3]),
)
objects = st.dictionaries(
    st.sampled_from(["floor", "light", "ä b"]), st.one_of(scalars, st.lists(st.integers(), max_size=1))
)


@pytest.fixture
def atlas(tmp_path: Path) -> Any:
    opened = Atlas(tmp_path, rows_per_segment=4)
    yield opened
    opened.close()


def enrolment(place_id: str, number: int, metadata: dict[str, Any], sequence: str | None = None) -> Enrolment:
    descriptor = np.random.default_rng(number).normal(size=DIMENSION).astype(np.float32)
    fields = PlaceFields(pose=Pose(x=number, y=0), sequence=sequence, metadata=metadata)
    return Enrolment(place_id, fields, descriptor, 5, number.to_bytes(32, "big"))


def equal(a: Any, b: Any) -> bool:
    return a == b and isinstance(a, bool) == isinstance(b, bool) and (a is None) == (b is None)


def by_walking(lab: Map, where: dict[str, Scalar]) -> list[str]:
    places, _ = lab.places(None, 1000)
    return sorted(
        place.id
        for place in places
        if all(key in place.metadata and equal(place.metadata[key], value) for key, value in where.items())
    )


def by_index(lab: Map, where: dict[str, Scalar]) -> list[str]:
    rows = lab.attributes.rows_with(where)
    assert rows.tolist() == sorted(rows.tolist())
    return sorted(place.id for place in lab.places_at(rows.tolist()) if place is not None)


@pytest.mark.thorough
@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.lists(st.tuples(st.integers(0, 5), st.sampled_from(["enrol", "fields", "forget"]), objects), max_size=12),
    st.dictionaries(st.sampled_from(["floor", "light", "ä b", "other"]), scalars, min_size=1, max_size=2),
)
def test_whatever_was_written(
    atlas: Atlas, monkeypatch: pytest.MonkeyPatch, steps: list[tuple[int, str, dict[str, Any]]], where: Any
) -> None:
    lab = atlas.create("lab", "test@0", DIMENSION)
    try:
        for count, (number, action, metadata) in enumerate(steps):
            place_id = f"p{number}"
            there = lab.digest(place_id) is not None
            if action == "enrol":
                lab.enrol([enrolment(place_id, 100 + count, metadata)])
            elif there and action == "fields":
                lab.set_fields(place_id, PlaceFields(metadata=metadata))
            elif there:
                lab.forget(place_id)
        assert by_index(lab, where) == by_walking(lab, where)
        every = lab.attributes.rows_with(where)
        some = np.arange(0, 40, 2)
        for few in (0, 5000):  # read all rows with a value, or look some up one by one
            monkeypatch.setattr("core.storage.attributes.FEW", few)
            assert lab.attributes.rows_with(where, some).tolist() == np.intersect1d(every, some).tolist()
    finally:
        monkeypatch.undo()
        atlas.delete("lab")


def test_kinds_of_values(atlas: Atlas) -> None:
    lab = atlas.create("lab", "test@0", DIMENSION)
    values: list[Any] = [1, 1.0, True, "1", None, 0, False, "", 10**30, [1], {"a": 1}, "x" * (LONGEST_TEXT + 1)]
    lab.enrol([enrolment(f"p{i}", i, {"v": value}) for i, value in enumerate(values)])
    expected: list[tuple[Scalar, list[str]]] = [
        (1, ["p0", "p1"]), (True, ["p2"]), ("1", ["p3"]), (None, ["p4"]), (0.0, ["p5"]), (False, ["p6"]), ("", ["p7"]),
        (10**30, ["p8"]),
    ]  # fmt: skip
    for value, places in expected:
        assert by_index(lab, {"v": value}) == places, value
    assert by_index(lab, {"w": None}) == []


def test_the_frame_enrolled_last_is_among_the_last_wherever_its_view_is(atlas: Atlas) -> None:
    lab = atlas.create("lab", frames.ENCODER, frames.DIMENSION, local_shape=frames.LOCAL_SHAPE)
    lab.enrol([frames.frame(f"p{n}", picture, sequence="walk") for n, picture in enumerate("abcdefeed")])
    (code,) = lab.attributes.sequence_codes(["walk"]).values()
    assert [place.ordinal for place in lab.transfer.outline()] == [0, 1, 2, 3, 4, 5, 4, 4, 3]
    assert [lab.attributes.oldest_of_last(code, last) for last in (1, 2, 6, 7)] == [3, 3, 3, 2]


def test_a_forgotten_sequence_is_not_found(atlas: Atlas) -> None:
    lab = atlas.create("lab", "test@0", DIMENSION)
    lab.enrol([enrolment(f"p{i}", i, {"n": 1}, "monday" if i % 2 else "tuesday") for i in range(6)])
    codes = lab.attributes.sequence_codes(["monday", "tuesday", "never"])
    assert set(codes) == {"monday", "tuesday"}
    assert lab.attributes.oldest_of_last(codes["monday"], 2) == 1
    assert lab.attributes.oldest_of_last(codes["monday"], 99) == 0
    assert lab.attributes.oldest_of_last(77, 2) is None
    lab.forget_sequence("monday")
    assert by_index(lab, {"n": 1}) == ["p0", "p2", "p4"]
    assert set(lab.attributes.sequence_codes(["monday", "tuesday"])) == {"tuesday"}


def test_a_look_up_reads_the_index_alone(atlas: Atlas, tmp_path: Path) -> None:
    atlas.create("lab", "test@0", DIMENSION)
    connection = sqlite3.connect(tmp_path / "maps" / "lab" / FILE)
    query = "SELECT row FROM place_values WHERE key = 'a' AND kind = 'number' AND value = 1"
    plan = " ".join(row[3] for row in connection.execute(f"EXPLAIN QUERY PLAN {query}"))
    assert "USING PRIMARY KEY" in plan and "SCAN" not in plan
    connection.close()
