"""New ground: stretches of a run that leave the map and come back to it, which a person may add to the map.

Between two anchors the run is surely off the map where odometry, from the anchors before to those after, leads far from
all of its places, the frames are unknown, and the rest of the run is certain of no place.  The errors of a chain of
poses x_k = (x, y, heading, scale) are carried along the way by the linear J and fed by each step's noise Q
(Smith, Self and Cheeseman, Estimating uncertain spatial relationships in robotics, 1990):

    C_k+1 = J C_k J^T + Q,    Cov(x_k, x_j) = C_k J_kj^T  for k <= j.

The misclosures e at the anchors, of covariance S = Cov(z, z) + R, are distributed by the mean of the conditional
Gaussian, which leaves its covariance to each frame (Rauch, Tung and Striebel, Maximum likelihood estimates of linear
dynamic systems, 1965, of which this is the batch form):

    d_k = Cov(x_k, z) S^-1 e,    P_k = C_k - Cov(x_k, z) S^-1 Cov(z, x_k).

A stretch from which the run does not come back is no proposal: nothing would contradict its odometry.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from core.belief import PlaceGraph
from core.belief.motion import DRIFT, HEADING_SPREAD
from core.learning.anchors import BESIDE, REACH, turn_of
from core.learning.frames import RunFrame, Trail
from core.learning.proposals import LEAST_PROBABILITY, TURNED, Lesson
from core.places import EARTH_RADIUS, Pose

FIRM = 0.8
"""Anchors at the ends of a stretch are frames that are as sure of themselves as this, and of which the rest of the run
is certain.  Where a map ends, the facade ahead is recognized from far away at the last place that shows it: on lip6,
frames with 0.5 to 0.8 are up to 40 m off, and agree with one another.  With 0.9, corridor has too few anchors in one of
four runs."""

APART = 2.0
"""A frame is off the map if it is farther from all places than a same-place radius and so many standard deviations."""

LEAST_UNKNOWN = 0.5
"""At least this share of the frames off the map must be unknown alone, and the rest of the run must be certain of no
place for as many; not for all, as a belief clings for a while to the last place of a map that ends."""

LEAST_FRAMES = 3
"""A stretch has at least so many keyframes that are surely off the map."""

SCALE = 0.05
"""Standard deviation of the scale of a run's odometry."""

TURNING = 0.02
"""Standard deviation of the heading of odometry after one metre, radians; it grows with the root of the way."""

PLACED = 1 / 3
"""Standard deviation of a robot from the place that it recognizes, in same-place radii."""

EXPLAINED = 16.27
"""The squared Mahalanobis distance of the misclosure up to which odometry's drift explains it: the 0.999 quantile of
χ² with three degrees of freedom."""

MOST_SPREAD = 1.0
"""The standard deviation of each position, in same-place radii, may not be greater; this bounds a stretch's length."""

UNKNOWN = 100.0
"""Standard deviation of where the chain begins, in metres and radians: the anchors alone say it."""

THINNED = 0.75
"""Keyframes are at least this many times the map's spacing apart, so that a robot at its pace gives it every frame."""

GroundRefusal = Literal["recognized", "on the map", "few anchors", "odometry", "misclosure", "unsure"]
"""Why a stretch between two anchors is no proposal: too many of its frames were recognized; they are not surely off the
map; too few anchors are before or after it; odometry began anew; it contradicts the anchors; or the positions are not
known well enough."""


@dataclass(frozen=True)
class GroundFrame:
    """A keyframe off the map.

    frame: its number in the run.
    point: x + iy in metres, from the place at the stretch's ``origin``; along the first and the second coordinate.
    rise: metres above that place; heading: radians counter-clockwise from the first coordinate.
    spread, heading_spread: standard deviations, metres (of the worst direction) and radians.
    """

    frame: int
    point: complex
    rise: float
    heading: float
    spread: float
    heading_spread: float

    def pose(self, origin: Pose) -> Pose:
        """Its pose in the map, from that of the place at the stretch's origin."""
        east, north, turned = self.point.real, self.point.imag, math.degrees(self.heading)
        if origin.x is not None and origin.y is not None:
            z = None if origin.z is None else origin.z + self.rise
            return Pose(x=origin.x + east, y=origin.y + north, z=z, heading=turned % 360)
        assert origin.latitude is not None and origin.longitude is not None
        across = east / (EARTH_RADIUS * math.cos(math.radians(origin.latitude)))
        longitude = (origin.longitude + math.degrees(across) + 180) % 360 - 180
        latitude = origin.latitude + math.degrees(north / EARTH_RADIUS)
        z = None if origin.z is None else origin.z + self.rise
        return Pose(latitude=latitude, longitude=longitude, z=z, heading=(90 - turned) % 360)


