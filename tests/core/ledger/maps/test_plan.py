"""The plan of a map is the same in either database."""

from __future__ import annotations

import json
from datetime import UTC, datetime
from typing import Any

from core.ledger.maps.plan import HANDED_OVER, HAS_PICTURE
from core.maps.counterparts import Correspondence
from core.places import PlaceFields, Pose
from core.store import Map
from tests.core.maps.mixed import both_kinds
from tests.core.store.frames import frame


def plan_of(lab: Map, step: int = 1) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(f"{{{lab.plan.columns(step)}}}")
    return found


def test_of_an_empty_map(lab: Map) -> None:
    assert plan_of(lab) == {
        "sequences": [], "ids": [], "sequence": [], "x": None, "y": None, "z": None, "latitude": None,
        "longitude": None, "heading": None, "timestamp": None, "flags": [],
    }  # fmt: skip


def test_the_columns_are_those_of_the_places(lab: Map) -> None:
    moment = datetime(2026, 11, 20, 10, 0, 0, 125_499, tzinfo=UTC)
    before = datetime(1969, 12, 31, 23, 59, 59, 999_000, tzinfo=UTC)
    lab.enrol([frame("p0", sequence="tuesday", timestamp=moment), frame("p1", sequence="Ünter")])
    lab.enrol([frame("p2"), frame("p3")])
    lab.set_fields("p0", lab.place("p0").fields().model_copy(update={"pose": Pose(x=1.23456, y=-2, heading=359.999)}))
    geographic = PlaceFields(pose=Pose(latitude=48.12345678, longitude=-11.5), sequence="Ünter", timestamp=before)
    with both_kinds():
        lab.set_fields("p1", geographic)
    lab.edit({"keep": "none"})
    lab.enrol([frame("p2", "another")])
    lab.counterparts.store(Correspondence({3: (0, 0)}, {3: 0}))
    assert plan_of(lab) == {
        "sequences": ["tuesday", "Ünter"],
        "ids": ["p0", "p1", "p2", "p3"],
        "sequence": [0, 1, -1, -1],
        "x": [1.235, None, None, 1.235],
        "y": [-2.0, None, None, -2.0],
        "z": None,
        "latitude": [None, 48.1234568, None, None],
        "longitude": [None, -11.5, None, None],
        "heading": [360.0, None, None, 360.0],
        "timestamp": [round(1e3 * moment.timestamp()), -1, None, None],
        "flags": [HAS_PICTURE, HAS_PICTURE, 0, HAS_PICTURE + HANDED_OVER],
    }
    assert plan_of(lab, 3)["ids"] == ["p0", "p3"]
