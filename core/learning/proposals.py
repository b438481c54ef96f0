"""The lesson of a run: frames whose place the whole run knows beyond doubt, although alone they were not recognized.

Each becomes a proposal, a further look of its place, unless something speaks against it: the view was covered, or shows
what the frame before it showed; the rest of the run leaves doubt; there is no anchor shortly before or after it, or
their way by odometry leads to another place or turns another way; or keypoints of the frame do not fit those of an
anchor of the same run that was taken where the views overlap.

A run teaches nothing at all if too few of its frames are recognized, or if the run contradicts too many of those that
are: then the robot is in another building, or its odometry is wrong.  Nor does it without odometry.
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
from core.geometry.verification import LEAST_MATCHES, verify
from core.learning.anchors import Anchors, Fit, Way, anchors_of, likelihoods, pace_of, place_of, scale_of
from core.learning.frames import RunFrame, Trail
from core.learning.smoothing import Posterior, smoothed

LEAST_PROBABILITY = 0.95
"""Certainty from which a frame's place counts as known; ``smoothing.WEIGHT`` says how often that was right."""

LEAST_ANCHORS = 6
"""A run with fewer anchors teaches nothing.  In a year of runs on four worlds, an attacker with the right odometry in
another building or street had none."""

LEAST_AGREEING = 0.5
"""A run teaches nothing if it contradicts more than the rest of the frames that are sure of themselves.  On pictures of
64 x 32 pixels (nordland), where a third of the recognized frames are wrong, 0.7 would refuse half of the runs, although
none of what they propose is wrong."""

MOST_SCALED = 1.2
"""A run teaches nothing if its odometry is off by more than this factor, by its anchors."""

EXACT = 0.2
"""Standard deviation of where odometry from the anchors leads, in same-place radii."""

NEAR = 0.4
"""Odometry from the anchors must lead to within this many same-place radii of the place; without poses, within so many
times as many frames as are the same place.  In a year of runs on corridor and nordland, none of 991 proposals up to
0.3 radii away was of another place, and three of 67 farther ones were, before ``EXACT`` had its say."""

MISFIT = 0.6
"""The anchors around a frame may miss the way of odometry by this many same-place radii, root mean square.  In a year
on corridor, 43 of 240 proposals lie between 0.4 and 0.6, none of them wrong."""

TURNED = math.radians(30)
"""A robot that looks farther than this from where the map looked sees something else."""

OVERLAPPING = 1.0
"""Anchors up to this many same-place radii of way from a frame show part of what it shows: by definition."""

FITTING, STRANGE = 60.0, 8.0
"""Evidence (``core.geometry.verification``) from which keypoints prove that two frames overlap, and under which they
deny it.  The first is above the evidence at which right and wrong candidates are as frequent (``evidence.VERIFIED``).
In a year on corridor, one of 157 proposals above it was wrong, by three places."""

DESCRIBED = 40
"""Keypoints that both frames must have for the lack of evidence to mean anything."""

Refusal = Literal["recognized", "covered", "constant", "uncertain", "no anchors", "odometry", "turned", "geometry"]
"""Why a frame is no proposal: it was recognized at its place; its view; or what speaks against it."""

Contradiction = Literal["no places", "no odometry", "too few recognized", "contradicted", "odometry"]
"""Why a run teaches nothing."""


@dataclass(frozen=True)
class LessonOptions:
    """How sure proposals must be.

    least_probability: the probability of the place by the rest of the run.
    least_anchors: of a run.
    """

    least_probability: float = LEAST_PROBABILITY
    least_anchors: int = LEAST_ANCHORS


@dataclass(frozen=True)
class Proposal:
    """A frame of a run as a further look of a place.

    frame: its number in the run.
    row: of the map, a frame of the place.
    certainty: the probability of the place and those that are the same place, by the rest of the run.
    anchors: numbers of the nearest recognized frames before and after it that agree with it.
    distance: metres, or frames of the sequence without poses, between the place and where odometry puts the frame.
    misfit: the same between the anchors and the way of odometry, root mean square.
    geometry: the best evidence that its keypoints overlap with those of a recognized frame beside it; None: there is no
        such frame with keypoints.
    why: a sentence for a person.
    """

    frame: int
    row: int
    certainty: float
    anchors: tuple[int, int]
    distance: float
    misfit: float
    geometry: float | None
    why: str