@dataclass(frozen=True)
class GroundStretch:
    """A stretch of a run off the map.

    frames: its keyframes, in the order of the run.
    origin, end: rows of the map, the places where it leaves the map and where it comes back.
    length: metres of way between these two.
    misclosure, misturned: metres and radians by which odometry from the place where it left misses that of its return.
    recognized: how many frames of the stretch were recognized alone at a place that is elsewhere.
    """

    frames: tuple[GroundFrame, ...]
    origin: int
    end: int
    length: float
    misclosure: float
    misturned: float
    recognized: int


@dataclass(frozen=True)
class NewGround:
    """The stretches of a run off the map, and why others are none (:data:`GroundRefusal`)."""

    stretches: tuple[GroundStretch, ...] = ()
    refused: Mapping[str, int] = field(default_factory=dict)


def new_ground_of(frames: Sequence[RunFrame], graph: PlaceGraph, lesson: Lesson) -> NewGround:
    """Find the stretches of a run off the map.

    Args:
        frames: of the run.
        graph: of the places that the frames were judged against; in a map without poses there is no new ground.
        lesson: of the run and this graph.

    Returns:
        None of a run that teaches nothing.
    """
    if lesson.contradiction is not None or not graph.posed[lesson.places].all():
        return NewGround()
    survey, found, refused = _Survey(frames, graph, lesson), list[GroundStretch](), Counter[str]()
    for number in range(1, len(survey.anchors)):
        outcome = survey.before(number)
        if isinstance(outcome, GroundStretch):
            found.append(outcome)
        elif outcome is not None:
            refused[outcome] += 1
    return NewGround(tuple(found), dict(refused))


