"""Redundant places, which look like a neighbour, and the recall that removing them costs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from core.places import NO_POSE, NO_SEQUENCE, Neighborhood, Whereabouts
from core.upkeep.hubness import NONE

MOST_NEIGHBOURS = 32
"""A place is compared with at most this many of its nearest: where a robot stood still, there are too many pairs."""

_STEPS = MOST_NEIGHBOURS // 2

FEWEST_FRAMES_OF_STOP = 10
"""From this number on, frames of one view are a stop: fewer are those of a slow robot or a fast camera."""


def neighbour_pairs(where: Whereabouts, neighborhood: Neighborhood) -> NDArray[np.int64]:
    """Pairs of frames of the same place (``Whereabouts.near``), each once, the lower first: int64 [m, 2]."""
    from scipy.spatial import cKDTree  # here, because it takes long to import

    pairs: list[NDArray[np.int64]] = [np.empty((0, 2), np.int64)]
    for kind in np.unique(where.kind[where.kind != NO_POSE]):
        members = np.flatnonzero(where.kind == kind)
        count = min(len(members), MOST_NEIGHBOURS + 1)
        ground = where.ground[members]
        tree = cKDTree(ground)
        # The tree's bound is exclusive and rounded, but places at exactly the radius are near.
        bound = 1.001 * neighborhood.radius + 1e-6
        apart, found = tree.query(ground, k=[*range(1, count + 1)], distance_upper_bound=bound)
        first = np.repeat(np.arange(len(members)), count)
        second = found.reshape(-1)
        there = apart.reshape(-1) <= neighborhood.radius
        pairs.append(np.stack([members[first[there]], members[second[there]]], axis=1))
    # Where a robot stood still, many frames are at one position.
    crowded = bool(where.repeats(np.arange(len(where))).any())
    steps = _STEPS if crowded else min(neighborhood.frames, _STEPS)
    pairs += _along(where, where.sequence, where.ordinal, neighborhood.frames, steps)
    if where.aligned:
        # Several traverses may have a frame at each station.
        pairs += _along(where, where.track, where.station, neighborhood.frames, _STEPS)
    ordered = np.sort(np.concatenate(pairs), axis=1)
    one, other = ordered.T
    ordered = ordered[(one != other) & ~where.on_other_levels(one, other, neighborhood.height)]
    return np.unique(ordered, axis=0)


@dataclass(frozen=True)
class Stop:
    """Frames of a traverse that show one view; ``places`` are their positions, int64 [n], in the order of the map."""

    places: NDArray[np.int64]


def stops(where: Whereabouts) -> list[Stop]:
    """Where a robot stood while it mapped: the views with ``FEWEST_FRAMES_OF_STOP`` frames or more, largest first."""
    found = np.flatnonzero(where.sequence != NO_SEQUENCE)
    order = found[np.lexsort((where.ordinal[found], where.sequence[found]))]
    changes = np.flatnonzero((np.diff(where.sequence[order]) != 0) | (np.diff(where.ordinal[order]) != 0)) + 1
    bounds = np.concatenate([[0], changes, [len(order)]])
    crowded = np.flatnonzero(np.diff(bounds) >= FEWEST_FRAMES_OF_STOP)
    views = [np.sort(order[bounds[one] : bounds[one + 1]]) for one in crowded]
    return sorted(map(Stop, views), key=lambda stop: (-len(stop.places), int(stop.places[0])))


def first_looks(where: Whereabouts, neighborhood: Neighborhood) -> NDArray[np.int64]:
    """For each frame of a stop the first frame there, and each other frame for itself; int64 [n].

    A frame that its pose puts too far from the first one for the same place stands for itself.
    """
    first = np.arange(len(where))
    for stop in stops(where):
        same = where.take(stop.places).near(0, neighborhood)
        first[stop.places[same]] = stop.places[0]
    return first


def _along(
    where: Whereabouts, sequence: NDArray[np.int32], ordinal: NDArray[np.int64], frames: int, steps: int
) -> list[NDArray[np.int64]]:
    """Pairs of one sequence, at most ``frames`` apart, that do not both have poses of one kind.

    Args:
        sequence, ordinal: of the places, or their tracks and stations.
        steps: the number of places behind it with which a place is compared.
    """
    pairs = []
    order = np.lexsort((ordinal, sequence))
    for step in range(1, steps + 1):
        first, second = order[:-step], order[step:]
        near = (sequence[first] == sequence[second]) & (np.abs(ordinal[second] - ordinal[first]) <= frames)
        posed = (where.kind[first] == where.kind[second]) & (where.kind[first] != NO_POSE)
        chosen = near & ~posed & (sequence[first] != NO_SEQUENCE)
        pairs.append(np.stack([first[chosen], second[chosen]], axis=1))
    return pairs


def thinned(
    places: int,
    pairs: NDArray[np.int64],
    similarity: NDArray[np.float32],
    least: float,
    free: NDArray[np.bool_] | None = None,
) -> NDArray[np.bool_]:
    """Choose the places to retain, such that every removed one has a retained neighbour of its place that looks alike.

    The choice is greedy: places are considered by the similarity of their most similar neighbour, highest first.  A
    place is removed if it has a retained neighbour that replaces it, and if every removed place that it replaces has
    another.

    Args:
        places: number of places.
        pairs: int64 [m, 2], frames of the same place, each pair once.
        similarity: float32 [m], the score of each pair.
        least: the score from which one of a pair replaces the other.
        free: bool [places], which may be removed; None: all.

    Returns:
        bool [places], which are retained.
    """
    may_go = np.ones(places, np.bool_) if free is None else free
    retained = np.ones(places, np.bool_)
    near: list[list[int]] = [[] for _ in range(places)]
    best = np.full(places, -np.inf)
    for (a, b), score in zip(pairs.tolist(), similarity.tolist(), strict=True):
        if score >= least:
            near[a].append(b)
            near[b].append(a)
            best[a], best[b] = max(best[a], score), max(best[b], score)
    stand_ins = [len(others) for others in near]  # of each place, how many retained neighbours replace it
    for place in np.argsort(-best, kind="stable").tolist():
        if not (may_go[place] and stand_ins[place]):
            continue
        if not any(not retained[other] and stand_ins[other] == 1 for other in near[place]):
            retained[place] = False
            for other in near[place]:
                stand_ins[other] -= 1
    return retained


@dataclass(frozen=True)
class RemovalTrial:
    """The matches of queries with known truth against a whole map, from which the matches in a part of it follow.

    positions: int64 [q, c], the best places for each query by the first stage, best first, filled up with NONE.
    scores: float32 [q, c], of the first stage.
    gains: float32 [q, c], of the second stage, at least 0.
    right: bool [q, c], which of the places are the query's own.
    candidates: how many the second stage examines for each query; 0: there is none.
    """

    positions: NDArray[np.int64]
    scores: NDArray[np.float32]
    gains: NDArray[np.float32]
    right: NDArray[np.bool_]
    candidates: int

    def found(self, retained: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """For which queries the best match among the retained places is right; bool [q].

        Args:
            retained: bool [places].
        """
        there = (self.positions != NONE) & retained[np.maximum(self.positions, 0)]
        examined = there & (there.cumsum(axis=1) <= self.candidates)
        values = np.where(there, self.scores + np.where(examined, self.gains, 0), -np.inf)
        if self.candidates:  # places that were not examined rank after those that were
            values = np.where(there & ~examined, -np.inf, values)
        best = np.argmax(values, axis=1)[:, np.newaxis]
        return np.take_along_axis(self.right & there, best, axis=1)[:, 0]


@dataclass(frozen=True)
class Thinning:
    """A map with some of its places removed, and the effect.

    least: the score from which one place replaces another.
    retained: bool [places].
    before, after: bool [q], which queries the whole map and the retained places answer rightly.
    """

    least: float
    retained: NDArray[np.bool_]
    before: NDArray[np.bool_]
    after: NDArray[np.bool_]

    @property
    def loss(self) -> float:
        """The recall before minus the recall after."""
        return float(self.before.mean() - self.after.mean())


def steps(similarity: NDArray[np.float32], count: int) -> list[float]:
    """Values of ``least`` to try, highest first: at most ``count`` quantiles of the pairs' scores, float32 [m]."""
    if not len(similarity):
        return []
    shares = np.linspace(1.0, 0.0, count + 1)[1:]
    return [float(score) for score in sorted({*np.quantile(similarity, shares).tolist()}, reverse=True)]


def best_thinning(tried: Sequence[Thinning], most_loss: float) -> Thinning | None:
    """The last thinning before the first that costs too much recall; None if the first one does.

    Args:
        tried: those that remove fewer places first.
        most_loss: the recall that may be lost.
    """
    chosen = None
    for thinning in tried:
        if thinning.loss > most_loss:
            break
        chosen = thinning
    return chosen
