"""The stations at which places of other traverses show the same, as alignment found them, and the poses handed over."""

from __future__ import annotations

import sqlite3
from collections.abc import Mapping

from core.maps.counterparts import Correspondence, PlaceStation, brought_over, changes_by
from core.storage.cameras import Access
from core.storage.database import ledger
from core.storage.writing import Write


class Counterparts:
    """Reads and writes where the places of one map have counterparts (:class:`core.maps.counterparts.Counterparts`).

    Any thread may use it.  Every method may raise what ``reading`` and ``writing`` raise.

    Args:
        reading, writing: open a connection to the map's database, and begin a write to the map.
    """

    def __init__(self, reading: Access[sqlite3.Connection], writing: Access[Write]) -> None:
        self._reading, self._writing = reading, writing

    def handed_over(self) -> dict[int, str]:
        with self._reading() as connection:
            return dict(connection.execute("SELECT row, pose_of FROM places WHERE pose_of IS NOT NULL").fetchall())

    def store(self, change: Correspondence) -> None:
        if not change.rows:
            return
        with self._writing() as write:
            found = ledger.stored_at(write.connection, [*change.rows, *change.givers])
            for stored, track, station, pose, pose_of in changes_by(change, found):
                write.set_counterpart(stored, track, station, pose, pose_of)

    def copy(self, other: Counterparts, names: Mapping[str, str]) -> None:
        with other._reading() as connection:
            there = _place_stations(connection)
        with self._writing() as write:
            here = _place_stations(write.connection)
            changes = brought_over(there, here, names, lambda: ledger.new_track(write.connection))
            for place_id, track, station, pose_of in changes:
                stored = ledger.expect(write.connection, place_id)
                write.set_counterpart(stored, track, station, stored.place.pose, pose_of)


def _place_stations(connection: sqlite3.Connection) -> dict[str, PlaceStation]:
    query = "SELECT id, digest, sequence, ordinal, track, station, pose_of FROM places ORDER BY number"
    return {values[0]: PlaceStation(*values) for values in connection.execute(query)}
