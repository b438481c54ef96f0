"""Events of maps: messages to the listeners of a map about changes of the map itself."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

from core.store import Map
from service.engine.engine import Engine
from service.events.schemas import MapEvent


def tell_map(
    engine: Engine, map_: Map, change: Literal["edited", "calibrated", "cameras"], fields: Sequence[str] = ()
) -> None:
    """Tell the listeners of a map, if it has any, that it was changed.

    Args:
        fields: the settings that were edited.
    """
    record = map_.record
    if engine.events.heard(record.id):
        engine.events.publish(MapEvent.now(record.id, change=change, fields=list(fields), revision=record.revision))


def tell_end(engine: Engine, map_id: str) -> None:
    """Tell the listeners of a map that it was deleted, and end their streams."""
    if engine.events.heard(map_id):
        engine.events.publish(MapEvent.now(map_id, change="deleted", revision=None))
        engine.events.end(map_id)
