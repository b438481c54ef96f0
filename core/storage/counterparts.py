"""The stations at which places of other traverses show the same, as alignment found them, and the poses handed over."""

from __future__ import annotations

import sqlite3
from collections.abc import Mapping

from core.maps.counterparts import Correspondence, Standing, brought_over, changes_by
from core.storage.cameras import Access
from core.storage.database import ledger
from core.storage.writing import Write


class Counterparts:
    """Reads and writes where the places of one map have counterparts.  Any thread may use it.

    Every method may raise what ``reading`` and ``writing`` raise.

    Args:
        reading, writing: open a connection to the map's database, and begin a write to the map.
    """

    def __init__(self, reading: Access[sqlite3.Connection], writing: Access[Write]) -> None:
        self._reading, self._writing = reading, writing

    def handed_over(self) -> dict[int, str]:
        """The rows of the places whose pose was handed over, each with the id of the place that it comes from."""
        with self._reading() as connection:
            return dict(connection.execute("SELECT row, pose_of FROM places WHERE pose_of IS NOT NULL").fetchall())

    def store(self, change: Correspondence) -> None:
        """Store stations and poses, all of them in one COMMIT or, if this raises, none.

        Rows whose place is gone are left out.  Hold the map's writes (``Transfer.paused_writes``) from the decision
        on if none may be.
        """
        if not change.rows:
            return
        with self._writing() as write:
            found = ledger.stored_at(write.connection, [*change.rows, *change.givers])
            for stored, track, station, pose, pose_of in changes_by(change, found):
                write.set_counterpart(stored, track, station, pose, pose_of)

    def copy(self, other: Counterparts, names: Mapping[str, str]) -> None:
        """Bring places that were copied from another map to the stations that they have there, in one COMMIT.

        A station is derived from the nearest frame of its track that both maps have.  If they have none, as where the
        sequence is gone, the places on the track come to a new one, which no sequence has.

        Args:
            other: of the map from which they were copied.
            names: the ids of the copied places in this map, by their ids in the other.
        """
        with other._reading() as connection:
            there = _standings(connection)
        with self._writing() as write:
            here = _standings(write.connection)
            changes = brought_over(there, here, names, lambda: ledger.new_track(write.connection))
            for place_id, track, station, pose_of in changes:
                stored = ledger.expect(write.connection, place_id)
                write.set_counterpart(stored, track, station, stored.place.pose, pose_of)


def _standings(connection: sqlite3.Connection) -> dict[str, Standing]:
    query = "SELECT id, digest, sequence, ordinal, track, station, pose_of FROM places ORDER BY number"
    return {values[0]: Standing(*values) for values in connection.execute(query)}
