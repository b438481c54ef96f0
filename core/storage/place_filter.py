"""Conditions on places, as listings and the deletion of many places at once take them."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any

from core.storage.attributes import WANTED, Scalar

_HAS_VALUES = (
    "NOT EXISTS (SELECT 1 FROM json_each(?) f WHERE NOT EXISTS (SELECT 1 FROM place_values v WHERE"
    f"{WANTED} AND v.row = p.row))"
)


@dataclass(frozen=True)
class PlaceFilter:
    """Conditions on a place; all of those that are given have to hold.

    ids: it has one of these ids.
    sequence, camera: it belongs to this traverse; this camera took its frame.
    after, before: it has a timestamp of this time or later; or earlier.
    metadata: its metadata has these values at the top level (``Attributes.rows_with`` says how they are compared).
    """

    ids: tuple[str, ...] | None = None
    sequence: str | None = None
    camera: str | None = None
    after: datetime | None = None
    before: datetime | None = None
    metadata: Mapping[str, Scalar] = field(default_factory=dict)

    def __bool__(self) -> bool:
        return bool(self.conditions())

    def conditions(self) -> dict[str, str]:
        """Conditions in SQL on a place ``p`` of a sequence ``s``, each with one parameter and the value of it."""
        given: dict[str, Any] = {
            "p.id IN (SELECT value FROM json_each(?))": None if self.ids is None else json.dumps(self.ids),
            "s.name = ?": self.sequence,
            "p.camera = ?": self.camera,
            "p.timestamp >= ?": _moment(self.after),
            "p.timestamp <= ?": _moment(self.before),
            _HAS_VALUES: json.dumps(dict(self.metadata)) if self.metadata else None,
        }
        return {condition: value for condition, value in given.items() if value is not None}

    def text(self) -> str | None:
        """Text that is the same for the same conditions; None without any but ``sequence``."""
        others = [value for condition, value in self.conditions().items() if condition != "s.name = ?"]
        named = [self.camera is not None, self.after is not None, self.before is not None, *others]
        return json.dumps(named) if others else None


def _moment(moment: datetime | None) -> str | None:
    """A moment as it is stored."""
    return None if moment is None else moment.astimezone(UTC).isoformat(timespec="microseconds")


EVERY_PLACE = PlaceFilter()
