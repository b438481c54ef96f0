from __future__ import annotations

from datetime import UTC, datetime
from typing import Any

import pytest

from core.errors import InvalidField
from core.judgement.verdict import Calibration
from core.maps import MapRecord
from core.maps.records import Outline, merge_patch, patched_fields, patched_record
from core.places import PlaceFields, Pose

# The examples of RFC 7396, appendix A: target, patch, result.
RFC_7396 = [
    ({"a": "b"}, {"a": "c"}, {"a": "c"}),
    ({"a": "b"}, {"b": "c"}, {"a": "b", "b": "c"}),
    ({"a": "b"}, {"a": None}, {}),
    ({"a": "b", "b": "c"}, {"a": None}, {"b": "c"}),
    ({"a": ["b"]}, {"a": "c"}, {"a": "c"}),
    ({"a": "c"}, {"a": ["b"]}, {"a": ["b"]}),
    ({"a": {"b": "c"}}, {"a": {"b": "d", "c": None}}, {"a": {"b": "d"}}),
    ({"a": [{"b": "c"}]}, {"a": [1]}, {"a": [1]}),
    (["a", "b"], ["c", "d"], ["c", "d"]),
    ({"a": "b"}, ["c"], ["c"]),
    ({"a": "foo"}, None, None),
    ({"a": "foo"}, "bar", "bar"),
    ({"e": None}, {"a": 1}, {"e": None, "a": 1}),
    ([1, 2], {"a": "b", "c": None}, {"a": "b"}),
    ({}, {"a": {"bb": {"ccc": None}}}, {"a": {"bb": {}}}),
]


@pytest.mark.parametrize(("target", "patch", "result"), RFC_7396)
def test_the_examples_of_the_standard(target: Any, patch: Any, result: Any) -> None:
    assert merge_patch(target, patch) == result


FIELDS = PlaceFields(
    pose=Pose(x=1, y=2, heading=90),
    timestamp=datetime(2026, 11, 20, tzinfo=UTC),
    sequence="monday",
    metadata={"door": {"open": True}, "note": "x"},
)


def test_an_empty_patch_changes_nothing() -> None:
    assert patched_fields(FIELDS, {}) == FIELDS


def test_members_are_merged_and_null_removes() -> None:
    after = patched_fields(
        FIELDS, {"pose": {"x": 5, "heading": None}, "metadata": {"door": {"open": None}, "n": 1}, "sequence": None}
    )
    assert after.pose == Pose(x=5, y=2)
    assert after.metadata == {"door": {}, "note": "x", "n": 1}
    assert after.sequence is None
    assert after.timestamp == FIELDS.timestamp


def test_all_can_be_removed() -> None:
    nothing = {"pose": None, "timestamp": None, "sequence": None, "metadata": None}
    assert patched_fields(FIELDS, nothing) == PlaceFields()


def test_a_pose_becomes_one_of_the_other_kind_only_as_a_whole() -> None:
    with pytest.raises(InvalidField, match="either"):
        patched_fields(FIELDS, {"pose": {"latitude": 1, "longitude": 2}})
    to_geographic = {"x": None, "y": None, "latitude": 1, "longitude": 2}
    assert patched_fields(FIELDS, {"pose": to_geographic}).pose == Pose(latitude=1, longitude=2, heading=90)


def nested(depth: int) -> dict[str, Any]:
    inner: dict[str, Any] = {}
    for _ in range(depth):
        inner = {"metadata": inner}
    return inner


@pytest.mark.parametrize(
    "changes",
    [
        {"pose": {"x": None}},
        {"pose": 3},
        {"timestamp": "yesterday"},
        {"sequence": "a/b"},
        {"sequence": ""},
        {"metadata": []},
        {"regions": 3},
        {"id": "other"},
        ["no object"],
        nested(5000),
    ],
    ids=range(10),
)
def test_what_a_place_cannot_have_is_refused(changes: Any) -> None:
    with pytest.raises(InvalidField):
        patched_fields(FIELDS, changes)


NOW = datetime(2026, 11, 20, tzinfo=UTC)
RECORD = MapRecord(id="lab", encoder="e@1", dimension=4, precision="half", revision=3, created_at=NOW, updated_at=NOW)
CALIBRATION = Calibration(source="measured", threshold=3.5, margin=0.02, background_mean=0.1, background_deviation=0.02)


def test_settings_and_calibration_of_a_map_can_be_changed() -> None:
    after = patched_record(RECORD, {"description": "x", "keep": "image", "calibration": CALIBRATION.model_dump()})
    assert (after.description, after.keep, after.calibration) == ("x", "image", CALIBRATION)
    assert patched_record(after, {"calibration": None}).calibration is None
    assert patched_record(RECORD, {"calibration": CALIBRATION}).calibration == CALIBRATION


@pytest.mark.parametrize(
    "changes",
    [
        {"id": "other"},
        {"encoder": "other"},
        {"revision": 9},
        {"no such": 1},
        {"description": "x" * 2001},
        {"description": None},
        {"keep": "everything"},
        {"same_place_radius": -1},
        {"same_place_radius": float("nan")},
        {"same_place_frames": 2**40},
        {"calibration": {"threshold": 1}},
        "no object",
    ],
    ids=lambda changes: str(changes)[:40],
)
def test_what_a_map_cannot_have_is_refused(changes: Any) -> None:
    with pytest.raises(InvalidField):
        patched_record(RECORD, changes)


def test_two_states_of_a_place_are_distinguished() -> None:
    one = Outline(1, "a", 0, b"d", "image", None, "monday", 3, "2026")
    assert one.same_as(Outline(9, "a", 7, b"d", "none", None, "monday", 3, "2026")), "numbers and rows are a map's own"
    for other in (
        Outline(1, "a", 0, b"e", "image", None, "monday", 3, "2026"),
        Outline(1, "a", 0, b"d", "image", "front", "monday", 3, "2026"),
        Outline(1, "a", 0, b"d", "image", None, "tuesday", 3, "2026"),
        Outline(1, "a", 0, b"d", "image", None, "monday", 4, "2026"),
        Outline(1, "a", 0, b"d", "image", None, "monday", 3, "2027"),
    ):
        assert not one.same_as(other)
