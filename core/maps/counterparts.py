"""The stations at which places of other traverses show the same, as alignment found them, and the poses handed over."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from core.places import NO_SEQUENCE, Place, Pose, Whereabouts


@dataclass(frozen=True)
class Correspondence:
    """The changes of a map that follow from an alignment; places are given by their rows.

    stations: the new track and station of places (``Whereabouts``).
    poses: for places that get a pose, the place whose pose it is; None for those that lose the pose that they got.
    """

    stations: Mapping[int, tuple[int, int]] = field(default_factory=dict)
    poses: Mapping[int, int | None] = field(default_factory=dict)

    @property
    def rows(self) -> list[int]:
        """The rows of the places that change, ascending."""
        return sorted({*self.stations, *self.poses})

    @property
    def givers(self) -> set[int]:
        """The rows of the places whose poses are handed over."""
        return {giver for giver in self.poses.values() if giver is not None}


class Stored(Protocol):
    """A place as a store has it; its track and station are None where they are its own."""

    @property
    def track(self) -> int | None: ...

    @property
    def station(self) -> int | None: ...

    @property
    def place(self) -> Place: ...


StoredT = TypeVar("StoredT", bound=Stored)


def changes_by(
    change: Correspondence, found: Mapping[int, StoredT]
) -> Iterator[tuple[StoredT, int | None, int | None, Pose | None, str | None]]:
    """The changes of stored places that follow from an alignment; rows without a place are left out.

    Args:
        found: the places of ``change.rows`` and ``change.givers`` by row.

    Yields:
        A place, its track and station, its pose and the id of the place that the pose comes from.
    """
    for row in change.rows:
        if (stored := found.get(row)) is None:
            continue
        track, station = change.stations.get(row, (stored.track, stored.station))
        pose, pose_of = stored.place.pose, stored.place.pose_of
        if row in change.poses:
            giver = change.poses[row]
            source = None if giver is None else found.get(giver)
            pose = None if source is None else source.place.pose
            pose_of = None if source is None else source.place.id
        yield stored, track, station, pose, pose_of


class HandedOver(Protocol):
    """Reads which poses alignment has handed over."""

    def handed_over(self) -> dict[int, str]:
        """The rows of places and looks whose pose was handed over, each with the id of the place that it comes from."""


def own_poses(counterparts: HandedOver, where: Whereabouts, rows: NDArray[np.int64] | None = None) -> Whereabouts:
    """Places with the poses that are their own, which alone are truth: an alignment would prove itself by those that it
    has handed over.

    Args:
        where: of the places.
        rows: int64 [n], their rows; None: those of ``where``, from 0 on.

    Raises:
        StorageFailure.
    """
    handed = np.fromiter(counterparts.handed_over(), np.int64)
    return where.without_poses(np.isin(np.arange(len(where)) if rows is None else rows, handed))


@dataclass(frozen=True)
class PlaceStation:
    """Where a place is along its sequence and its track, and whose pose it has.

    sequence, track: codes; NO_SEQUENCE without a sequence, no track where it is the place's own.
    """

    id: str
    digest: bytes
    sequence: int
    ordinal: int
    track: int | None
    station: int | None
    pose_of: str | None


def brought_over(
    there: Mapping[str, PlaceStation],
    here: Mapping[str, PlaceStation],
    names: Mapping[str, str],
    new_track: Callable[[], int],
) -> Iterator[tuple[str, int | None, int | None, str | None]]:
    """The changes that bring copied places to the stations of the map that they come from (``Counterparts.copy``).

    Args:
        there, here: the places of the other map and of this one, by id, in the order of their enrolment.
        new_track: gives the code of a track that no sequence has or will ever get.

    Yields:
        The id of a place here, its track and station, None for its own, and whose pose it has.
    """
    twins = {
        place.id: twin
        for place in there.values()
        if (twin := here.get(names.get(place.id, place.id))) is not None and twin.digest == place.digest
    }
    copied = [place for place in there.values() if place.id in names and place.id in twins]
    frames: dict[int, list[tuple[int, PlaceStation]]] = {p.track: [] for p in copied if p.track is not None}
    for place in sorted((there[name] for name in twins), key=lambda place: place.ordinal):
        if place.sequence in frames and twins[place.id].sequence != NO_SEQUENCE:
            frames[place.sequence].append((place.ordinal, twins[place.id]))
    lost = {track: new_track() for track, known in frames.items() if not known}
    for place in copied:
        track, station, pose_of = place.track, place.station, place.pose_of
        if track is not None and station is not None:
            track, station = (lost[track], station) if track in lost else _station_here(frames[track], station)
        if pose_of is not None:
            # The pose of a place that is not here is the place's own.
            pose_of = twins[pose_of].id if pose_of in twins else None
        twin = twins[place.id]
        if (twin.track, twin.station, twin.pose_of) != (track, station, pose_of):
            yield twin.id, track, station, pose_of


def _station_here(frames: Sequence[tuple[int, PlaceStation]], station: int) -> tuple[int, int]:
    """Track and station here of a station in another map.

    Args:
        frames: of the track: their ordinals in the other map, ascending, and what they are here; at least one.
    """
    behind = bisect_left(frames, station, key=lambda frame: frame[0])
    ordinal, twin = min(frames[max(0, behind - 1) : behind + 1], key=lambda frame: abs(frame[0] - station))
    if ordinal == station and twin.track is not None and twin.station is not None:
        return twin.track, twin.station
    return twin.sequence, twin.ordinal + station - ordinal
