"""The conditions of a listing in SQL."""

from __future__ import annotations

import json
from typing import Any

from core.maps.place_filter import PlaceFilter
from core.maps.stored_fields import moment_text
from core.storage.attributes import WANTED

_HAS_VALUES = (
    "NOT EXISTS (SELECT 1 FROM json_each(?) f WHERE NOT EXISTS (SELECT 1 FROM place_values v WHERE"
    f"{WANTED} AND v.row = p.row))"
)


def conditions(wanted: PlaceFilter) -> dict[str, str]:
    """Conditions in SQL on a place ``p`` of a sequence ``s``, each with one parameter and the value of it."""
    given: dict[str, Any] = {
        "p.id IN (SELECT value FROM json_each(?))": None if wanted.ids is None else json.dumps(wanted.ids),
        "s.name = ?": wanted.sequence,
        "p.camera = ?": wanted.camera,
        "p.timestamp >= ?": wanted.after and moment_text(wanted.after),
        "p.timestamp <= ?": wanted.before and moment_text(wanted.before),
        _HAS_VALUES: json.dumps(dict(wanted.metadata)) if wanted.metadata else None,
    }
    return {condition: value for condition, value in given.items() if value is not None}
