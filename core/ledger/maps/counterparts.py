"""The stations at which places of other traverses show the same, as alignment found them, and the poses handed over."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager

from core.ledger.maps import places, sequences
from core.ledger.maps.connection import Reading
from core.ledger.maps.writing import Write
from core.maps.counterparts import Correspondence, brought_over, changes_by


class Counterparts:
    """Reads and writes where the places of one map have counterparts in other traverses.

    Any thread may use it.  Every method may raise what ``reading`` and ``writing`` raise.

    Args:
        reading, writing: begin a transaction that reads the map, and a write to it.
    """

    def __init__(self, reading: Reading, writing: Callable[[], AbstractContextManager[Write]]) -> None:
        self._reading, self._writing = reading, writing

    def handed_over(self) -> dict[int, str]:
        """The rows of places and looks whose pose was handed over, each with the id of the place that it comes from."""
        with self._reading() as connection:
            return places.handed_over(connection)

    def store(self, change: Correspondence) -> None:
        """Store stations and poses, all of them or, if this raises, none.

        Rows whose place is gone are left out.  Hold the map's writes (``Transfer.paused_writes``) from the decision
        on if none may be.
        """
        if not change.rows:
            return
        with self._writing() as write:
            found = places.at_rows(write.connection, [*change.rows, *change.givers])
            for stored, track, station, pose, pose_of in changes_by(change, found):
                if stored.look_of is not None:  # it follows its place
                    continue
                write.set_counterpart(stored, track, station, pose, pose_of)

    def copy(self, other: Counterparts, names: Mapping[str, str]) -> None:
        """Bring places that were copied from another map to the stations that they have there, in one write.

        A station is derived from the nearest frame of its track that both maps have.  If they have none, as where the
        sequence is gone, the places on the track come to a new one, which no sequence has.

        Args:
            other: the counterparts of the map from which they were copied, of the same store.
            names: the ids of the copied places in this map, by their ids in the other.
        """
        with other._reading() as connection:
            there = places.stations(connection)
        with self._writing() as write:
            here = places.stations(write.connection)
            changes = brought_over(there, here, names, lambda: sequences.new_code(write.connection))
            for place_id, track, station, pose_of in changes:
                stored = places.expect(write.connection, place_id)
                write.set_counterpart(stored, track, station, stored.place.pose, pose_of)
