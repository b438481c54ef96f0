"""The fields of a place as numbers and text, in the form in which every store keeps and compares them."""

from __future__ import annotations

import json
from datetime import UTC, datetime
from typing import Any

from core.errors import InvalidField
from core.places import PlaceFields

DEEPEST_METADATA = 64
"""Most levels of nesting; deeper metadata could be stored but not sent."""

POSE_VALUES = ("x", "y", "z", "latitude", "longitude", "heading")


def moment_text(moment: datetime) -> str:
    """A moment as text in UTC, which sorts by time."""
    return moment.astimezone(UTC).isoformat(timespec="microseconds")


def _is_deep(value: Any) -> bool:
    level = [value]
    for _ in range(DEEPEST_METADATA):
        level = [
            inner
            for outer in level
            if isinstance(outer, dict | list | tuple)
            for inner in (outer.values() if isinstance(outer, dict) else outer)
        ]
    return bool(level)


def metadata_text(metadata: dict[str, Any]) -> str:
    """Metadata as canonical JSON: equal metadata is always the same text.

    Raises:
        InvalidField: it has values that JSON cannot represent (NaN, infinity, other types), or is nested too deeply.
    """
    if _is_deep(metadata):
        raise InvalidField(f"The metadata is nested more than {DEEPEST_METADATA} levels deep.")
    try:
        return json.dumps(metadata, allow_nan=False, sort_keys=True, separators=(",", ":"))
    except (TypeError, ValueError) as error:
        raise InvalidField(f"The metadata cannot be written as JSON: {error}.") from error


def field_columns(fields: PlaceFields) -> dict[str, Any]:
    """The columns of ``places`` that hold a place's fields, except for its sequence.

    Raises:
        InvalidField: the metadata cannot be written as JSON.
    """
    pose: dict[str, float | None] = {name: getattr(fields.pose, name, None) for name in POSE_VALUES}
    # SQLite stores -0.0 as 0.0, which the checksum of a row would distinguish.
    columns: dict[str, Any] = {name: None if value is None else value + 0.0 for name, value in pose.items()}
    columns["timestamp"] = moment_text(fields.timestamp) if fields.timestamp else None
    columns["camera"], columns["level"] = fields.camera, fields.level
    columns["accuracy_metres"] = getattr(fields.pose_accuracy, "metres", None)
    columns["accuracy_degrees"] = getattr(fields.pose_accuracy, "degrees", None)
    columns["metadata"] = metadata_text(fields.metadata)
    return columns


def same_fields(a: PlaceFields, b: PlaceFields) -> bool:
    """Whether two sets of fields are stored in the same way (unlike Python, JSON distinguishes 1 from true)."""
    return a.sequence == b.sequence and field_columns(a) == field_columns(b)
