"""The stations at which places of other traverses show the same, as alignment found them, and the poses handed over."""

from __future__ import annotations

import sqlite3
from bisect import bisect_left
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from core.places import NO_SEQUENCE
from core.storage.cameras import Access
from core.storage.database import ledger
from core.storage.writing import Write


@dataclass(frozen=True)
class Correspondence:
    """What changes in a map with what an alignment found; everything is named by its row.

    stations: the new track and station of places (``Whereabouts``).
    poses: for places that get a pose, the place whose pose it is; None for those that lose the pose that they got.
    """

    stations: Mapping[int, tuple[int, int]] = field(default_factory=dict)
    poses: Mapping[int, int | None] = field(default_factory=dict)


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
        rows = sorted({*change.stations, *change.poses})
        if not rows:
            return
        with self._writing() as write:
            givers = {giver for giver in change.poses.values() if giver is not None}
            found = ledger.stored_at(write.connection, [*rows, *givers])
            for row in rows:
                if (stored := found.get(row)) is None:
                    continue
                track, station = change.stations.get(row, (stored.track, stored.station))
                pose, pose_of = stored.place.pose, stored.place.pose_of
                if row in change.poses:
                    giver = change.poses[row]
                    source = None if giver is None else found.get(giver)
                    pose = None if source is None else source.place.pose
                    pose_of = None if source is None else source.place.id
                write.set_counterpart(stored, track, station, pose, pose_of)

    def copy(self, other: Counterparts, names: Mapping[str, str]) -> None:
        """Bring places that were copied from another map to the stations that they have there, in one COMMIT.

        A station is told by the nearest frame of its track that both maps have.  If they have none, as where the
        sequence is gone, the places on the track come to a new one, which no sequence has.

        Args:
            other: of the map from which they were copied.
            names: the ids of the copied places in this map, by their ids in the other.
        """
        with other._reading() as connection:
            there = _standings(connection)
        with self._writing() as write:
            here = _standings(write.connection)
            twins = {
                place.id: twin
                for place in there.values()
                if (twin := here.get(names.get(place.id, place.id))) is not None and twin.digest == place.digest
            }
            copied = [place for place in there.values() if place.id in names and place.id in twins]
            frames: dict[int, list[tuple[int, _Standing]]] = {p.track: [] for p in copied if p.track is not None}
            for place in sorted((there[name] for name in twins), key=lambda place: place.ordinal):
                if place.sequence in frames and twins[place.id].sequence != NO_SEQUENCE:
                    frames[place.sequence].append((place.ordinal, twins[place.id]))
            lost = {track: ledger.new_track(write.connection) for track, known in frames.items() if not known}
            for place in copied:
                track, station, pose_of = place.track, place.station, place.pose_of
                if track is not None and station is not None:
                    track, station = (lost[track], station) if track in lost else _told_by(frames[track], station)
                if pose_of is not None:
                    # The pose of a place that is not here is the place's own.
                    pose_of = twins[pose_of].id if pose_of in twins else None
                twin = twins[place.id]
                if (twin.track, twin.station, twin.pose_of) != (track, station, pose_of):
                    stored = ledger.expect(write.connection, twin.id)
                    write.set_counterpart(stored, track, station, stored.place.pose, pose_of)


@dataclass(frozen=True)
class _Standing:
    """Where a place is along its sequence and its track, and whose pose it has."""

    id: str
    digest: bytes
    sequence: int
    ordinal: int
    track: int | None
    station: int | None
    pose_of: str | None


def _standings(connection: sqlite3.Connection) -> dict[str, _Standing]:
    query = "SELECT id, digest, sequence, ordinal, track, station, pose_of FROM places ORDER BY number"
    return {values[0]: _Standing(*values) for values in connection.execute(query)}


def _told_by(frames: Sequence[tuple[int, _Standing]], station: int) -> tuple[int, int]:
    """Track and station here of a station in another map.

    Args:
        frames: of the track: their ordinals in the other map, ascending, and what they are here; at least one.
    """
    behind = bisect_left(frames, station, key=lambda frame: frame[0])
    ordinal, twin = min(frames[max(0, behind - 1) : behind + 1], key=lambda frame: abs(frame[0] - station))
    if ordinal == station and twin.track is not None and twin.station is not None:
        return twin.track, twin.station
    return twin.sequence, twin.ordinal + station - ordinal
