"""The frames of a run that are beyond doubt, and where odometry puts the frames between them.

An anchor is a frame that was recognized alone and that the rest of the run, without the frame's own evidence, puts at
the same place.  From the anchors shortly before and after a frame, the way of the odometry is laid onto the map: with
poses by the rigid motion of the plane that fits best (the least squares of positions and headings), without poses by a
straight line of positions in a sequence over metres gone.  Anchors that miss it are outvoted; where too many do, the
odometry or a recognition is wrong, and nothing is said.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from core.belief import PlaceGraph
from core.belief.motion import HEADING_SPREAD
from core.learning.frames import RunFrame, Trail
from core.learning.smoothing import Posterior

SURE = 0.5
"""A recognized frame is an anchor from this probability of its own on.  With 0.8, five to eleven of the 111 frames of
dark and foggy runs through corridor would be, in place of thirty or so."""

AGREEING = 0.5
"""The rest of the run must put an anchor at its place with at least this probability; no other value was tried."""

BESIDE = 3
"""Anchors that are taken on each side of a frame; no other number was tried."""

REACH = 6.0
"""Anchors are taken up to this many same-place radii of way before and after a frame, or so many times as many frames
of a sequence as are the same place.  On 30 m, odometry that drifts by 5 % loses 1.5 m."""

OUTVOTED = 1 / 3
"""At most this share of the anchors around a frame may miss the way: one of three, two of six."""


LEAST_PAIRS = 5
"""Pairs of anchors from which the scale of odometry is known."""


@dataclass(frozen=True)
class Fit:
    """Where the anchors around a frame put it, by odometry.

    before, after: numbers of the nearest anchors that agree.
    misfit: metres, or frames of the sequence in maps without poses, by which the anchors miss the way, root mean
        square.
    point: x + iy relative to the coordinates of the place of anchor ``before``, metres; None without poses.
    heading: radians; NaN where not known.
    sequence, ordinal: the position in a sequence, in maps without poses; None with poses.
    """

    before: int
    after: int
    misfit: float
    point: complex | None = None
    heading: float = math.nan
    sequence: int | None = None
    ordinal: float | None = None


@dataclass(frozen=True, eq=False)
class Anchors:
    """The recognized frames of a run.

    frames, places: int64 [a], the anchors' numbers, and their places in the graph: of the same places as each was
        recognized at the likeliest one, by the run and by itself.
    contradicted: int64 [c], the frames that were as sure of themselves, but that the run denies.
    """

    frames: NDArray[np.int64]
    places: NDArray[np.int64]
    contradicted: NDArray[np.int64]


def anchors_of(frames: Sequence[RunFrame], posteriors: Sequence[Posterior], graph: PlaceGraph) -> Anchors:
    """The anchors of a run."""
    agree: list[int] = []
    places: list[int] = []
    contradict: list[int] = []
    for number, (frame, posterior) in enumerate(zip(frames, posteriors, strict=True)):
        if frame.verdict != "recognized" or frame.row is None or frame.sight is not None:
            continue
        if frame.probability is not None and frame.probability < SURE:
            continue
        place = place_of(graph, frame.row)
        if place < 0:
            continue
        same = graph.same_place(place)
        if posterior.at(same) < AGREEING:
            contradict.append(number)
            continue
        agree.append(number)
        likely = likelihoods(frame, posterior, graph)
        places.append(max(same.tolist(), key=lambda one: likely.get(one, 0.0)))
    return Anchors(np.array(agree, np.int64), np.array(places, np.int64), np.array(contradict, np.int64))


def likelihoods(frame: RunFrame, posterior: Posterior, graph: PlaceGraph) -> dict[int, float]:
    """How likely the places of a posterior are with the frame's own evidence, up to a common factor."""
    places, gains = graph.evidence_at(frame.seen)
    own = dict(zip(places.tolist(), np.exp(gains).tolist(), strict=True))
    found = zip(posterior.places.tolist(), posterior.probabilities.tolist(), strict=True)
    return {place: probability * own.get(place, 1.0) for place, probability in found}


