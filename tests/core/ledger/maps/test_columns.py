from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest
from sqlalchemy import bindparam, update

from core.ledger import Statement
from core.ledger.maps import columns
from core.ledger.maps.checksums import DamagedRow
from core.ledger.maps.columns import read_columns
from core.ledger.maps.schema import PLACES
from core.places import GEOGRAPHIC, METRIC, NO_POSE, NO_SEQUENCE, NO_TIME, PlaceFields, Pose, microseconds
from core.store import Map
from tests.core.maps.mixed import both_kinds
from tests.core.store.frames import frame

FIELDS = [
    PlaceFields(),
    PlaceFields(
        pose=Pose(x=1.5, y=-2), sequence="monday", timestamp=datetime(2026, 11, 20, 18, 30, 0, 250, tzinfo=UTC)
    ),
    PlaceFields(pose=Pose(x=-1e9, y=0, z=3.25, heading=359.5), sequence="tuesday"),
    PlaceFields(pose=Pose(latitude=48.8566, longitude=2.3522, heading=12), sequence="monday"),
    PlaceFields(pose=Pose(latitude=-90, longitude=180), timestamp=datetime(1, 1, 1, tzinfo=UTC)),
]
KINDS = {"metric": METRIC, "geographic": GEOGRAPHIC}


@pytest.mark.parametrize("at_once", [2, 65_536])
def test_columns_are_the_fields_of_the_places(lab: Map, at_once: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(columns, "_AT_ONCE", at_once)
    with both_kinds():
        lab.enrol([replace(frame(f"p{i}"), fields=fields) for i, fields in enumerate(FIELDS)])
    lab.forget("p0")
    with lab._transaction() as connection:
        found = read_columns(connection, 5)
    order = np.argsort(found.rows)
    assert found.rows[order].tolist() == [1, 2, 3, 4]
    there = found.whereabouts.take(order)
    assert there.sequence.tolist() == [0, 1, 0, NO_SEQUENCE] and there.ordinal.tolist() == [0, 0, 1, 1]
    assert (there.track.tolist(), there.station.tolist()) == (there.sequence.tolist(), there.ordinal.tolist())
    for at, fields in enumerate(FIELDS[1:]):
        pose, moment = fields.pose, fields.timestamp
        assert there.kind[at] == (NO_POSE if pose is None else KINDS[pose.kind()])
        assert there.timestamp[at] == (NO_TIME if moment is None else microseconds(moment))
        assert pose is not None
        np.testing.assert_allclose(there.position[at], pose.position(), rtol=1e-15, atol=1e-8)
        np.testing.assert_array_equal(there.heading[at], np.float32(np.nan if pose.heading is None else pose.heading))


def test_of_an_empty_map(lab: Map) -> None:
    with lab._transaction() as connection:
        found = read_columns(connection, 0)
    assert (len(found.rows), len(found.whereabouts), found.whereabouts.position.shape) == (0, 0, (0, 3))


@pytest.mark.parametrize(
    ("column", "value", "error"),
    [("x", None, ValueError), ("latitude", 3.5, ValueError), ("row", 77, DamagedRow)],
)
def test_values_that_no_place_has_are_damage(
    lab: Map, column: str, value: float | None, error: type[Exception]
) -> None:
    lab.enrol([frame("p0", x=1.0), frame("p1", x=2.0)])
    spoil = Statement(
        update(PLACES)
        .where(PLACES.c.map == bindparam("map"), PLACES.c.id == bindparam("which"))
        .values({column: bindparam("value")})
    )
    with lab._transaction() as connection:
        connection.change(spoil, which="p1", value=value)
        with pytest.raises(error):
            read_columns(connection, 2)
