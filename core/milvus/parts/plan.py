"""A plan of a map: where all its places are, as columns of JSON."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

from core.maps.place_filter import EVERY_PLACE
from core.maps.store import HANDED_OVER, HAS_PICTURE
from core.milvus import ledger
from core.milvus.parts.cameras import Access
from core.places import Pose

_DIGITS = {"x": 3, "y": 3, "z": 3, "latitude": 7, "longitude": 7, "heading": 2}
"""Metres to the millimetre, degrees of position to a centimetre on the ground."""


class MilvusPlan:
    """Reads the plan of one map (:class:`core.maps.store.Plan`).

    Args:
        map_number: of the map.
        reading: begins a transaction that reads the map.
    """

    def __init__(self, map_number: int, reading: Access) -> None:
        self._map, self._reading = map_number, reading

    def columns(self, step: int = 1) -> str:
        """The places in the order of their enrolment as the members of a JSON object, without its braces."""
        with self._reading() as connection:
            entries = ledger.entries_after(connection, self._map, -1, None, EVERY_PLACE)
        places = [entry.place for entry in entries]
        names = sorted({place.sequence for place in places if place.sequence is not None})
        position, shown = {name: at for at, name in enumerate(names)}, places[::step]
        columns: dict[str, Any] = {
            "sequences": names,
            "ids": [place.id for place in shown],
            "sequence": [-1 if place.sequence is None else position[place.sequence] for place in shown],
        }
        poses = [place.pose for place in shown]
        for name, digits in _DIGITS.items():
            columns[name] = _or_none([_rounded(pose, name, digits) for pose in poses])
        moments = [place.timestamp for place in shown]
        columns["timestamp"] = _or_none([None if at is None else round(1000 * at.timestamp()) for at in moments])
        columns["flags"] = [
            (place.pose_of is not None) * HANDED_OVER + (place.picture != "none") * HAS_PICTURE for place in shown
        ]
        return ",".join(f'"{name}":{json.dumps(values, separators=(",", ":"))}' for name, values in columns.items())


def _rounded(pose: Pose | None, name: str, digits: int) -> float | None:
    value: float | None = None if pose is None else getattr(pose, name)
    return None if value is None else round(value, digits)


def _or_none(values: Sequence[float | None]) -> Sequence[float | None] | None:
    return None if all(value is None for value in values) else values