class _Survey:
    """Surveys the stretches of one run."""

    def __init__(self, frames: Sequence[RunFrame], graph: PlaceGraph, lesson: Lesson) -> None:
        self.frames, self.graph, self.lesson, self.trail = frames, graph, lesson, Trail.of(frames)
        firm = [
            lesson.certainties[at] >= LEAST_PROBABILITY and (frames[at].probability or 1.0) >= FIRM
            for at in lesson.anchors.tolist()
        ]
        self.anchors, self.places = lesson.anchors[firm], lesson.places[firm]
        self._posed = np.flatnonzero(graph.posed)
        self._radius = graph.neighborhood.radius or graph.spacing or 1.0

    def before(self, anchor: int) -> GroundStretch | GroundRefusal | None:
        """The stretch between an anchor, by its position, and the one before it; None if the run stays on the map."""
        last, first = self.anchors[anchor - 1 : anchor + 1]
        inside = np.arange(last + 1, first)
        inside = inside[[self.frames[at].sight is None for at in inside.tolist()]]
        if (self.lesson.certainties[inside] < LEAST_PROBABILITY).sum() < LEAST_FRAMES:
            return None
        if self.trail.piece[last] != self.trail.piece[first]:
            return "odometry"
        before, after = self._beside(anchor - 1, -1), self._beside(anchor, 1)
        if min(len(before), len(after)) < BESIDE:
            return "few anchors"
        return self._surveyed(before, after, inside)

    def _beside(self, anchor: int, way: int) -> NDArray[np.int64]:
        """Positions of the anchors that say where a stretch begins or ends, the nearest first; int64 [k]."""
        anchors, trail = self.anchors, self.trail
        some = np.arange(anchor, len(anchors)) if way > 0 else np.arange(anchor, -1, -1)
        apart = np.abs(trail.travelled[anchors[some]] - trail.travelled[anchors[anchor]])
        near = (apart <= REACH * self._radius) & (trail.piece[anchors[some]] == trail.piece[anchors[anchor]])
        return some[near][: 2 * BESIDE]

    def _surveyed(
        self, before: NDArray[np.int64], after: NDArray[np.int64], inside: NDArray[np.int64]
    ) -> GroundStretch | GroundRefusal:
        """A stretch with the poses of its frames; ``inside``: those that may be keyframes."""
        graph, trail = self.graph, self.trail
        used, origin = np.sort(np.concatenate([before, after])), int(self.places[before[0]])
        chain = _Chain.laid(trail, self.anchors[used], self.places[used], graph, origin, PLACED * self._radius)
        if chain is None:
            return "misclosure"
        missed, explained = chain.misclosure(len(before))
        if not explained or chain.worst() > self._radius:
            return "misclosure"
        points, headings, spreads = chain.settled()
        at = inside - chain.begin
        if spreads[at, 0].max() > MOST_SPREAD * self._radius:
            return "unsure"
        here, there = int(self.anchors[before[0]]), int(self.anchors[after[0]])
        end = int(self.places[after[0]])
        length = float(trail.travelled[there] - trail.travelled[here])
        climb = float(graph.coordinates[end, 2] - graph.coordinates[origin, 2])
        gone = (trail.travelled[inside] - trail.travelled[here]) / max(length, 1e-9)
        found = [
            GroundFrame(number, complex(points[k]), climb * share, float(headings[k]), *map(float, spreads[k]))
            for number, k, share in zip(inside.tolist(), at.tolist(), gone.tolist(), strict=True)
        ]
        recognized = self._recognized_off(found, origin)
        if isinstance(recognized, str):
            return recognized
        kept = self._keyframes(found, origin)
        row, back = int(graph.rows[origin]), int(graph.rows[end])
        return GroundStretch(tuple(kept), row, back, length, abs(missed[0]), abs(missed[1]), recognized)

    def _distance(self, one: GroundFrame, origin: int) -> float:
        """Metres from a frame to the nearest place of the map."""
        return float(np.abs(self.graph.displacements(origin, self._posed) - one.point).min())

    def _recognized_off(self, frames: Sequence[GroundFrame], origin: int) -> int | GroundRefusal:
        """How many frames off the map were recognized alone; or why those of a stretch are not surely off the map."""
        off = [one for one in frames if self._distance(one, origin) > self._radius + APART * one.spread]
        unsure = [one for one in off if self.lesson.certainties[one.frame] < LEAST_PROBABILITY]
        if len(off) < LEAST_FRAMES or len(unsure) < LEAST_UNKNOWN * len(off):
            return "on the map"
        verdicts = Counter(self.frames[one.frame].verdict for one in off)
        return "recognized" if verdicts["unknown"] < LEAST_UNKNOWN * len(off) else verdicts["recognized"]

    def _keyframes(self, frames: Sequence[GroundFrame], origin: int) -> list[GroundFrame]:
        """Frames that are as far apart as the places of the map, and from these, or look another way than the others.

        Frames of whose place the run is certain are none.
        """
        spacing = THINNED * (min(self.graph.spacing, self._radius) or self._radius)
        kept: list[GroundFrame] = []
        for one in frames:
            if self.lesson.rows[one.frame] >= 0 or self._distance(one, origin) < spacing:
                continue
            if not any(abs(other.point - one.point) < spacing and _turned(other, one) <= TURNED for other in kept):
                kept.append(one)
        return kept


def _turned(one: GroundFrame, other: GroundFrame) -> float:
    return abs(math.remainder(one.heading - other.heading, 2 * math.pi))


