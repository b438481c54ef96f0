"""A changed value of any column of a place, a camera or a map's record is noticed, in either database."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

import pytest
from sqlalchemy import Table, bindparam, select, update
from sqlalchemy.types import Float, LargeBinary, String

from core.frames.intrinsics import Intrinsics
from core.frames.masks import Mask
from core.ledger import Statement
from core.ledger.maps import cameras, places, record
from core.ledger.maps.checksums import DamagedRow, sealed_columns
from core.ledger.maps.connection import MapConnection
from core.ledger.maps.schema import CAMERAS, MAPS, METADATA, PLACES
from core.maps.counterparts import Correspondence
from core.places import PlaceFields, Pose
from core.store import Map
from tests.core.ledger.maps.conftest import MOMENT
from tests.core.maps.mixed import both_kinds
from tests.core.store.frames import frame

MASK = Mask(polygons=(((0, 0), (0.25, 0), (0, 0.25)),))
LENS = Intrinsics(width=640, height=480, fx=500.0, fy=500.0, cx=320.0, cy=240.0)


@pytest.fixture
def full(lab: Map) -> Map:
    """Two places and two cameras, with a value in every column of one or the other."""
    lab.cameras.put("front", MASK, LENS, (0, 1023))
    lab.cameras.put("rear", None)
    metre, degree = Pose(x=1.5, y=-0.0, z=0.1, heading=359.5), Pose(latitude=48.8566, longitude=-2.0)
    lab.enrol([frame("p0", timestamp=MOMENT, sequence="Ünter den Linden", camera="front", metadata={"ä": [None, 1.5]})])
    lab.enrol([frame("p1")])
    lab.set_fields("p0", lab.place("p0").fields().model_copy(update={"pose": metre}))
    with both_kinds():
        lab.set_fields("p1", PlaceFields(pose=degree))
    lab.counterparts.store(Correspondence({1: (0, 0)}, {}))
    return lab


def other(table: Table, column: str, value: Any) -> Any:
    """A value that the table takes, and that is not the one there."""
    kind = table.c[column].type
    if column == "picture":
        return "image"
    if isinstance(kind, LargeBinary):
        return bytes([value[0] ^ 1]) + value[1:]
    if isinstance(kind, String):
        return "" if value is None else value + " "
    if isinstance(kind, Float):
        return -5e-324 if value is None else value + 2**-40
    return 77 if value is None else value ^ 1024


def change(connection: MapConnection, table: Table, column: str, row: int) -> None:
    """Change one value of the first or the second row of a table, by key."""
    key = next(iter(table.primary_key.columns)) if table is MAPS else table.c[list(table.primary_key.columns)[1].name]
    of_map = (MAPS.c.number if table is MAPS else table.c.map) == bindparam("map")
    found = connection.execute(Statement(select(key, table.c[column]).where(of_map).order_by(key)))
    which, value = found[row]
    put = Statement(update(table).where(of_map, key == bindparam("which")).values({column: bindparam("changed")}))
    assert connection.change(put, which=which, changed=other(table, column, value)) == 1


@contextmanager
def changed(lab: Map, table: Table, column: str, row: int) -> Iterator[MapConnection]:
    """A transaction in which a value is another one; it is undone."""
    with suppress(_Undone), lab._transaction() as connection:
        change(connection, table, column, row)
        yield connection
        raise _Undone


class _Undone(Exception):
    """Ends a transaction without its changes."""


def cases(table: Table, key: str) -> list[tuple[str, int]]:
    """The columns of a table but that of its key, each with the first and the second row."""
    columns = [column for column in (*sealed_columns(table), "seal") if column != key]
    return [(column, row) for column in columns for row in (0, 1)]


def test_a_changed_value_of_a_place_is_noticed(full: Map) -> None:
    for column, row in cases(PLACES, "number"):
        with changed(full, PLACES, column, row) as connection:
            found = places.unsound(connection)
            assert len(found) == 1 and (found == [f"p{row}"] or column == "id"), column
            if column != "sequence":  # else there is no such sequence, which is noticed in another way
                with pytest.raises(DamagedRow, match="does not match its checksum"):
                    places.listed_with_looks(connection, -1, 10)
    with full._transaction() as connection:
        assert places.unsound(connection) == [] and len(places.listed(connection, -1, 10)) == 2


def test_a_changed_value_of_a_camera_is_noticed(full: Map) -> None:
    for column, row in cases(CAMERAS, "name"):
        name = ("front", "rear")[row]
        with changed(full, CAMERAS, column, row) as connection:
            assert cameras.unsound(connection) == [name], column
            with pytest.raises(DamagedRow, match=f"camera '{name}' does not match its checksum"):
                cameras.read_cameras(connection)
    with full._transaction() as connection:
        known = cameras.read_cameras(connection)
        assert cameras.unsound(connection) == [] and list(known) == ["front", "rear"]
    assert known["front"].settings() == (MASK, LENS, (0, 1023)) and known["rear"].settings() == (None, None, None)


def test_a_changed_record_of_a_map_is_noticed(full: Map) -> None:
    for column, reason in (
        ("record", "does not match its checksum"),
        ("seal", "does not match its checksum"),
        ("id", "it is that of 'lab', not of 'lab '"),
    ):
        with changed(full, MAPS, column, 0) as connection, pytest.raises(DamagedRow, match=reason):
            record.state_of(connection, "lab")
    assert full.record.id == "lab"


def test_a_row_is_sound_whatever_its_number_of_the_map_is() -> None:
    """The same row in an export, in a file and in PostgreSQL has the same checksum."""
    for name in ("places", "cameras"):
        assert {"map", "seal"} & set(sealed_columns(METADATA.tables[name])) == set()
        assert len(sealed_columns(METADATA.tables[name])) == len(METADATA.tables[name].columns) - 2


def test_a_negative_zero_is_a_zero(lab: Map) -> None:
    """SQLite stores -0.0 as 0.0."""
    lab.enrol([frame("p0", x=-0.0)])
    lab.patch("p0", {"pose": {"x": 1, "y": -0.0, "heading": -0.0}})
    with lab._transaction() as connection:
        assert places.unsound(connection) == []
    lab.set_fields("p0", PlaceFields(pose=Pose(x=-0.0, y=-0.0, z=-0.0)))
    assert lab.place("p0").pose == Pose(x=0, y=0, z=0)
