"""Places that were looked up lately, by row: what a robot is shown again and again is not read again each time.

A place is remembered only as long as nothing is written to the map, so that none is ever seen as it was before.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from core.places import Place

MOST = 1024
"""Places that are remembered of a map …"""

LONGEST = 1000
"""… those whose metadata has more characters never: all together take five megabytes at most."""


class Memo:
    """What was read of a map since its last write.  From any thread."""

    def __init__(self) -> None:
        self._kept: tuple[object, dict[int, Place]] = (object(), {})

    def places(self, state: object, rows: Iterable[int]) -> dict[int, Place]:
        """Those of the places of rows that were read in this state of the map (``Database.state``)."""
        of, places = self._kept
        if of is not state:
            return {}
        found = ((row, places.get(row)) for row in rows)
        return {row: place for row, place in found if place is not None}

    def keep(self, state: object, places: Mapping[int, Place]) -> None:
        """Remember places, which were read after the map was found in this state."""
        small = {row: place for row, place in places.items() if len(str(place.metadata)) <= LONGEST}
        of, kept = self._kept
        if of is not state or len(kept) + len(small) > MOST:
            self._kept = (state, dict(list(small.items())[:MOST]))
        else:
            kept.update(small)