@dataclass(frozen=True, eq=False)
class _Chain:
    """The frames of a run from the first to the last of some anchors, laid onto the map by a rigid motion.

    begin: number of the first frame.
    points, headings: of the m frames, complex128 [m] from the origin and float64 [m].
    at: int64 [a], the anchors, counted from the first frame.
    errors: float64 [a, 3], by which they miss their places: x, y, heading.
    noise: float64 [a, 3], variances of these.
    covariances: float64 [m, 4, 4], C_k.
    """

    begin: int
    points: NDArray[np.complex128]
    headings: NDArray[np.float64]
    at: NDArray[np.int64]
    errors: NDArray[np.float64]
    noise: NDArray[np.float64]
    covariances: NDArray[np.float64]

    @classmethod
    def laid(
        cls,
        trail: Trail,
        frames: NDArray[np.int64],
        places: NDArray[np.int64],
        graph: PlaceGraph,
        origin: int,
        placed: float,
    ) -> _Chain | None:
        """The chain from the first to the last of some anchors; None if they do not say how it is turned.

        Args:
            frames, places: of the anchors.
            placed: standard deviation of a robot from its place, metres.
        """
        there, gone = graph.displacements(origin, places), trail.points[frames]
        apart = graph.heading[places] - trail.headings[frames]
        turn = turn_of(there - there.mean(), gone - gone.mean(), apart, placed)
        if turn is None:
            return None
        begin, end = int(frames[0]), int(frames[-1])
        points = there.mean() + turn * (trail.points[begin : end + 1] - gone.mean())
        headings = trail.headings[begin : end + 1] + np.angle(turn)
        at = frames - begin
        missed = there - points[at]
        turned = graph.heading[places] - headings[at]
        known = ~np.isnan(turned)
        wrapped = np.angle(np.exp(1j * np.where(known, turned, 0.0)))
        spread = np.where(known, HEADING_SPREAD, UNKNOWN)
        noise = np.column_stack([np.full((len(at), 2), placed), spread]) ** 2
        errors = np.column_stack([missed.real, missed.imag, wrapped])
        return cls(begin, points, headings, at, errors, noise, _covariances(points, trail, begin))

    def covariance(self, frames: NDArray[np.int64], anchors: NDArray[np.int64]) -> NDArray[np.float64]:
        """Cov(x_k, z) of frames and anchors, by their positions in the chain; float64 [k, a, 4, 3]."""
        first = np.minimum(frames[:, None], anchors[None, :])
        forth = _carried(self.points[anchors][None, :] - self.points[first])
        back = _carried(self.points[frames][:, None] - self.points[first])
        return np.asarray((back @ self.covariances[first] @ forth.swapaxes(-1, -2))[..., :3])

    def _conditioned(
        self, frames: NDArray[np.int64], some: NDArray[np.int64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """The errors d_k of frames by some of the anchors, and P_k; float64 [k, 4] and [k, 4, 4]."""
        at, count = self.at[some], 3 * len(some)
        innovation = self.covariance(at, at)[:, :, :3].swapaxes(1, 2).reshape(count, count)
        innovation = innovation + np.diag(self.noise[some].ravel())
        shared = self.covariance(frames, at).swapaxes(1, 2).reshape(len(frames), 4, count)
        gain = np.linalg.solve(innovation, shared.reshape(-1, count).T).T.reshape(shared.shape)
        return gain @ self.errors[some].ravel(), self.covariances[frames] - gain @ shared.swapaxes(1, 2)

    def misclosure(self, before: int) -> tuple[tuple[float, float], bool]:
        """Metres and radians by which the first anchor after a stretch misses the odometry from those before it, and
        whether its drift explains them.

        Args:
            before: how many anchors are before the stretch.
        """
        (found,), (covariance,) = self._conditioned(self.at[before : before + 1], np.arange(before))
        missed = self.errors[before] - found[:3]
        expected = covariance[:3, :3] + np.diag(self.noise[before])
        distance = float(missed @ np.linalg.solve(expected, missed))
        return (float(np.hypot(missed[0], missed[1])), float(missed[2])), distance <= EXPLAINED

    def worst(self) -> float:
        """Metres by which the settled chain misses the anchor that it misses most."""
        found, _ = self._conditioned(self.at, np.arange(len(self.at)))
        return float(np.hypot(*(self.errors[:, :2] - found[:, :2]).T).max())

    def settled(self) -> tuple[NDArray[np.complex128], NDArray[np.float64], NDArray[np.float64]]:
        """Points, headings, and the standard deviations of both, of all frames; complex128 [m], float64 [m], [m, 2]."""
        found, left = self._conditioned(np.arange(len(self.points)), np.arange(len(self.at)))
        widest = np.linalg.eigvalsh(left[:, :2, :2])[:, 1]
        spreads = np.sqrt(np.maximum(np.column_stack([widest, left[:, 2, 2]]), 0.0))
        return self.points + found[:, 0] + 1j * found[:, 1], self.headings + found[:, 2], spreads


def _carried(apart: NDArray[np.complex128]) -> NDArray[np.float64]:
    """J: how errors of a pose and of the scale show in a pose ``apart`` from it, x + iy; float64 [..., 4, 4]."""
    found = np.zeros((*apart.shape, 4, 4)) + np.eye(4)
    found[..., 0, 2], found[..., 1, 2] = -apart.imag, apart.real
    found[..., 0, 3], found[..., 1, 3] = apart.real, apart.imag
    return found


def _covariances(points: NDArray[np.complex128], trail: Trail, begin: int) -> NDArray[np.float64]:
    """C_k along a chain whose beginning is not known; float64 [m, 4, 4]."""
    carried = _carried(np.diff(points))
    found = [np.diag([UNKNOWN, UNKNOWN, UNKNOWN, SCALE]) ** 2]
    for step, motion in zip(carried, trail.motions[begin + 1 : begin + len(points)], strict=True):
        assert motion is not None  # a stretch lies within one piece
        slip = (DRIFT * motion.distance) ** 2 + motion.variance
        turning = TURNING**2 * motion.distance + motion.turn_variance
        found.append(step @ found[-1] @ step.T + np.diag([slip, slip, turning, 0.0]))
    return np.stack(found)
