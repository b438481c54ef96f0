"""Places found by metadata: against a walk over all places, through every kind of write."""

from __future__ import annotations

import secrets
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from sqlalchemy import bindparam, delete, insert

from core.ledger import Statement
from core.ledger.maps import places
from core.ledger.maps.connection import MapConnection
from core.ledger.maps.places import LONGEST_TEXT, token_of
from core.ledger.maps.schema import TOKENS
from core.ledger.postgres import PostgresConnection
from core.ledger.sqlite import SqliteConnection
from core.maps.place_filter import PlaceFilter, Scalar
from core.places import PlaceFields
from core.store import Map, Store
from tests.core.store.frames import DIMENSION, ENCODER, LOCAL_SHAPE, frame

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


def equal(a: Any, b: Any) -> bool:
    return a == b and isinstance(a, bool) == isinstance(b, bool) and (a is None) == (b is None)


def by_walking(lab: Map, where: dict[str, Scalar]) -> list[str]:
    found, _ = lab.places(None, 1000)
    return sorted(
        place.id
        for place in found
        if all(key in place.metadata and equal(place.metadata[key], value) for key, value in where.items())
    )


def rows_with(lab: Map, where: dict[str, Scalar], rows: Any = None) -> list[int]:
    with lab._transaction() as connection:
        return places.rows_with(connection, where, rows).tolist()


def by_index(lab: Map, where: dict[str, Scalar]) -> list[str]:
    rows = rows_with(lab, where)
    assert rows == sorted(rows)
    return sorted(place.id for place in lab.places_at(rows) if place is not None)


@pytest.mark.thorough
@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.lists(st.tuples(st.integers(0, 5), st.sampled_from(["enrol", "fields", "forget"]), objects), max_size=12),
    st.dictionaries(st.sampled_from(["floor", "light", "ä b", "other"]), scalars, min_size=1, max_size=2),
)
def test_whatever_was_written(
    store: Store, monkeypatch: pytest.MonkeyPatch, steps: list[tuple[int, str, dict[str, Any]]], where: Any
) -> None:
    lab = store.create(f"lab-{secrets.token_hex(8)}", ENCODER, DIMENSION, local_shape=LOCAL_SHAPE)
    try:
        for count, (number, action, metadata) in enumerate(steps):
            place_id = f"p{number}"
            there = lab.digest(place_id) is not None
            if action == "enrol":
                lab.enrol([frame(place_id, f"picture {count}", metadata=metadata)])
            elif there and action == "fields":
                lab.set_fields(place_id, PlaceFields(metadata=metadata))
            elif there:
                lab.forget(place_id)
        assert by_index(lab, where) == by_walking(lab, where) == sorted(lab.ids_of(PlaceFilter(metadata=where), 99))
        every = rows_with(lab, where)
        some = np.arange(0, 40, 2)
        for few in (0, 5000):  # read all rows with a value, or look some up one by one
            monkeypatch.setattr(places, "FEW", few)
            assert rows_with(lab, where, some) == np.intersect1d(every, some).tolist()
        with lab._transaction() as connection:
            assert places.stale_tokens(connection) == []
    finally:
        monkeypatch.undo()


def test_kinds_of_values(lab: Map) -> None:
    values: list[Any] = [1, 1.0, True, "1", None, 0, False, "", 10**30, [1], {"a": 1}, "x" * (LONGEST_TEXT + 1)]
    lab.enrol([frame(f"p{i}", metadata={"v": value}) for i, value in enumerate(values)])
    expected: list[tuple[Scalar, list[str]]] = [
        (1, ["p0", "p1"]), (True, ["p2"]), ("1", ["p3"]), (None, ["p4"]), (0.0, ["p5"]), (False, ["p6"]), ("", ["p7"]),
        (10**30, ["p8"]), (1e30, []), ("x" * (LONGEST_TEXT + 1), []),
    ]  # fmt: skip
    for value, found in expected:
        assert by_index(lab, {"v": value}) == found, value
    assert by_index(lab, {"w": None}) == []


def test_values_of_other_maps_and_of_places_that_are_gone_are_not_found(lab: Map) -> None:
    assert by_index(lab, {"v": 1}) == []  # as the places of the other map have
    lab.enrol([frame(f"q{i}", metadata={"v": 1}, sequence="monday" if i % 2 else "tuesday") for i in range(6)])
    lab.forget_sequence("monday")
    assert by_index(lab, {"v": 1}) == ["q0", "q2", "q4"]
    lab.set_fields("q0", PlaceFields(metadata={"v": 2}))
    assert by_index(lab, {"v": 1}) == ["q2", "q4"]
    lab.enrol([frame("q2", "another picture", metadata={"v": 1})])
    assert rows_with(lab, {"v": 1}) == [4, 6]


PUT = Statement(insert(TOKENS).values({name: bindparam(name) for name in ("map", "token", "row")}))
DELETE = Statement(delete(TOKENS).where(TOKENS.c.map == bindparam("map"), TOKENS.c.row == bindparam("which")))


def test_an_index_that_is_wrong_is_noticed_and_made_again(lab: Map) -> None:
    lab.enrol([frame(f"q{i}", metadata={"floor": i, "note": "a"}) for i in range(3)])
    with lab._transaction() as connection:
        assert places.stale_tokens(connection) == []
        connection.execute(PUT, token=token_of("floor", 7), row=1)
        connection.execute(DELETE, which=2)
        assert places.stale_tokens(connection) == [
            f"row {row} is not indexed correctly by its metadata" for row in (1, 2, 2)
        ]
        places.rebuild_tokens(connection)
        assert places.stale_tokens(connection) == []
    assert rows_with(lab, {"floor": 7}) == []
    assert rows_with(lab, {"note": "a"}) == [0, 1, 2]


def test_a_look_up_reads_the_index_alone(connection: MapConnection) -> None:
    for statement, values in ((places._ROWS_WITH, {}), (places._ROWS_WITH_AMONG, {"rows": [1, 2]})):
        plan = explained(connection, statement, token="0", **values)
        assert "tokens" in plan and "places" not in plan
        assert "SCAN tokens" not in plan and "Seq Scan" not in plan, plan


def explained(connection: MapConnection, statement: Statement, **values: Any) -> str:
    """How the database executes a statement, in its own words."""
    whole = connection.whole
    compiled = statement.compiled(whole.dialect)
    given = compiled.values({"map": connection.map, **values})
    if isinstance(whole, SqliteConnection):
        return " ".join(row[3] for row in whole.driver.execute(f"EXPLAIN QUERY PLAN {compiled.text}", given))
    assert isinstance(whole, PostgresConnection)
    whole.driver.execute("SET LOCAL enable_seqscan TO off")  # of the few rows of a test
    return " ".join(line for (line,) in whole.driver.execute(f"EXPLAIN {compiled.text}", given))
