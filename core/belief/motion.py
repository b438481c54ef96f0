"""How a robot gets from place to place between two frames.

There are three models, each a transition matrix over the places: along the sequences (only the order of the frames is
known), within reach (a speed limit and the time between frames are known), and by odometry (how far, which way and how
surely).  The last two need poses; places without one always go along their sequence, and from there to their
counterparts in traverses that were aligned with theirs.  A matrix is not written out to
be applied: compiled loops (``core.kernels.belief``) go through the joined places alone.  ``matrix()`` of each model
gives it in plain NumPy.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from core.belief.graph import PlaceGraph
from core.belief.speeds import PRIOR, Kernel, mixture
from core.kernels.belief import FITS, MISFIT, along_sequence, by_odometry, within_reach
from core.places import EARTH_RADIUS

Masses = NDArray[np.float32]
Matrix = NDArray[np.float64]

HALF_TURN = math.pi * EARTH_RADIUS
"""Half of the Earth's girth, metres."""

FARTHEST_STEPS = 16
"""A motion of more steps than this counts as a jump to any place."""

DRIFT = 0.1
"""Standard deviation of odometry, as a share of the distance, in addition to its own variance: wheels slip."""

HEADING_SPREAD = math.radians(20)
"""Standard deviation between a place's heading and that of a robot that sees the same."""

TURN_NOTED = math.radians(15)
"""A robot that has turned by this much sees something else, even if it has not moved."""


EXCHANGED = 0.1
"""Share of a place's mass that is shared out among it and its counterparts in other traverses, at each step."""


@dataclass(frozen=True)
class Stride:
    """By how many frames of a map's sequence a robot advances from one frame of its run to the next.

    advance: the usual number, at least 0: 1 for a robot at the pace of the traverse, 0.1 for a camera with ten times
        the frame rate.
    backwards: whether the robot may as well go against the sequence; otherwise it goes back by at most one frame.
    """

    advance: float = 1.0
    backwards: bool = False

    def kernel(self) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Offsets along the sequence, int64 [m], and their probabilities, float64 [m].

        They are a two-sided exponential distribution around ``advance``.  Its scale is half a frame plus two fifths of
        the advance, as the pace is never known well.
        """
        scale = 0.5 + 0.4 * self.advance
        farthest = math.ceil(self.advance + 4 * scale)
        offsets = np.arange(-farthest if self.backwards else -1, farthest + 1)
        away = np.abs(np.abs(offsets) - self.advance) if self.backwards else np.abs(offsets - self.advance)
        weights = np.exp(-away / scale)
        return offsets, weights / weights.sum()


@dataclass(frozen=True)
class Odometry:
    """Motion since the frame before, in the robot's coordinates at that frame: metres and radians, with variances."""

    forward: float
    left: float = 0.0
    turn: float = 0.0
    variance: float = 0.0
    turn_variance: float = 0.0

    def then(self, other: Odometry) -> Odometry:
        """This motion followed by another."""
        cos, sin = math.cos(self.turn), math.sin(self.turn)
        swing = self.turn_variance * (other.forward**2 + other.left**2)  # an uncertain turn displaces what follows
        return Odometry(
            self.forward + cos * other.forward - sin * other.left,
            self.left + sin * other.forward + cos * other.left,
            self.turn + other.turn,
            self.variance + other.variance + swing,
            self.turn_variance + other.turn_variance,
        )

    def part(self, count: int) -> Odometry:
        """One of ``count`` equal parts: a straight line in the direction of the whole, then a part of the turn."""
        share = 1 / count
        return Odometry(
            share * self.forward,
            share * self.left,
            share * self.turn,
            share * self.variance,
            share * self.turn_variance,
        )

    @property
    def distance(self) -> float:
        """The straight distance in metres."""
        return math.hypot(self.forward, self.left)


@dataclass(frozen=True)
class Step:
    """The known motion between two frames; unknown for a run's first frame.

    odometry: None if the robot reports none.
    reach: the metres that the robot can have moved, by its speed limit and the time between; None if not known.
    frames: by how much the run's frame number grew; 1 if every frame arrives.
    known: whether it is known how long it took; not if the robot's clock or counter has jumped.
    """

    odometry: Odometry | None = None
    reach: float | None = None
    frames: int = 1
    known: bool = True