def place_of(graph: PlaceGraph, row: int) -> int:
    """The place of the graph at a row of the map; -1 without one."""
    return int(graph.places_at(np.array([row], np.int64))[0])


def pace_of(trail: Trail, graph: PlaceGraph) -> float | None:
    """Frames of the map in a metre along its sequences, by the frames that were recognized alone.

    The median over those that follow one another in one sequence; None where there are too few of them.
    """
    numbers = [
        number
        for number, one in enumerate(trail.frames)
        if one.verdict == "recognized" and one.row is not None and one.sight is None
    ]
    where, paces = graph.whereabouts, []
    for first, second in zip(numbers, numbers[2:], strict=False):  # two apart, as one metre says little
        a, b = (place_of(graph, trail.frames[one].row or 0) for one in (first, second))
        gone = trail.travelled[second] - trail.travelled[first]
        if min(a, b) < 0 or trail.piece[first] != trail.piece[second] or gone <= 0:
            continue
        if where.sequence[a] == where.sequence[b]:
            paces.append(float(where.ordinal[b] - where.ordinal[a]) / gone)
    paces = [one for one in paces if one > 0]
    return float(np.median(paces)) if len(paces) >= BESIDE else None


def scale_of(trail: Trail, anchors: Anchors, graph: PlaceGraph) -> float | None:
    """Metres of the map in a metre of odometry, the median over pairs of anchors.

    The anchors of a pair are between two same-place radii and ``REACH`` of them apart, so that neither the places'
    spacing nor drift hides the scale.  None for too few pairs, as in a map without poses.
    """
    radius = graph.neighborhood.radius
    frames, places = anchors.frames, anchors.places
    ratios: list[float] = []
    for first, place in zip(frames.tolist(), places.tolist(), strict=True):
        apart = np.abs(trail.points[frames] - trail.points[first])
        near = (apart >= 2 * radius) & (apart <= REACH * radius) & graph.posed[places] & graph.posed[place]
        near &= (trail.piece[frames] == trail.piece[first]) & (frames > first)
        there = np.abs(graph.displacements(place, places[near]))
        ratios += (there / apart[near]).tolist()
    return float(np.median(ratios)) if len(ratios) >= LEAST_PAIRS else None


