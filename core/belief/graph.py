"""The places of a map as a graph of ways from one to the next: along their sequences, and from pose to pose.

A belief has one probability for each living place, in the order of this graph: by sequence, and within a sequence by
ordinal, so that "k frames later" is "k entries later".  Frames that show one view, as where a robot stood while it
mapped, are one place of the graph.  Places with poses are also joined to those near them.  Places
of several traverses that were aligned with each other are at one station of a track: they are the same place.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from core.belief.evidence import Evidence
from core.kernels.belief import same_place
from core.places import EARTH_RADIUS, GEOGRAPHIC, METRIC, NO_LEVEL, NO_POSE, NO_SEQUENCE, Neighborhood, Whereabouts

NEAREST = 24
"""A place is joined to at most this many of the nearest places."""

NEAREST_OF_MANY = 8
"""The same in maps of over FULLY_JOINED places."""

FULLY_JOINED = 200_000

ALONG = 4
"""A place is also joined to this many places before and after it in its sequence, however near others are."""

SPACINGS = 3.0
"""The nearest places are looked for within this many times the usual distance of consecutive frames."""


@dataclass(frozen=True, eq=False)
class PlaceGraph:
    """n living places, and which of them are joined.

    rows: int64 [n], the map's row of each place, in the graph's order; of several frames of one view that of the first.
    index: int32 [rows of the map], the place at a row; -1 for a row that is dead or not allowed.
    first, last: int32 [n], the bounds (inclusive, exclusive) of the places of each place's sequence.
    posed: bool [n].
    coordinates: float64 [n, 3], metres east (or along x), north (y), up (z), comparable only between near places.
    shrink: float64 [n], the length at the place of a metre along the first coordinate: the cosine of its latitude.
    heading: float64 [n], radians counter-clockwise from the first coordinate; for places without a heading the
        direction to the next frame of their sequence; NaN if there is neither.
    starts, targets: int64 [n + 1] and int32 [edges]: place i is joined to targets[starts[i]:starts[i + 1]], of which
        it is itself the first.  Places without a pose have no edges.
    spacing: metres between consecutive frames, the median; 0 without poses.
    reach: metres within which neighbours were looked for.
    neighborhood: which places are the same place.
    whereabouts: of the n places, in the graph's order.
    stations: int32 [n], a number for each station of a track: places of several sequences with one number show the
        same.  Empty if no two sequences share a station.
    """

    rows: NDArray[np.int64]
    index: NDArray[np.int32]
    first: NDArray[np.int32]
    last: NDArray[np.int32]
    posed: NDArray[np.bool_]
    coordinates: NDArray[np.float64]
    shrink: NDArray[np.float64]
    heading: NDArray[np.float64]
    starts: NDArray[np.int64]
    targets: NDArray[np.int32]
    spacing: float
    reach: float
    neighborhood: Neighborhood
    whereabouts: Whereabouts
    stations: NDArray[np.int32]

    @cached_property
    def _by_station(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """The places in the order of track and station, and the key of each in that order; int64 [n] each."""
        keys = _station_keys(self.whereabouts.track, self.whereabouts.station)
        order = np.argsort(keys, kind="stable")
        return order, keys[order]

    @property
    def geographic(self) -> bool:
        """Whether the pose of any place is a latitude and longitude."""
        return bool((self.whereabouts.kind == GEOGRAPHIC).any())

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def bytes(self) -> int:
        """Memory of its arrays, in bytes."""
        arrays = (self.rows, self.index, self.first, self.last, self.posed, self.coordinates, self.shrink)
        return sum(array.nbytes for array in (*arrays, self.heading, self.starts, self.targets, self.stations))

    def places_at(self, rows: NDArray[np.int64]) -> NDArray[np.int32]:
        """The places at rows of the map, int32 [k]; -1 for rows without a living place, and for rows added since."""
        inside = (rows >= 0) & (rows < len(self.index))
        found = np.full(len(rows), -1, np.int32)
        found[inside] = self.index[rows[inside]]
        return found

    def counterparts(self, new: PlaceGraph) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Which places of another graph of the map have frames of which places of this one.

        Returns:
            int64 [m, 2], a place of this graph and one of the other; and float64 [m], the share of the former's frames
            that the latter has, of those that are left.
        """
        rows = np.flatnonzero(self.index >= 0)
        there = new.places_at(rows)
        left = there >= 0
        keys = self.index[rows[left]].astype(np.int64) * max(len(new), 1) + there[left]
        pairs, frames = np.unique(keys, return_counts=True)
        old_places, new_places = np.divmod(pairs, max(len(new), 1))
        return np.stack([old_places, new_places], axis=1), frames / np.bincount(old_places, frames)[old_places]

    def evidence_at(self, seen: Evidence) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
        """The places that a frame speaks for, int32 [k], each once, and how much, float32 [k]."""
        places = self.places_at(seen.rows)
        order = np.lexsort((-seen.gains, places))
        order = order[np.diff(places[order], prepend=-1) > 0]  # of several frames of one place the best
        return places[order], seen.gains[order]

    def displacements(self, origin: int, places: NDArray[np.integer]) -> NDArray[np.complex128]:
        """Metres from one place to others in the plane, x + iy, complex128 [k]."""
        apart = self.coordinates[places] - self.coordinates[origin]
        return np.asarray(apart[:, 0] * self.shrink[origin] + 1j * apart[:, 1], np.complex128)

    def same_place(self, place: int) -> NDArray[np.int64]:
        """The places that are the same place as one, itself included; int64 [m], ascending.

        Only places that are joined to it and places beside it in its sequence are considered, so that the time does
        not grow with the map.
        """
        where = self.whereabouts
        found: NDArray[np.int64] = same_place(
            place,
            int(self.first[place]),
            int(self.last[place]),
            self.targets[self.starts[place] : self.starts[place + 1]],
            where.kind,
            where.position,
            where.height,
            where.level,
            where.ordinal,
            self.neighborhood.radius,
            self.neighborhood.frames if where.sequence[place] != NO_SEQUENCE else 0,
            self.neighborhood.height,
        )
        if not len(self.stations) or where.track[place] == NO_SEQUENCE:
            return found
        order, keys = self._by_station
        reach = where.station[place] + np.array([-1, 1]) * self.neighborhood.frames
        low, high = _station_keys(where.track[[place, place]], reach)
        beside = order[np.searchsorted(keys, low) : np.searchsorted(keys, high, side="right")]
        # Two poses of one kind are compared by their distance alone.
        apart = (where.kind[beside] == where.kind[place]) & (where.kind[place] != NO_POSE)
        apart |= where.on_other_levels(beside, place, self.neighborhood.height) & (beside != place)
        return np.union1d(found, beside[~apart])