@dataclass
class Pending:
    """Motion that was reported but not yet applied, as it is less than half the distance between places."""

    odometry: Odometry = field(default_factory=lambda: Odometry(0.0))
    reach: float = 0.0


class Move(Protocol):
    """One step's transition matrix, which is never written out to be applied."""

    def __call__(self, masses: Masses, least: float, back: bool, outside: float, moved: Masses) -> tuple[float, float]:
        """Multiply masses by the matrix with a compiled loop, into ``moved``, which holds zeros.

        Args:
            masses: float32 [n].
            least: masses up to this are not moved; the first result is their sum.
            back: whether to multiply by the transposed matrix instead.
            outside: with ``back``, the value of having left the map.

        Returns:
            The mass that was not moved, and the mass that has left the map.
        """

    def matrix(self) -> Matrix:
        """The matrix T in plain NumPy: T_ij is the share of place i's mass that goes to place j, float64 [n, n].

        The mass that a row lacks to 1 leaves the map.
        """


@dataclass(frozen=True, eq=False)
class AlongSequences:
    """Along the sequences by the offsets and probabilities of a :meth:`Stride.kernel`.

    Places that are not ``moving``, bool [n], keep their mass.
    """

    graph: PlaceGraph
    kernel: tuple[NDArray[np.int64], NDArray[np.float64]]
    moving: NDArray[np.bool_]

    def __call__(self, masses: Masses, least: float, back: bool, outside: float, moved: Masses) -> tuple[float, float]:
        moved[~self.moving] = masses[~self.moving]
        graph = self.graph
        found: tuple[float, float] = along_sequence(
            masses, self.moving, graph.first, graph.last, *self.kernel, least, back, moved
        )
        return found

    def matrix(self) -> Matrix:
        places = np.arange(len(self.graph))
        weights = np.zeros((len(places), len(places)))
        for offset, weight in zip(*self.kernel, strict=True):
            target = places + offset
            inside = (self.graph.first <= target) & (target < self.graph.last)
            weights[places[inside], target[inside]] = weight
        stays = ~self.moving | ~weights.any(axis=1)  # at rest, or in a sequence that is shorter than the stride
        weights[stays] = np.eye(len(places))[stays]
        return weights / weights.sum(axis=1, keepdims=True)


@dataclass(frozen=True, eq=False)
class AcrossTraverses:
    """Between the places of several traverses at one station, which show the same: EXCHANGED is shared out evenly.

    So a robot goes on along another traverse where one ends.  The matrix is its own transpose.
    """

    graph: PlaceGraph

    def __call__(self, masses: Masses, least: float, back: bool, outside: float, moved: Masses) -> tuple[float, float]:
        stations = self.graph.stations
        means = np.bincount(stations, weights=masses) / np.bincount(stations)
        moved[:] = (1 - EXCHANGED) * masses + EXCHANGED * means[stations]
        return 0.0, 0.0

    def matrix(self) -> Matrix:
        together = (self.graph.stations[:, np.newaxis] == self.graph.stations).astype(np.float64)
        return (1 - EXCHANGED) * np.eye(len(self.graph)) + EXCHANGED * together / together.sum(axis=1, keepdims=True)


def displacements(graph: PlaceGraph) -> NDArray[np.float64]:
    """Metres from place i to place j along the three coordinates, float64 [n, n, 3]; on the Earth the shorter way."""
    apart = graph.coordinates[np.newaxis] - graph.coordinates[:, np.newaxis]
    if graph.geographic:
        east = apart[..., 0]
        apart[..., 0] = np.where(np.abs(east) > HALF_TURN, east - np.copysign(2 * HALF_TURN, east), east)
    apart[..., 0] *= graph.shrink[:, np.newaxis]
    return apart


