"""Merge patches (RFC 7396) of a place's fields and of a map's record."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pydantic import ValidationError

from core.errors import InvalidField
from core.places import PlaceFields
from core.storage.records import MapRecord, MapSettings

MOST_FAULTS = 10
"""Are told of one at a time; the others are counted."""

MOST_LISTED = 1000
"""Of more not even the first are told: pydantic gives all of them or none."""


def merge_patch(target: Any, patch: Any) -> Any:
    """RFC 7396: objects are merged member by member, null removes, all else replaces.

    Neither argument is changed.
    """
    if not isinstance(patch, Mapping):
        return patch
    merged = dict(target) if isinstance(target, Mapping) else {}
    for name, value in patch.items():
        if value is None:
            merged.pop(name, None)
        else:
            merged[name] = merge_patch(merged.get(name), value)
    return merged


def complaint(error: ValueError) -> str:
    """What is wrong, on one line: the first faults of many."""
    if not isinstance(error, ValidationError):
        return str(error)
    if (count := error.error_count()) > MOST_LISTED:
        return f"{count} values are not what they have to be"
    parts = []
    for fault in error.errors(include_url=False, include_context=False, include_input=False)[:MOST_FAULTS]:
        where = ".".join(str(step) for step in fault["loc"])
        parts.append(f"{where}: {fault['msg']}" if where else fault["msg"])
    if count > MOST_FAULTS:
        parts.append(f"and {count - MOST_FAULTS} more")
    return "; ".join(parts)


def patched_fields(fields: PlaceFields, changes: Mapping[str, Any]) -> PlaceFields:
    """``fields`` after a merge patch.

    Raises:
        InvalidField: the result is not what a place may have, or the patch is no object.
    """
    if not isinstance(changes, Mapping):
        raise InvalidField("A patch is a JSON object.")
    if "camera" in changes:
        raise InvalidField("The camera of a place cannot be changed: send its frame again.")
    document = fields.model_dump(include=set(PlaceFields.model_fields), exclude={"pose"})
    if fields.pose is not None:
        document["pose"] = fields.pose.model_dump(exclude_none=True)
    try:
        return PlaceFields.model_validate(merge_patch(document, changes))
    except ValidationError as error:
        raise InvalidField(f"The place cannot be changed so: {complaint(error)}.") from error
    except RecursionError as error:
        raise InvalidField("The patch is nested too deeply.") from error


def patched_record(record: MapRecord, changes: Mapping[str, Any]) -> MapRecord:
    """``record`` with other settings or another calibration (None: that of its encoder).

    Each value given replaces the one before; settings cannot be removed.

    Raises:
        InvalidField: an unknown or fixed field, or a value that it cannot have.
    """
    if not isinstance(changes, Mapping):
        raise InvalidField("The changes of a map are a JSON object.")
    if fixed := set(changes) - set(MapSettings.model_fields) - {"calibration"}:
        raise InvalidField(f"These cannot be changed: {', '.join(sorted(map(str, fixed)))}.")
    try:
        return MapRecord.model_validate({**record.model_dump(), **changes})
    except ValidationError as error:
        raise InvalidField(f"The map cannot be changed so: {complaint(error)}.") from error
