"""Events of enrolment: messages to the listeners of a map about places created, changed or deleted."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from core.maps import Change
from core.places import Place
from core.store import Map
from service.access.audit import ASKER
from service.engine.engine import Engine
from service.events.schemas import ChangedPlace, EnrolmentEvent

MOST_LISTED = 64
"""The largest number of places that an event lists; the others are only counted."""


def tell_enrolment(engine: Engine, map_: Map, stored: Sequence[tuple[Place, Change]]) -> None:
    """Tell the listeners of a map, if it has any, which places of one commit were created or changed."""
    if not engine.events.heard(map_.record.id):
        return
    changed = [
        (place, change if place.look is None else "look-added") for place, change in stored if change != "unchanged"
    ]
    if not changed:
        return
    listed = [
        ChangedPlace(id=place.id, change=change, sequence=place.sequence, pose=place.pose, camera=place.camera)
        for place, change in changed[:MOST_LISTED]
    ]
    unchanged = len(stored) - len(changed)
    counts = Counter(change for _, change in changed) + Counter({"unchanged": unchanged})
    _tell(engine, map_, dict(counts), listed)


def tell_change(engine: Engine, map_: Map, change: str, count: int, sequence: str | None = None) -> None:
    """Tell the listeners of a map, if it has any, that ``count`` places were changed at once, such as deleted.

    Args:
        sequence: the traverse whose places they were, if it was changed as a whole.
    """
    if count and engine.events.heard(map_.record.id):
        _tell(engine, map_, {change: count}, [], sequence)


def tell_deletion(engine: Engine, map_: Map, place_id: str) -> None:
    """Tell the listeners of a map, if it has any, that a place was deleted."""
    if engine.events.heard(map_.record.id):
        gone = ChangedPlace(id=place_id, change="deleted", sequence=None, pose=None, camera=None)
        _tell(engine, map_, {"deleted": 1}, [gone])


def _tell(
    engine: Engine, map_: Map, changes: dict[str, int], places: list[ChangedPlace], sequence: str | None = None
) -> None:
    event = EnrolmentEvent.now(
        map_.record.id,
        operation=ASKER.get().operation,
        changes=changes,
        places=places,
        sequence=sequence,
        total=map_.count_places(),
    )
    engine.events.publish(event)