def _pose_matrix(graph: PlaceGraph, fits: NDArray[np.float64]) -> Matrix:
    """T_ij = w_ij / max(Σ_j w_ij, FITS), with the weight w_ij of the motion from place i to a joined place j.

    If even all joined places together fit worse than FITS, the robot was probably not at place i, or is where the map
    has no place: the motion is an observation, too.  Places without a pose keep their mass.
    """
    places = np.arange(len(graph))
    joined = np.zeros((len(graph), len(graph)), np.bool_)
    joined[np.repeat(places, np.diff(graph.starts)), graph.targets] = True
    weights = np.where(joined, fits, 0.0)
    matrix = weights / np.maximum(weights.sum(axis=1, keepdims=True), FITS)
    matrix[places[~graph.posed], places[~graph.posed]] = 1
    return matrix


@dataclass(frozen=True, eq=False)
class WithinReach:
    """To the joined places within ``reach`` metres alike, and a little to those just beyond it.

    A place b · ``softness`` metres beyond the reach has the weight exp(-b²/2); from b = 4 on it has none.
    """

    graph: PlaceGraph
    reach: float
    softness: float

    def __call__(self, masses: Masses, least: float, back: bool, outside: float, moved: Masses) -> tuple[float, float]:
        graph = self.graph
        moved[~graph.posed] = masses[~graph.posed]
        edges = (graph.starts, graph.targets, graph.coordinates, graph.shrink, _half_turn(graph))
        found: tuple[float, float] = within_reach(
            masses, *edges, self.reach, self.softness, least, back, outside, moved
        )
        return found

    def matrix(self) -> Matrix:
        beyond = (np.linalg.norm(displacements(self.graph), axis=2) - self.reach) / self.softness
        return _pose_matrix(self.graph, np.where(beyond < 4, np.exp(-0.5 * np.maximum(beyond, 0) ** 2), 0.0))


@dataclass(frozen=True, eq=False)
class ByOdometry:
    """To the joined places by how well each fits a motion.

    A place that the motion misses by d metres and, where both headings are known, by a turn of φ radians, has the
    weight exp(-m) with the misfit m = (precision · d² + turn_precision · φ²) / 2; from m = MISFIT on it has none.
    """

    graph: PlaceGraph
    odometry: Odometry
    precision: float
    turn_precision: float

    def __call__(self, masses: Masses, least: float, back: bool, outside: float, moved: Masses) -> tuple[float, float]:
        graph, odometry = self.graph, self.odometry
        moved[~graph.posed] = masses[~graph.posed]
        edges = (graph.starts, graph.targets, graph.coordinates, graph.shrink, _half_turn(graph))
        motion = (odometry.forward, odometry.left, odometry.turn, self.precision, self.turn_precision)
        found: tuple[float, float] = by_odometry(masses, *edges, graph.heading, motion, least, back, outside, moved)
        return found

    def matrix(self) -> Matrix:
        odometry, heading = self.odometry, self.graph.heading
        known = ~np.isnan(heading)
        cos, sin = np.cos(heading), np.sin(heading)
        ahead = np.stack([odometry.forward * cos - odometry.left * sin, odometry.forward * sin + odometry.left * cos])
        apart = displacements(self.graph)
        directed = np.square(apart[..., 0] - ahead[0][:, np.newaxis]) + np.square(
            apart[..., 1] - ahead[1][:, np.newaxis]
        )
        undirected = np.square(np.hypot(apart[..., 0], apart[..., 1]) - odometry.distance)
        missed = np.where(known[:, np.newaxis], directed, undirected) + np.square(apart[..., 2])
        turned = heading[np.newaxis] - heading[:, np.newaxis] - odometry.turn
        turned = np.nan_to_num(turned - 2 * np.pi * np.floor((turned + np.pi) / (2 * np.pi)))  # in [-π, π)
        misfit = 0.5 * self.precision * missed + 0.5 * self.turn_precision * np.square(turned)
        return _pose_matrix(self.graph, np.where(misfit < MISFIT, np.exp(-misfit), 0.0))


def _half_turn(graph: PlaceGraph) -> float:
    """Half of the way round along the first coordinate, in metres; infinite where it does not lead round."""
    return HALF_TURN if graph.geographic else math.inf


