from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest

from core.places import PlaceFields, Pose
from core.storage import Map
from core.storage.database import columns
from core.storage.database.columns import read_columns
from tests.core.storage.frames import frame

FIELDS = [
    PlaceFields(),
    PlaceFields(
        pose=Pose(x=1.5, y=-2), sequence="monday", timestamp=datetime(2026, 11, 20, 18, 30, 0, 250, tzinfo=UTC)
    ),
    PlaceFields(pose=Pose(x=-1e9, y=0, z=3.25, heading=359.5), sequence="tuesday"),
    PlaceFields(pose=Pose(latitude=48.8566, longitude=2.3522, heading=12), sequence="monday"),
    PlaceFields(pose=Pose(latitude=-90, longitude=180), timestamp=datetime(1, 1, 1, tzinfo=UTC)),
]


@pytest.mark.parametrize("at_once", [2, 65_536])
def test_columns_are_what_the_map_knew_when_it_was_written(
    lab: Map, at_once: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(columns, "_AT_ONCE", at_once)
    lab.enrol([replace(frame(f"p{i}"), fields=fields) for i, fields in enumerate(FIELDS)])
    lab.forget("p0")
    with lab._reading() as connection:
        found = read_columns(connection, 5)
    assert sorted(found.rows.tolist()) == [1, 2, 3, 4]
    known = lab.snapshot().whereabouts.take(found.rows)
    for name, column in vars(found.whereabouts).items():
        assert column.dtype == getattr(known, name).dtype
        np.testing.assert_allclose(column, getattr(known, name), rtol=1e-15, atol=1e-8)
    named = np.concatenate([segment.checksums for segment in lab.snapshot().segments])
    np.testing.assert_array_equal(found.checksums, named[found.rows])


def test_of_an_empty_map(lab: Map) -> None:
    with lab._reading() as connection:
        found = read_columns(connection, 0)
    assert (len(found.rows), len(found.whereabouts), found.whereabouts.position.shape) == (0, 0, (0, 3))
