"""Where a robot was at each frame of a whole run, by all other frames: forward and backward over the run.

The chain is that of ``core.belief.filter``, with its transitions and rates, and its states are told apart further: the
robot is at a place and sees it; it is at a place and does not see it, as its view is blocked or the place has never
looked so; or it is away, where the map has no place.  A robot that sees nothing goes on from place to place as its
odometry says, so that the frames after a dark stretch say where it was within.  Forward and backward variables are
those of Rabiner (A tutorial on hidden Markov models, Proceedings of the IEEE 77(2), 1989, equations 20 and 25), scaled.

The evidence of the frame itself is left out, or a frame that is mistaken would prove itself.  Frames that show the same
as the one before add no evidence of their own, so that a robot that stands proves nothing by repetition.

Of each frame the likeliest places are stored, and how probable each of the others is: the memory of a run grows by some
kilobytes for each frame, however large the map is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from core.belief.evidence import Evidence
from core.belief.filter import ALIKE, JUMP, LEAVING, MANY, RETURNING, START_UNKNOWN
from core.belief.graph import PlaceGraph
from core.belief.motion import Masses, Pending, Step, Stride, Transition, transition

LOSING = 0.02
"""Probability, at each look, that a robot that does not see the map is not at any of its places any more.  In maps
without poses, motion alone does not tell that a robot has left the way.  On three dark runs through corridor, 77 of 345
frames are placed with a certainty of 0.95, and with 0 there would be 91, all of them right (with a ``WEIGHT`` of 1):
the cautious value was taken."""

WEIGHT = 1.5
"""Weight of a frame's evidence, relative to that in a belief: there, less than half of what a frame says is counted, as
every mistake is believed at once; here, the frames after it contradict it.  With 1.5, in a year of runs on corridor,
lip6, nordland and fixed cameras (``python -m benchmarks.learning``, maps without learnt looks), 5 338 of 7 423 frames
are placed with a certainty of 0.95 by the others, all of them right within two places; with 1, 5 140; with 2, 5 524, of
which 4 are wrong."""

STORED = 512
"""At most this many places of each frame are stored with probabilities of their own."""


@dataclass(frozen=True)
class WeighedFrame:
    """One frame, as the smoother takes it.

    seen: its evidence; ``NOTHING`` for a covered one.
    step: the motion since the frame before.
    share: the part of a whole look that the frame counts as, from 0 to 1; 0 for one that shows the same as before.
    stride: how far the robot went along the sequences, for places without poses; None: not known.
    """

    seen: Evidence
    step: Step
    share: float = 1.0
    stride: Stride | None = None


@dataclass(frozen=True, eq=False)
class Posterior:
    """Where the robot was at one frame, by all frames but this one.

    places: int32 [k], of the graph, the likeliest ones.
    probabilities: float32 [k]; they sum to at most 1.
    elsewhere: the probability of each other place.
    away: the probability of being at no place of the map.
    """

    places: NDArray[np.int32]
    probabilities: Masses
    elsewhere: float
    away: float

    def at(self, places: NDArray[np.integer]) -> float:
        """The probability of being at one of some places, each named once; int [m]."""
        own = np.isin(self.places, places)
        others = len(places) - int(own.sum())
        return float(self.probabilities[own].sum(dtype=np.float64)) + others * self.elsewhere

    @property
    def best(self) -> int | None:
        """The likeliest place; None in an empty map."""
        return int(self.places[np.argmax(self.probabilities)]) if len(self.places) else None


@dataclass(frozen=True, eq=False)
class _States:
    """A value for each state: at each place seeing and not seeing it, float32 [n] each, and away."""

    seeing: Masses
    blind: Masses
    away: float

    def scaled(self, by: float) -> _States:
        factor = np.float32(1 / max(by, 1e-30))
        return _States(self.seeing * factor, self.blind * factor, self.away / max(by, 1e-30))

    @property
    def total(self) -> float:
        return float(self.seeing.sum(dtype=np.float64) + self.blind.sum(dtype=np.float64)) + self.away

    @property
    def largest(self) -> float:
        return max(float(self.seeing.max(initial=0)), float(self.blind.max(initial=0)), self.away)

    def weighed(self, seen: Evidence, graph: PlaceGraph) -> _States:
        """Times the likelihoods of a frame, up to a common factor."""
        places, gains = graph.evidence_at(seen)
        scale = max(0.0, seen.unknown, float(gains.max(initial=0)))
        seeing = self.seeing * np.float32(np.exp(-scale))
        seeing[places] = self.seeing[places] * np.exp(gains - np.float32(scale))
        hidden = float(np.exp(seen.unknown - scale))
        return _States(seeing, self.blind * np.float32(hidden), self.away * hidden)


@dataclass(frozen=True, eq=False)
class _Stored:
    """A forward variable of one frame, before its evidence, of the likeliest places alone.

    others: the mean of those that are not stored, for seeing and blind.
    """

    places: NDArray[np.int32]
    seeing: Masses
    blind: Masses
    others: tuple[float, float]
    away: float

    @classmethod
    def of(cls, states: _States, stored: int) -> _Stored:
        both = states.seeing + states.blind
        count = len(both)
        places = np.arange(count) if count <= stored else np.argpartition(-both, stored)[:stored]
        left = max(count - len(places), 1)
        seeing, blind = states.seeing[places], states.blind[places]
        rest = (
            max(0.0, float(whole.sum(dtype=np.float64) - part.sum(dtype=np.float64))) / left
            for whole, part in ((states.seeing, seeing), (states.blind, blind))
        )
        first, second = rest
        return cls(places.astype(np.int32), seeing, blind, (first, second), states.away)

    def times(self, later: _States) -> Posterior:
        """The product with a backward variable, normalized."""
        own = self.seeing * later.seeing[self.places] + self.blind * later.blind[self.places]
        left = len(later.seeing) - len(self.places)
        others = 0.0
        if left:
            sums = (
                float(whole.sum(dtype=np.float64) - whole[self.places].sum(dtype=np.float64))
                for whole in (later.seeing, later.blind)
            )
            others = sum(mean * max(0.0, rest) for mean, rest in zip(self.others, sums, strict=True))
        away = self.away * later.away
        total = float(own.sum(dtype=np.float64)) + others + away
        if not total > 0:  # the frames before contradict those after
            return Posterior(self.places[:0], own[:0], 0.0, 1.0)
        elsewhere = others / left / total if left else 0.0
        return Posterior(self.places, (own / np.float32(total)).astype(np.float32), elsewhere, away / total)


def smoothed(looks: Sequence[WeighedFrame], graph: PlaceGraph, stored: int = STORED) -> list[Posterior]:
    """The posterior of each frame of a run by all other frames, its own evidence left out.

    Args:
        graph: of the map's places.
        stored: how many places of each frame are stored with probabilities of their own.

    Returns:
        One for each look, in their order; the time grows with frames times places.
    """
    n = len(graph)
    if not n:
        nothing = np.empty(0, np.float32)
        return [Posterior(np.empty(0, np.int32), nothing, 0.0, 1.0) for _ in looks]
    pending, moved, before = Pending(), [], []
    states = _start(n)
    for number, look in enumerate(looks):
        if number:
            step = transition(graph, look.step, look.stride, pending)
            states = _ahead(states, step, look.share)
        else:
            step = Transition(())
        moved.append(step)
        before.append(_Stored.of(states, stored))
        states = states.weighed(_tempered(look), graph)
        states = states.scaled(states.total) if states.total > 0 else _start(n)
    later = _States(np.ones(n, np.float32), np.ones(n, np.float32), 1.0)
    found = []
    for number in range(len(looks) - 1, -1, -1):
        found.append(before[number].times(later))
        if number:
            later = _behind(later.weighed(_tempered(looks[number]), graph), moved[number], looks[number].share)
            later = later.scaled(later.largest)
    return found[::-1]


def _tempered(look: WeighedFrame) -> Evidence:
    return look.seen.tempered(WEIGHT * look.share)


def _start(n: int) -> _States:
    seen = np.float32((1 - START_UNKNOWN) / n)
    half = 0.5 * START_UNKNOWN
    return _States(np.full(n, seen, np.float32), np.full(n, half / n, np.float32), half)


def _ahead(states: _States, step: Transition, share: float) -> _States:
    """The states after a motion, and before the frame."""
    n = len(states.seeing)
    leaving, returning, losing, jump = (share * rate for rate in (LEAVING, RETURNING, LOSING, JUMP))
    away = states.away
    moved = []
    for masses in (states.seeing, states.blind):
        there, spread, gone = step.forward(masses, ALIKE * float(masses.min()) if n >= MANY else 0.0)
        total = float(masses.sum(dtype=np.float64))
        there = (1 - jump) * there + np.float32(((1 - jump) * spread + jump * total) / n)
        moved.append(there.astype(np.float32))
        away += (1 - jump) * gone
    seeing, blind = moved
    found = returning * away
    lost = losing * float(blind.sum(dtype=np.float64))
    return _States(
        np.asarray((1 - leaving) * seeing + returning * (1 - losing) * blind + np.float32(found / n), np.float32),
        np.asarray(leaving * seeing + (1 - returning) * (1 - losing) * blind, np.float32),
        away - found + lost,
    )


def _behind(states: _States, step: Transition, share: float) -> _States:
    """How likely the later frames are by the state before the motion, from the state after it; :func:`_ahead` turned
    round."""
    leaving, returning, losing, jump = (share * rate for rate in (LEAVING, RETURNING, LOSING, JUMP))
    outside = returning * float(states.seeing.mean(dtype=np.float64)) + (1 - returning) * states.away
    seeing = (1 - leaving) * states.seeing + leaving * states.blind
    blind = (1 - losing) * (returning * states.seeing + (1 - returning) * states.blind) + losing * states.away
    before = []
    for values in (seeing, blind):
        mean = float(values.mean(dtype=np.float64))
        there = step.backward(values.astype(np.float32), outside)
        before.append(((1 - jump) * there + np.float32(jump * mean)).astype(np.float32))
    return _States(before[0], before[1], outside)