@dataclass(frozen=True, eq=False)
class Transition:
    """One step's transition on one graph: a few moves, one after the other.

    jumps: the robot may be anywhere; the moves are ignored.
    """

    moves: tuple[Move, ...]
    jumps: bool = False

    def forward(self, masses: Masses, floor: float) -> tuple[Masses, float, float]:
        """Move masses, float32 [n].

        Args:
            floor: masses up to this are not moved, but are to be spread over all places.

        Returns:
            The moved masses, float32 [n]; the mass to be spread over all places; the mass that has left the map.
        """
        if self.jumps:
            return np.zeros_like(masses), float(masses.sum(dtype=np.float64)), 0.0
        spread, gone = 0.0, 0.0
        for move in self.moves:
            moved = np.zeros_like(masses)
            negligible, left = move(masses, floor, False, 0.0, moved)
            masses, spread, gone = moved, spread + negligible, gone + left
        return masses if self.moves else masses.copy(), spread, gone

    def backward(self, values: Masses, outside: float) -> Masses:
        """The mean of ``values``, float32 [n], over the successors of each place; ``outside`` counts for the rest."""
        if self.jumps:
            return np.full_like(values, values.mean(dtype=np.float64))
        for move in reversed(self.moves):
            moved = np.zeros_like(values)
            move(values, 0.0, True, outside, moved)
            values = moved
        return values if self.moves else values.copy()


def by_poses(graph: PlaceGraph, step: Step) -> bool:
    """Whether places are gone to by their poses: there are some, and something is known about the motion."""
    return bool(graph.posed.any()) and (step.odometry is not None or step.reach is not None)


def along_sequences(graph: PlaceGraph, kernel: Kernel, moving: NDArray[np.bool_], times: int = 1) -> list[Move]:
    """The moves of places that go along their sequences, and on to their counterparts in other traverses."""
    moves: list[Move] = [AlongSequences(graph, kernel, moving)] * times
    return [*moves, AcrossTraverses(graph)] if len(graph.stations) else moves


def transition(graph: PlaceGraph, step: Step, stride: Stride | None, pending: Pending) -> Transition:
    """The transition of one step.

    Args:
        graph: of the map's places.
        step: the known motion.
        stride: the usual advance along a sequence; None: any of ``speeds.SPEEDS``, as before the first frame.
        pending: collects motion that is too small to apply, until it is enough; changed.
    """
    moves: list[Move] = []
    if step.frames > FARTHEST_STEPS:
        return Transition((), jumps=True)
    by_pose = by_poses(graph, step)
    along = ~graph.posed if by_pose else np.ones(len(graph), np.bool_)
    if along.any():
        kernel = mixture(PRIOR) if stride is None else stride.kernel()
        moves += along_sequences(graph, kernel, along, step.frames)
    if by_pose:
        further = _by_pose(graph, step, pending)
        if further is None:
            return Transition((), jumps=True)
        moves += further
    return Transition(tuple(moves))


def _by_pose(graph: PlaceGraph, step: Step, pending: Pending) -> list[Move] | None:
    """The moves of places with poses; None for a motion farther than the graph can follow."""
    shows = 0.5 * graph.spacing
    move: Move
    if step.odometry is not None:
        whole = pending.odometry.then(step.odometry)
        pending.reach = 0.0
        if whole.distance < shows and abs(whole.turn) < TURN_NOTED:
            pending.odometry = whole
            return []
        pending.odometry = Odometry(0.0)
        count = max(1, math.ceil(whole.distance / graph.reach)) if graph.reach else 1
        part = whole.part(min(count, FARTHEST_STEPS))
        precision = 1 / max(part.variance + shows**2 + (DRIFT * part.distance) ** 2, 1e-6)
        move = ByOdometry(graph, part, precision, 1 / (part.turn_variance + HEADING_SPREAD**2))
    else:
        assert step.reach is not None
        whole_reach = pending.reach + step.reach
        pending.odometry = Odometry(0.0)
        if whole_reach < shows:
            pending.reach = whole_reach
            return []
        pending.reach = 0.0
        count = max(1, math.ceil(whole_reach / graph.reach)) if graph.reach else 1
        move = WithinReach(graph, whole_reach / min(count, FARTHEST_STEPS), max(shows, 1e-3))
    return None if count > FARTHEST_STEPS else [move] * count
