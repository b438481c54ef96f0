"""How a robot gets from place to place between two frames.

Three models, each a transition matrix that is never written out: along the sequence (nothing is known but the order
of the frames), within reach (a speed limit and the time between frames), by odometry (how far, which way, how
sure).  The last two need poses; places without one always go along their sequence.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from core.belief.graph import PlaceGraph
from core.kernels.belief_moves import along_sequence, by_odometry, within_reach
from core.places import EARTH_RADIUS

Masses = NDArray[np.float32]

FARTHEST_STEPS = 16
"""A motion of more reaches than this is as good as a jump: it leaves no belief in any place."""

DRIFT = 0.1
"""Standard deviation of odometry beside what it says of itself: wheels slip by a tenth."""

HEADING_SPREAD = math.radians(20)
"""Standard deviation between a place's heading and that of a robot that sees the same."""

TURN_NOTED = math.radians(15)
"""A robot that has turned by this much sees something else, wherever it stands."""


@dataclass(frozen=True)
class Stride:
    """Frames of a map's sequence that go by from one frame of a run to the next.

    advance: the usual number, at least 0: 1 for a robot at the pace of the traverse, 0.1 for a camera ten times as
        fast.
    backwards: whether it may go against the sequence as readily; else a frame's slip is allowed.
    """

    advance: float = 1.0
    backwards: bool = False

    def kernel(self) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Offsets along the sequence and their probabilities: two-sided exponential around ``advance``.

        The scale is half a frame and two fifths of the advance, so that a pace that is not known well, as it never
        is, costs little.
        """
        scale = 0.5 + 0.4 * self.advance
        farthest = math.ceil(self.advance + 4 * scale)
        offsets = np.arange(-farthest if self.backwards else -1, farthest + 1)
        away = np.abs(np.abs(offsets) - self.advance) if self.backwards else np.abs(offsets - self.advance)
        weights = np.exp(-away / scale)
        return offsets, weights / weights.sum()


@dataclass(frozen=True)
class Odometry:
    """Motion since the frame before, in the robot's frame of then: metres and radians, with variances."""

    forward: float
    left: float = 0.0
    turn: float = 0.0
    variance: float = 0.0
    turn_variance: float = 0.0

    def then(self, other: Odometry) -> Odometry:
        """This motion, followed by another."""
        cos, sin = math.cos(self.turn), math.sin(self.turn)
        swing = self.turn_variance * (other.forward**2 + other.left**2)  # a turn not known well moves what follows
        return Odometry(
            self.forward + cos * other.forward - sin * other.left,
            self.left + sin * other.forward + cos * other.left,
            self.turn + other.turn,
            self.variance + other.variance + swing,
            self.turn_variance + other.turn_variance,
        )

    def part(self, count: int) -> Odometry:
        """The ``count``-th part of it, taken as a straight line in the direction of the whole and then the turn."""
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
        """Metres as the crow flies."""
        return math.hypot(self.forward, self.left)


@dataclass(frozen=True)
class Step:
    """What is known of the motion between two frames; nothing, in a run's first.

    odometry: None where the robot tells none.
    reach: metres that it can have gone, by its speed limit and the time between; None where that is not known.
    frames: by how many the run's frame number grew; 1 where every frame arrives.
    """

    odometry: Odometry | None = None
    reach: float | None = None
    frames: int = 1


@dataclass
class Pending:
    """Motion told and not yet applied: less than half the distance between places, which no place would show."""

    odometry: Odometry = field(default_factory=lambda: Odometry(0.0))
    reach: float = 0.0


Move = Callable[[Masses, float, bool, float, Masses], tuple[float, float]]
"""As the loops of ``moves.py`` are called: masses, the most not worth moving, whether to turn the matrix over, the
value of being out of the map, and where to put the result."""


@dataclass(frozen=True, eq=False)
class Transition:
    """One step's matrix on one graph: a few moves, one after the other.

    jumps: nothing that a place held stays near it; the moves are not looked at.
    """

    moves: tuple[Move, ...]
    jumps: bool = False

    def forward(self, masses: Masses, floor: float) -> tuple[Masses, float, float]:
        """Where masses float32 [n] go, what of them is to be spread over all places, and what has left the map.

        Args:
            floor: masses up to this are spread instead of moved: what all hold alike stays alike.
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
        """The mean of ``values`` float32 [n] over the successors of each place; ``outside`` where there is none."""
        if self.jumps:
            return np.full_like(values, values.mean(dtype=np.float64))
        for move in reversed(self.moves):
            moved = np.zeros_like(values)
            move(values, 0.0, True, outside, moved)
            values = moved
        return values if self.moves else values.copy()


def transition(graph: PlaceGraph, step: Step, stride: Stride, pending: Pending) -> Transition:
    """The matrix of one step.

    Args:
        pending: motion too small to show is put into it, and taken out when it has become enough.
    """
    moves: list[Move] = []
    if step.frames > FARTHEST_STEPS:
        return Transition((), jumps=True)
    told = graph.posed.any() and (step.odometry is not None or step.reach is not None)
    along = ~graph.posed if told else np.ones(len(graph), np.bool_)
    offsets, weights = stride.kernel()

    def go_along(p: Masses, least: float, back: bool, outside: float, moved: Masses) -> tuple[float, float]:
        moved[~along] = p[~along]
        found: tuple[float, float] = along_sequence(
            p, along, graph.first, graph.last, offsets, weights, least, back, moved
        )
        return found

    if along.any():
        moves += [go_along] * step.frames
    if told:
        further = _by_pose(graph, step, pending, along)
        if further is None:
            return Transition((), jumps=True)
        moves += further
    return Transition(tuple(moves))


def _by_pose(graph: PlaceGraph, step: Step, pending: Pending, along: NDArray[np.bool_]) -> list[Move] | None:
    """The moves of places with poses; None for a motion farther than the graph can follow."""
    shows = 0.5 * graph.spacing
    half_turn = math.pi * EARTH_RADIUS if graph.geographic else math.inf
    geometry = (graph.starts, graph.targets, graph.coordinates, graph.shrink)
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
        turn_precision = 1 / (part.turn_variance + HEADING_SPREAD**2)
        motion = (part.forward, part.left, part.turn, precision, turn_precision)

        def go(p: Masses, least: float, back: bool, outside: float, moved: Masses) -> tuple[float, float]:
            moved[along] = p[along]
            found: tuple[float, float] = by_odometry(
                p, *geometry, half_turn, graph.heading, motion, least, back, outside, moved
            )
            return found

    else:
        assert step.reach is not None
        whole_reach = pending.reach + step.reach
        pending.odometry = Odometry(0.0)
        if whole_reach < shows:
            pending.reach = whole_reach
            return []
        pending.reach = 0.0
        count = max(1, math.ceil(whole_reach / graph.reach)) if graph.reach else 1
        reach, softness = whole_reach / min(count, FARTHEST_STEPS), max(shows, 1e-3)

        def go(p: Masses, least: float, back: bool, outside: float, moved: Masses) -> tuple[float, float]:
            moved[along] = p[along]
            found: tuple[float, float] = within_reach(
                p, *geometry, half_turn, reach, softness, least, back, outside, moved
            )
            return found

    return None if count > FARTHEST_STEPS else [go] * count
