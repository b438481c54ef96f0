"""Tracks from pairs of frames that show the same place: the track and station of each place.

A place is at a station of a track: at its own ordinal of its own sequence, until alignment finds that it shows what a
frame of another traverse shows.  Then both are at one station, that of the older track, and so is whatever else was at
the other.  Tracks only ever give way to older ones: so it does not matter in which order traverses are aligned, and
stations of one track are never joined, however unevenly the traverses were driven.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from core.places import NO_POSE, NO_SEQUENCE, Whereabouts

Positions = NDArray[np.int64]


def on_its_own(where: Whereabouts, released: NDArray[np.bool_]) -> tuple[NDArray[np.int32], Positions]:
    """Track and station of n places, int32 [n] and int64 [n], of which some, bool [n], return to their own."""
    return (
        np.where(released, where.sequence, where.track).astype(np.int32),
        np.where(released, where.ordinal, where.station).astype(np.int64),
    )


def common_stations(
    track: NDArray[np.int32], station: Positions, pairs: Positions
) -> tuple[NDArray[np.int32], Positions]:
    """Track and station of n places after the places of each pair came to one station.

    Args:
        track, station: int32 [n] and int64 [n], where the places are now; the lower the track, the older.
        pairs: int64 [m, 2], positions of places that show the same, all of them on a track.

    Returns:
        int32 [n] and int64 [n].  Places of a pair that are on one track stay where they are on it.
    """
    if (track[pairs] == NO_SEQUENCE).any():
        raise ValueError("a place without a sequence has no counterpart")
    places = np.stack([track.astype(np.int64), station], axis=1)
    stations, at = np.unique(places, axis=0, return_inverse=True)  # ascending: the oldest track is first
    at = at.reshape(-1)
    older: dict[int, set[int]] = {}
    for low, high in np.sort(at[pairs], axis=1).tolist():
        if stations[low, 0] != stations[high, 0]:
            older.setdefault(high, set()).add(low)
    goes_to = np.arange(len(stations))
    for one in range(len(stations) - 1, -1, -1):
        if one not in older:
            continue
        first = min(older[one])
        goes_to[one] = first
        for other in older[one]:  # what shows the same as one shows the same as the first
            if stations[other, 0] != stations[first, 0]:
                older.setdefault(other, set()).add(first)
    for one in range(len(stations)):
        goes_to[one] = goes_to[goes_to[one]]  # the earlier ones are final by now
    found = stations[goes_to[at]]
    return found[:, 0].astype(np.int32), found[:, 1]


def handed_over(kind: NDArray[np.int8], pairs: Positions) -> Positions:
    """Who gets a pose from whom: pairs of places, int64 [k, 2], the one without a pose and the one that has it.

    A place may hand on what it got, and gets a pose once, from the first of its pairs that can give one.

    Args:
        kind: int8 [n], the kinds of the places' poses (``Whereabouts.kind``).
        pairs: int64 [m, 2], places that show the same, the surest first.
    """
    source = np.where(kind != NO_POSE, np.arange(len(kind)), -1)
    given: list[tuple[int, int]] = []
    while True:
        before = len(given)
        for one, other in pairs.tolist():
            for receiver, giver in ((one, other), (other, one)):
                if source[receiver] < 0 <= source[giver]:
                    source[receiver] = source[giver]
                    given.append((receiver, int(source[giver])))
        if len(given) == before:
            return np.array(given, np.int64).reshape(-1, 2)
