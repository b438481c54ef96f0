"""The stations at which places of other traverses show the same, and the poses handed over."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager

from core.maps.counterparts import Correspondence, brought_over, changes_by
from core.milvus import ledger
from core.milvus.parts.cameras import Access
from core.milvus.writing import Write


class MilvusCounterparts:
    """Reads and writes where the places of one map have counterparts (:class:`core.maps.counterparts.Counterparts`).

    Args:
        map_number: of the map.
        reading, writing: begin a transaction that reads the map, and a write to it.
    """

    def __init__(self, map_number: int, reading: Access, writing: Callable[[], AbstractContextManager[Write]]) -> None:
        self._map, self._reading, self._writing = map_number, reading, writing

    def handed_over(self) -> dict[int, str]:
        with self._reading() as connection:
            return ledger.handed_over(connection, self._map)

    def store(self, change: Correspondence) -> None:
        if not change.rows:
            return
        with self._writing() as write:
            named = [*change.rows, *change.givers]
            found = {entry.row: entry for entry in ledger.entries_by(write.connection, self._map, "row", named)}
            for stored, track, station, pose, pose_of in changes_by(change, found):
                write.set_counterpart(stored, track, station, pose, pose_of)

    def copy(self, other: MilvusCounterparts, names: Mapping[str, str]) -> None:
        with other._reading() as connection:
            there = ledger.place_stations(connection, other._map)
        with self._writing() as write:
            here = ledger.place_stations(write.connection, self._map)
            changes = brought_over(there, here, names, lambda: ledger.new_code(write.connection, self._map))
            for place_id, track, station, pose_of in changes:
                stored = write.expect(place_id)
                write.set_counterpart(stored, track, station, stored.place.pose, pose_of)