@dataclass(frozen=True, eq=False)
class Lesson:
    """The proposals of a run, and what they rest on.

    proposals: in the order of the frames.
    contradiction: why the run teaches nothing; None if it may.
    anchors: int64 [a], the frames that are beyond doubt.
    contradicted: int64 [c], those that were sure of themselves at a place that the run denies.
    rows: int64 [n], the place of each frame that the rest of the run is certain of, as a row of the map; -1: none.
    refused: why frames are no proposals, and how many.
    places: int64 [a], those of the anchors, in the graph.
    certainties: float64 [n], the probability of the likeliest place of each frame and those that are the same, by the
        rest of the run; empty if the run teaches nothing.
    away: float64 [n], the probability by the rest of the run that the robot was at no place of the map; empty likewise.
    """

    proposals: tuple[Proposal, ...]
    contradiction: Contradiction | None
    anchors: NDArray[np.int64]
    contradicted: NDArray[np.int64]
    rows: NDArray[np.int64]
    refused: Mapping[Refusal, int] = field(default_factory=dict)
    places: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, np.int64))
    certainties: NDArray[np.float64] = field(default_factory=lambda: np.empty(0, np.float64))
    away: NDArray[np.float64] = field(default_factory=lambda: np.empty(0, np.float64))


def lesson_of(frames: Sequence[RunFrame], graph: PlaceGraph, options: LessonOptions | None = None) -> Lesson:
    """Judge a whole run, and propose what it teaches a map.

    Args:
        frames: of one robot, in the order in which they were taken.
        graph: of the places that the frames were judged against.
        options: None: the usual.
    """
    options = options or LessonOptions()
    none = np.empty(0, np.int64)
    if not len(graph) or not len(frames):
        return Lesson((), "no places", none, none, np.full(len(frames), -1, np.int64))
    trail = Trail.of(frames)
    if all(motion is None for motion in trail.motions):
        return Lesson((), "no odometry", none, none, np.full(len(frames), -1, np.int64))
    pace = None if graph.posed.all() else pace_of(trail, graph)
    posteriors = smoothed(trail.looks(graph, pace), graph)
    anchors = anchors_of(frames, posteriors, graph)
    contradiction = _contradiction(anchors, scale_of(trail, anchors, graph), options)
    if contradiction is not None:
        return Lesson((), contradiction, anchors.frames, anchors.contradicted, np.full(len(frames), -1, np.int64))
    judge = _Judge(frames, graph, posteriors, Way(trail, anchors, graph, pace), options)
    found: list[Proposal] = []
    refused: Counter[Refusal] = Counter()
    rows = np.full(len(frames), -1, np.int64)
    for number in range(len(frames)):
        place = judge.place(number)
        if place is not None and judge.fits(number, place):
            rows[number] = graph.rows[place]
        outcome = judge.outcome(number, place)
        if isinstance(outcome, Proposal):
            found.append(outcome)
        else:
            refused[outcome] += 1
    best = [one.best for one in posteriors]
    certainties = np.array(
        [0.0 if at is None else one.at(graph.same_place(at)) for at, one in zip(best, posteriors, strict=True)]
    )
    return Lesson(
        tuple(found), None, anchors.frames, anchors.contradicted, rows, dict(refused), anchors.places, certainties,
        np.array([one.away for one in posteriors]),
    )  # fmt: skip


def _contradiction(anchors: Anchors, scale: float | None, options: LessonOptions) -> Contradiction | None:
    agreeing, contradicted = len(anchors.frames), len(anchors.contradicted)
    if agreeing < options.least_anchors:
        return "too few recognized"
    if agreeing < LEAST_AGREEING * (agreeing + contradicted):
        return "contradicted"
    return "odometry" if scale is not None and not 1 / MOST_SCALED <= scale <= MOST_SCALED else None


