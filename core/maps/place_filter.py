"""Conditions on places, as listings and the deletion of many places at once take them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import datetime

Scalar = str | int | float | bool | None
"""A value of metadata by which places are found."""


@dataclass(frozen=True)
class PlaceFilter:
    """Conditions on a place; all of those that are given have to hold.

    ids: it has one of these ids.
    sequence, camera, level: it belongs to this traverse; this camera took its frame; it is on this storey.
    after, before: it has a timestamp of this time or later; or earlier.
    metadata: its metadata has these values at the top level.  Numbers are compared as numbers (1 equals 1.0), and true
        is not 1.
    """

    ids: tuple[str, ...] | None = None
    sequence: str | None = None
    camera: str | None = None
    level: str | None = None
    after: datetime | None = None
    before: datetime | None = None
    metadata: Mapping[str, Scalar] = field(default_factory=dict)

    def __bool__(self) -> bool:
        return self != EVERY_PLACE


EVERY_PLACE = PlaceFilter()