def _station_keys(track: NDArray[np.int32], station: NDArray[np.int64]) -> NDArray[np.int64]:
    """Numbers that order places by track, then by station; int64 [n]."""
    return (track.astype(np.int64) << 40) + station


def _stations(where: Whereabouts) -> NDArray[np.int32]:
    """A number for each station, int32 [n]; empty if no two sequences share one."""
    if not where.aligned:
        return np.empty(0, np.int32)
    alone = np.flatnonzero(where.track == NO_SEQUENCE)
    keys = _station_keys(where.track, where.station)
    keys[alone] = -1 - np.arange(len(alone)) - (1 << 60)  # a place without a track is at a station of its own
    _, numbers = np.unique(keys, return_inverse=True)
    return numbers.astype(np.int32)


def place_graph(
    whereabouts: Whereabouts, living: NDArray[np.int64], rows: int, neighborhood: Neighborhood
) -> PlaceGraph:
    """Build the graph of a map's living places.

    Args:
        whereabouts: of all rows of the map.
        living: int64 [n], the rows of the places to include.
        rows: number of rows of the map, dead ones included.
        neighborhood: which places are the same place.
    """
    where = whereabouts.take(living)
    order = np.lexsort((where.ordinal, where.sequence))
    living, where = living[order], where.take(order)
    index = np.full(rows, -1, np.int32)
    first_of_view = _first_of_views(where, neighborhood)
    index[living] = (np.cumsum(first_of_view) - 1).astype(np.int32)
    living, where = living[first_of_view], where.take(first_of_view)
    bounds = np.flatnonzero(np.diff(where.sequence)) + 1
    ends = np.concatenate([[0], bounds, [len(living)]]).astype(np.int32)
    lengths = np.diff(ends)
    first, last = np.repeat(ends[:-1], lengths), np.repeat(ends[1:], lengths)
    coordinates, shrink = _plane(where)
    posed = where.kind != NO_POSE
    follows = np.zeros(len(living), np.bool_)  # whether the next entry is the next frame, with a pose of the same kind
    if len(living) > 1:
        follows[:-1] = (first[1:] == first[:-1]) & posed[1:] & (where.kind[1:] == where.kind[:-1])
    steps = np.linalg.norm(np.diff(where.ground, axis=0), axis=1)[follows[:-1]]
    moved = steps[steps > 0]
    spacing = float(np.median(moved)) if len(moved) else 0.0
    reach = max(neighborhood.radius, SPACINGS * spacing)
    heading = _headings(where, coordinates, shrink, follows)
    starts, targets = _edges(where, first, last, reach, neighborhood.height)
    return PlaceGraph(
        rows=living,
        index=index,
        first=first,
        last=last,
        posed=posed,
        coordinates=coordinates,
        shrink=shrink,
        heading=heading,
        starts=starts,
        targets=targets,
        spacing=spacing,
        reach=reach,
        neighborhood=neighborhood,
        whereabouts=where,
        stations=_stations(where),
    )