class _Judge:
    """Judges the frames of one run."""

    def __init__(
        self,
        frames: Sequence[RunFrame],
        graph: PlaceGraph,
        posteriors: Sequence[Posterior],
        way: Way,
        options: LessonOptions,
    ) -> None:
        self.frames, self.graph, self.posteriors, self.way, self.options = frames, graph, posteriors, way, options
        self._fits: dict[int, Fit | None] = {}

    def fit(self, number: int) -> Fit | None:
        """As of :meth:`core.learning.anchors.Way.fit`."""
        if number not in self._fits:
            self._fits[number] = self.way.fit(number)
        return self._fits[number]

    def place(self, number: int) -> int | None:
        """The place of a frame that the rest of the run is certain of: of the same places the likeliest one.

        Among places that are the same, the frame has a say itself, and so has the way of odometry from its anchors.
        """
        posterior = self.posteriors[number]
        best = posterior.best
        if best is None:
            return None
        if not self._certain(number, best):
            return None
        same = [place for place in self.graph.same_place(best).tolist() if self._certain(number, place)]
        likely = likelihoods(self.frames[number], posterior, self.graph)
        fit = self.fit(number)

        def likelihood(place: int) -> float:
            off = 0.0 if fit is None else self.way.distance(fit, place) / (EXACT * self._unit(fit))
            return likely.get(place, 0.0) * math.exp(-0.5 * off**2)

        return int(max(same, key=likelihood))

    def _certain(self, number: int, place: int) -> bool:
        """Whether the rest of the run is certain that a frame shows a place or one that is the same."""
        return self.posteriors[number].at(self.graph.same_place(place)) >= self.options.least_probability

    def _unit(self, fit: Fit) -> float:
        """The same-place radius or, without poses, how many frames to either side are the same place."""
        same = self.graph.neighborhood
        return same.radius if fit.point is not None else float(max(same.frames, 1))

    def fits(self, number: int, place: int) -> bool:
        """Whether odometry leads a frame from its anchors to a place, looking the same way."""
        fit = self.fit(number)
        return fit is not None and self._near(fit, place) and self.way.turned(fit, place) <= TURNED

    def _near(self, fit: Fit, place: int) -> bool:
        unit = self._unit(fit)
        return fit.misfit <= MISFIT * unit and self.way.distance(fit, place) <= NEAR * unit

    def outcome(self, number: int, place: int | None) -> Proposal | Refusal:
        """The proposal that a frame is, or why it is none."""
        frame = self.frames[number]
        if frame.sight is not None:
            return frame.sight
        if place is None:
            return "uncertain"
        same = self.graph.same_place(place)
        if frame.verdict == "recognized" and frame.row is not None and place_of(self.graph, frame.row) in same:
            return "recognized"
        fit = self.fit(number)
        if fit is None:
            return "no anchors"
        if not self._near(fit, place):
            return "odometry"
        if self.way.turned(fit, place) > TURNED:
            return "turned"
        geometry, denied = self._geometry(number)
        if denied:
            return "geometry"
        certainty = self.posteriors[number].at(same)
        distance = self.way.distance(fit, place)
        return Proposal(
            number,
            int(self.graph.rows[place]),
            certainty,
            (fit.before, fit.after),
            distance,
            fit.misfit,
            geometry,
            _reason(frame, certainty, fit, distance, geometry),
        )

    def _geometry(self, number: int) -> tuple[float | None, bool]:
        """The best evidence that a frame overlaps with an anchor beside it, and whether that is denied."""
        query = self.frames[number].keypoints
        travelled, piece = self.way.trail.travelled, self.way.trail.piece
        reach = self.way.reach()
        if query is None or len(query) < LEAST_MATCHES or reach is None:
            return None, False
        anchors = self.way.anchors[piece[self.way.anchors] == piece[number]]
        apart = np.abs(travelled[anchors] - travelled[number])
        near = anchors[apart <= OVERLAPPING * self.graph.neighborhood.radius]
        near = near[np.argsort(np.abs(near - number), kind="stable")][:4]
        beside = [one for at in near.tolist() if at != number and (one := self.frames[at].keypoints) is not None]
        if not beside:
            return None, False
        best = max(one.evidence for one in verify(query, beside))
        described = len(query) >= DESCRIBED and max(map(len, beside)) >= DESCRIBED
        return best, described and best < STRANGE


def _reason(frame: RunFrame, certainty: float, fit: Fit, distance: float, geometry: float | None) -> str:
    alone = {"recognized": "at another place", "ambiguous": "ambiguous", "unknown": "unknown"}[frame.verdict]
    unit = "m" if fit.point is not None else "frames"
    text = (
        f"Alone the frame was {alone}; the rest of the run puts it here with {certainty:.3f}. Odometry from the "
        f"recognized frames {fit.before} and {fit.after} leads within {distance:.1f} {unit}."
    )
    if geometry is None:
        return text
    return f"{text} Its keypoints fit a recognized frame beside it, with an evidence of {geometry:.0f}."