class Way:
    """Lays the odometry of a run onto the map, around each frame by its anchors."""

    def __init__(self, trail: Trail, anchors: Anchors, graph: PlaceGraph, pace: float | None = None) -> None:
        """``pace``: as of :func:`pace_of`; only needed for places without poses."""
        self.trail, self.graph, self.pace = trail, graph, pace
        self.anchors, self.places = anchors.frames, anchors.places

    def fit(self, number: int) -> Fit | None:
        """Where the anchors around a frame put it; None where they are too few or contradict one another."""
        around = self._around(number)
        while len(around):
            sides = self.anchors[around] < number
            if sides.all() or not sides.any() or len(around) < BESIDE:
                return None
            found, missed = self._laid(number, around)
            if found is None:
                return None
            worst = int(np.argmax(missed))
            if missed[worst] <= self._tolerance():
                return found
            if len(around) - 1 < (1 - OUTVOTED) * len(self._around(number)):
                return None
            around = np.delete(around, worst)
        return None

    @property
    def _posed(self) -> bool:
        return bool(len(self.places)) and bool(self.graph.posed[self.places].all())

    def _tolerance(self) -> float:
        same = self.graph.neighborhood
        return same.radius if self._posed else float(max(same.frames, 1))

    def reach(self) -> float | None:
        """Metres of way within which anchors say something about a frame; None: not known."""
        if self._posed:
            return REACH * self.graph.neighborhood.radius
        return None if not self.pace else REACH * max(self.graph.neighborhood.frames, 1) / self.pace

    def _around(self, number: int) -> NDArray[np.int64]:
        """Positions among the anchors of those around a frame that are taken, int64 [k]."""
        reach = self.reach()
        if reach is None:
            return np.empty(0, np.int64)
        apart = self.trail.travelled[self.anchors] - self.trail.travelled[number]
        near = (np.abs(apart) <= reach) & (self.trail.piece[self.anchors] == self.trail.piece[number])
        before = np.flatnonzero(near & (self.anchors < number))[-BESIDE:]
        after = np.flatnonzero(near & (self.anchors > number))[:BESIDE]
        return np.concatenate([before, after])

    def _laid(self, number: int, around: NDArray[np.int64]) -> tuple[Fit | None, NDArray[np.float64]]:
        frames = self.anchors[around]
        before, after = int(frames[frames < number].max()), int(frames[frames > number].min())
        laid = self._in_plane if self._posed else self._along
        return laid(number, around, before, after)

    def _in_plane(
        self, number: int, around: NDArray[np.int64], before: int, after: int
    ) -> tuple[Fit | None, NDArray[np.float64]]:
        graph, trail, places, frames = self.graph, self.trail, self.places[around], self.anchors[around]
        origin = int(self.places[np.flatnonzero(self.anchors == before)[0]])
        there = graph.displacements(origin, places)
        gone = trail.points[frames]
        middle, shown = gone.mean(), there.mean()
        spread = graph.neighborhood.radius or graph.spacing or 1.0
        turn = turn_of(there - shown, gone - middle, graph.heading[places] - trail.headings[frames], spread)
        if turn is None:
            return None, np.zeros(len(around))
        missed = np.abs(shown + turn * (gone - middle) - there)
        point = complex(shown + turn * (trail.points[number] - middle))
        heading = float(trail.headings[number] + np.angle(turn))
        return Fit(before, after, float(np.sqrt(np.mean(missed**2))), point, heading), missed

    def _along(
        self, number: int, around: NDArray[np.int64], before: int, after: int
    ) -> tuple[Fit | None, NDArray[np.float64]]:
        where, places, frames = self.graph.whereabouts, self.places[around], self.anchors[around]
        sequence = where.sequence[places]
        if (sequence != sequence[0]).any() or self.pace is None:
            return None, np.zeros(len(around))
        gone = self.trail.travelled[frames]
        there = where.ordinal[places].astype(np.float64)
        offset = float(np.mean(there - self.pace * gone))
        missed = np.abs(there - self.pace * gone - offset)
        ordinal = offset + self.pace * float(self.trail.travelled[number])
        misfit = float(np.sqrt(np.mean(missed**2)))
        return Fit(before, after, misfit, sequence=int(sequence[0]), ordinal=ordinal), missed

    def distance(self, fit: Fit, place: int) -> float:
        """How far a place is from where the anchors put the frame: metres, or frames of the sequence without poses."""
        if fit.point is not None:
            if not self.graph.posed[place]:
                return math.inf
            origin = int(self.places[np.flatnonzero(self.anchors == fit.before)[0]])
            return float(abs(self.graph.displacements(origin, np.array([place]))[0] - fit.point))
        where = self.graph.whereabouts
        if fit.ordinal is None or where.sequence[place] != fit.sequence:
            return math.inf
        return abs(float(where.ordinal[place]) - fit.ordinal)

    def turned(self, fit: Fit, place: int) -> float:
        """Radians between the heading of a place and that of the robot, from 0 to π; 0 where one is not known."""
        apart = self.graph.heading[place] - fit.heading
        return 0.0 if math.isnan(apart) else abs(math.remainder(apart, 2 * math.pi))


def turn_of(
    there: NDArray[np.complex128], gone: NDArray[np.complex128], apart: NDArray[np.floating], spread: float
) -> complex | None:
    """The turn of the plane, of length 1, that lays points of odometry onto those of a map best; None: any is as good.

    Args:
        there, gone: points of the map and of odometry, x + iy from their means, complex128 [k], metres.
        apart: by how much headings of the map differ from those of odometry, radians, float [k]; NaN: not known.
        spread: standard deviation of the points, metres.
    """
    turn = complex(np.sum(there * np.conj(gone)) / spread**2)
    turn += complex(np.sum(np.exp(1j * apart[~np.isnan(apart)])) / HEADING_SPREAD**2)
    return None if abs(turn) < 1e-9 else turn / abs(turn)