def _first_of_views(where: Whereabouts, neighborhood: Neighborhood) -> NDArray[np.bool_]:
    """Which of the places, in the order of the graph, are not of one view with the place before them; bool [n].

    Consecutive frames at one position are, unless poses put them farther apart than the radius from the first of them,
    or on another storey.
    """
    together = np.zeros(len(where), np.bool_)
    together[1:] = (
        (where.sequence[1:] == where.sequence[:-1])
        & (where.sequence[1:] != NO_SEQUENCE)
        & (where.ordinal[1:] == where.ordinal[:-1])
        & (where.kind[1:] == where.kind[:-1])
        & (where.track[1:] == where.track[:-1])
        & (where.station[1:] == where.station[:-1])
    )
    first = np.maximum.accumulate(np.where(together, 0, np.arange(len(where))))
    beyond = 0  # the last place that is too far from the first of its view, and so begins another one
    ground = where.ground
    for place in np.flatnonzero(together).tolist():
        start = max(int(first[place]), beyond)
        far = where.kind[place] != NO_POSE and np.linalg.norm(ground[place] - ground[start]) > neighborhood.radius
        if far or where.on_other_levels(place, start, neighborhood.height):
            together[place], beyond = False, place
    return ~together


def _plane(where: Whereabouts) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Coordinates that can be subtracted for near places, and the shrinking of the first of them."""
    coordinates, shrink = where.position.copy(), np.ones(len(where))
    earthly = where.kind == GEOGRAPHIC
    if earthly.any():
        unit = where.position[earthly] / EARTH_RADIUS
        longitude = np.arctan2(unit[:, 1], unit[:, 0])
        middle = np.angle(np.exp(1j * longitude).mean())  # so that the seam at ±180° is opposite the map
        longitude = np.angle(np.exp(1j * (longitude - middle)))
        latitude = np.arcsin(np.clip(unit[:, 2], -1, 1))
        flat = np.stack([longitude, latitude, np.zeros(len(latitude))], axis=1)
        coordinates[earthly] = EARTH_RADIUS * flat
        shrink[earthly] = np.cos(latitude)
    return coordinates, shrink


def _headings(
    where: Whereabouts,
    coordinates: NDArray[np.float64],
    shrink: NDArray[np.float64],
    follows: NDArray[np.bool_],
) -> NDArray[np.float64]:
    """Headings in radians from the first coordinate; the direction to the next frame if none was given."""
    # In metres a heading is counter-clockwise from +x, in degrees clockwise from north.
    given = np.radians(np.where(where.kind == GEOGRAPHIC, 90 - where.heading, where.heading))
    way = np.full(len(where), np.nan)
    here = np.flatnonzero(follows)
    step = coordinates[here + 1] - coordinates[here]
    east, north = step[:, 0] * shrink[here], step[:, 1]
    length = np.hypot(east, north)
    clear = length > 0
    way[here[clear]] = np.arctan2(north, east)[clear]
    after = here + 1  # the last frame of a sequence has the direction of the frame before it
    ending = after[np.isnan(way[after])]
    way[ending] = way[ending - 1]
    return np.where(np.isnan(given), way, given)


def _edges(
    where: Whereabouts, first: NDArray[np.int32], last: NDArray[np.int32], reach: float, height: float
) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """The edges: each place is joined to itself, then to those beside it in its sequence and to the nearest.

    The nearest are of its own storey: only a traverse leads from one to another.  Their number is that among the places
    of its level and those of none.
    """
    from scipy.spatial import cKDTree  # here, because it takes long to import

    n = len(where)
    none = np.empty(0, np.int64)
    pairs: list[tuple[NDArray[np.int64], NDArray[np.int64]]] = []
    everywhere = np.arange(n)
    for offset in [*range(-ALONG, 0), *range(1, ALONG + 1)]:
        beside = everywhere + offset
        source = everywhere[(beside >= first) & (beside < last)]
        target = source + offset
        fits = (where.kind[source] != NO_POSE) & (where.kind[source] == where.kind[target])
        pairs.append((source[fits], target[fits]))
    for kind, level in itertools.product((METRIC, GEOGRAPHIC), np.unique(where.level)):
        own = np.flatnonzero((where.kind == kind) & (where.level == level))
        members = np.flatnonzero((where.kind == kind) & (np.isin(where.level, (level, NO_LEVEL)) | (level == NO_LEVEL)))
        if len(own) and len(members) > 1 and reach > 0:
            count = min(len(members), 1 + (NEAREST if n <= FULLY_JOINED else NEAREST_OF_MANY))
            tree = cKDTree(where.position[members])
            distances, found = tree.query(where.position[own], k=count, distance_upper_bound=reach)
            near = np.isfinite(distances)
            source = np.repeat(own, near.sum(axis=1))
            target = members[found[near]]
            joined = (source != target) & ~where.on_other_levels(source, target, height)
            pairs.append((source[joined], target[joined]))
    sources = np.concatenate([none, *(source for source, _ in pairs)])
    targets = np.concatenate([none, *(target for _, target in pairs)])
    keys = np.unique(sources * max(n, 1) + targets)
    sources, targets = keys // max(n, 1), keys % max(n, 1)
    posed = np.flatnonzero(where.kind != NO_POSE)
    counts = np.bincount(sources, minlength=n) + np.bincount(posed, minlength=n)
    starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    edges = np.empty(int(starts[-1]), np.int32)
    edges[starts[posed]] = posed
    before = np.concatenate([[0], np.cumsum(np.bincount(sources, minlength=n))])
    edges[starts[sources] + 1 + np.arange(len(sources)) - before[sources]] = targets
    return starts, edges
