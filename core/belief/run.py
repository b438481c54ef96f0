"""One robot's run: its belief, updated frame by frame, and the state from which it can be continued."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from core.belief.consistency import Contradiction, OdometryCheck
from core.belief.estimate import Estimate, estimate
from core.belief.evidence import NOTHING, Evidence, Sighting
from core.belief.filter import (
    CARRIED,
    JUMP,
    Belief,
    Smoother,
    contradicted,
    fits,
    observed,
    observed_by_speed,
    predicted,
    predicted_by_speed,
    reindexed,
    uninformed,
)
from core.belief.graph import PlaceGraph
from core.belief.motion import (
    FARTHEST_STEPS,
    TURN_NOTED,
    Odometry,
    Pending,
    Step,
    Stride,
    Transition,
    along_sequences,
    by_poses,
    transition,
)
from core.belief.odometry import FASTEST, OdometryPose, motion_between
from core.belief.speeds import PRIOR, SPEEDS, TRACKED, UNKNOWN, Speeds, mixture, news, plausible
from core.belief.storeys import UNSTATED, Storey, after_lift, later, undecided, weighed
from core.belief.view import HEIGHT, WIDTH, View, novelty
from core.places import NO_LEVEL

Sight = Literal["covered", "constant"]
"""Why a frame does not count: it shows hardly anything, or what the last frame that counted shows."""

LOST_AFTER = 5
"""After a first recognized frame, the robot is lost once this many frames in a row were not recognized."""

FIRST = 2.5
"""Weight of a run's first look.  Evidence counts less than half of what a frame says, because frames that follow one
another lead to the same mistakes (``evidence``); the first follows none."""

SAME_SPOT = 0.1
"""Weight of a further frame from the same spot: it shows the same things and leads to the same mistakes."""

FADING = 0.8
"""With each further frame that is covered, or constant and unlike the map, the robot is believed to see the map by this
factor less.  After three of them not even a belief that was sure is recognized.  So it is with frames that are new and
fit no better, beside what they say as evidence: on 24 ways out of corridor and lip6 no robot with odometry is answered
wrongly twice, where 16 were, and of 1864 right answers in other situations 3 are lost."""

MOST_PLACES = 512
"""The state has the probabilities of this many places; the others share the rest."""


@dataclass(frozen=True)
class RunOptions:
    """How the belief of a run is computed.

    stride: the usual advance along the sequence, used if neither odometry nor a speed limit is known; None: it is not
        known, and learnt.
    lag: after this many frames, the place of a frame is estimated again, given the frames since; 0: never.
    """

    stride: Stride | None = None
    lag: int = 0


REPLAYED = 12
"""Frames from which the belief is made anew, without odometry, once they have contradicted it."""

LISTED = 32
"""Of these frames, the places with most evidence are remembered."""


@dataclass(frozen=True, eq=False)
class CountedLook:
    """A frame that counted, for a belief that is made anew.

    seen: its evidence for the LISTED likeliest places.
    share: of a whole look, without odometry.
    frames, constant: the run's frames since the one before it that counted.
    change: of the view since then; None: not known.
    """

    seen: Evidence
    share: float
    frames: int
    constant: int
    change: float | None


@dataclass(frozen=True, eq=False)
class _Below:
    """The belief on the storey from which a robot climbs, what it stated there, and the metres that count so far."""

    belief: Belief
    storey: Storey
    climb: float


@dataclass(frozen=True, eq=False)
class RunState:
    """From what a run can be continued: all but the probabilities of the least likely places and the last frames.

    rows, masses: int64 [k] and float32 [k], the likeliest places and their probabilities if the robot sees the map.
    shares: float32 [k, S], the probabilities of the speeds there; [0, S]: as before the first frame.
    unknown: the probability that the robot does not see the map.
    frames, unrecognized: as of the :class:`Run`.
    odometry, reach: motion that was reported but not yet applied.
    view: the last frame that counted; None before the first.
    blind, constant, unlike: as of the :class:`Run`.
    pending_reach: metres that the robot may have moved in the constant frames.
    pose: as of the :class:`Run`.
    sighting: of the last frame that counted; None if it was not recognized by itself.
    storey: as of the :class:`Run`.
    check: of odometry, by what frames show.
    looks: the last frames that counted, the oldest first; none while odometry does not move the belief.
    """

    rows: NDArray[np.int64]
    masses: NDArray[np.float32]
    unknown: float
    frames: int
    unrecognized: int | None
    odometry: Odometry
    reach: float
    view: View | None = None
    blind: int = 0
    constant: int = 0
    pending_reach: float = 0.0
    pose: OdometryPose | None = None
    shares: NDArray[np.float32] = field(default_factory=lambda: UNKNOWN.shares)
    sighting: Sighting | None = None
    storey: Storey = UNSTATED
    check: OdometryCheck = field(default_factory=OdometryCheck)
    looks: tuple[CountedLook, ...] = ()
    unlike: float = 0.0


def _apart(speed: ArrayLike) -> NDArray[np.float64]:
    """The weight of frames at this distance, counted in the map's frames."""
    return np.clip(np.sqrt(speed), 1.0, FIRST)


def freshness(motion: Odometry | None, spacing: float) -> float:
    """The weight of a frame, from SAME_SPOT to 1: less than 1 if odometry is sure that the robot has hardly moved.

    What counts is the root mean square of the motion, by what odometry says and by how sure it is of that.

    Args:
        motion: since the last frame; None: it is not known.
        spacing: metres between places of the map; 0: they have no poses.
    """
    if motion is None or not spacing:
        return 1.0
    moved = math.sqrt(motion.distance**2 + 2 * motion.variance) / (0.5 * spacing)
    turned = math.sqrt(motion.turn**2 + motion.turn_variance) / TURN_NOTED
    return float(min(1.0, max(SAME_SPOT, moved, turned)))


class Run:
    """The belief of one run; two threads must not use it at the same time.

    frames: how many frames there were.
    unrecognized: how many frames since the last recognized one; None before the first.
    sight: why the last frame did not count; None if it did.
    blind: how many frames since the last one that gave evidence of a place, or of none in the map.
    constant: how many frames since the last one that counted showed the same as it.
    unlike: how many whole looks since the last recognized one neither fit where the robot is believed nor are
        recognized alone.
    pose: where odometry said that the robot was at the last frame; None if that had no such pose.
    storey: what was stated last of the robot's storey.
    """

    def __init__(self, options: RunOptions, graph: PlaceGraph) -> None:
        self.options, self.graph = options, graph
        self.frames = 0
        self.unrecognized: int | None = None
        self.belief = uninformed(len(graph))
        self.sight: Sight | None = None
        self.blind = self.constant = 0
        self.unlike = 0.0
        self.pose: OdometryPose | None = None
        self.storey = UNSTATED
        self._below: _Below | None = None
        self._view: View | None = None
        self._sighting: Sighting | None = None
        self._guided = False
        self._pending_reach = 0.0
        self._pending = Pending()
        self._smoother = Smoother(options.lag)
        self._check = OdometryCheck()
        self._looks: deque[CountedLook] = deque(maxlen=REPLAYED)

    @property
    def contradiction(self) -> Contradiction | None:
        """What is wrong with odometry, which then does not move the belief; None while nothing speaks against it."""
        return self._check.contradiction

    @property
    def lost(self) -> bool:
        """Whether the robot was recognized once, but not in the last frames."""
        return self.unrecognized is not None and self.unrecognized >= LOST_AFTER

    @property
    def bytes(self) -> int:
        """Upper bound of the run's memory in bytes, without the graph."""
        moments = 1 + (self.options.lag + 1 if self.options.lag else 0)
        speeds = 4 * (len(SPEEDS) + 1) * min(len(self.graph), TRACKED) if self.options.stride is None else 0
        return (4 * len(self.graph) + speeds) * moments + WIDTH * HEIGHT + 12 * LISTED * REPLAYED

    def place_on(self, graph: PlaceGraph) -> None:
        """Continue on another graph, after the map's places have changed."""
        if graph is not self.graph:
            self.belief, self._below = reindexed(self.belief, self.graph, graph), None
            self._smoother.clear()
            self.graph = graph

    def moved_to(self, pose: OdometryPose, seconds: float | None, speed_limit: float | None) -> Odometry | None:
        """The motion since the last frame, by where odometry says that the robot is now; nothing is changed.

        Args:
            pose: at the frame that comes next.
            seconds: since the last frame; None if that is not known.
            speed_limit: of the robot, metres per second.

        Returns:
            None if the motion is not known: the last frame had no pose, or odometry has begun anew since, as its origin
            or a motion says that is faster than the robot can be.
        """
        fastest = FASTEST if speed_limit is None else 2 * speed_limit
        return motion_between(self.pose, pose, None if seconds is None else fastest * seconds + self.graph.spacing)

    def advance(
        self, seen: Evidence, step: Step, view: View | None = None, pose: OdometryPose | None = None,
        storey: Storey = UNSTATED,
    ) -> None:  # fmt: skip
        """Update the belief with one frame.

        A frame that shows hardly anything is no evidence.  One that shows the same as the last one that counted is no
        second witness, and the robot is taken to stand, unless odometry or a speed limit gives its motion among
        the poses of the map.  A frame that shows partly the same counts in part.

        Args:
            seen: the evidence of the frame.
            step: the motion since the frame before; ignored for the first frame.
            view: the view of the frame; None: not known, and taken to be new.
            pose: where odometry says that the robot is, from which the motion to the next frame is computed.
            storey: what the robot states of its storey.
        """
        self._climb(storey)
        change = None if view is None or self._view is None else view.change(self._view)
        new = 1.0 if change is None else novelty(change)
        fitting = fits(self.belief, seen, self.graph) or (self._confirms(seen.sighting) and not self._moves_on(step))
        shows_nothing = seen is NOTHING and len(self.graph) > 0
        if shows_nothing or (view is not None and view.uniform and not fitting):
            self.sight, seen, share, change = "covered", NOTHING, 1.0, None
            self.blind += 1
        elif not new:
            self.sight, seen, share = "constant", NOTHING, 0.0
            self.blind = 0 if fitting else self.blind + 1
        else:
            self.sight, self.blind, share = None, 0, new
            self._view = view or self._view
        if self.sight != "constant":  # a view that stays shows what it has shown
            self._sighting = seen.sighting
        step = self._trusted(step, seen, share, change, pose)
        self._guided = by_poses(self.graph, step)
        stands = self.sight == "constant" and (step.odometry is None or not self._guided)
        fitting = self._filter(seen, step, share, stands, change)
        if self.sight is None:
            expected = self.unlike > 0 or self.unrecognized == 0
            unlike = expected and not fitting and seen.sighting is None
            self.unlike = self.unlike + min(share, self._freshness(step)) if unlike else 0.0
        self.constant = self.constant + 1 if stands else 0
        self.pose = pose
        self.frames += 1

    def _climb(self, storey: Storey) -> None:
        """Take in what the robot states of its storey; one that the map does not have says nothing."""
        if storey.level != NO_LEVEL and not (self.graph.whereabouts.level == storey.level).any():
            storey = replace(storey, level=NO_LEVEL)
        limit, before = self.graph.neighborhood.height, self.storey
        self.storey, climb = later(before, storey, limit)
        if climb is None or not self.frames:
            if self._below is not None:  # it has come back
                self.belief = self._below.belief
            self._below = None
            return
        below = self._below or _Below(self.belief, before, math.nan)
        if not abs(climb - below.climb) <= limit / 3:
            self.belief = after_lift(below.belief, self.graph, below.storey, self.storey, climb)
            self._smoother.clear()
            below = replace(below, climb=climb)
        self._below = below if self.storey.climbs(limit) else None

    def _moves_on(self, step: Step) -> bool:
        """Whether odometry that nothing contradicts has left the place of the last frame that was recognized."""
        if step.odometry is None or self.contradiction is not None:
            return False
        moved = self._check.path + step.odometry.distance
        return moved > max(self.graph.neighborhood.radius, self.graph.spacing)

    def _trusted(
        self, step: Step, seen: Evidence, share: float, change: float | None, pose: OdometryPose | None
    ) -> Step:
        """The step without odometry that frames contradict.

        Once they do, the belief is made anew from the last frames, for it has been led astray.
        """
        if not self.graph.posed.any() or (step.odometry is None and pose is None):
            self._check = OdometryCheck()
            self._looks.clear()
            return step
        before = self.contradiction
        self._check = self._check.moved(step.odometry)
        counts = self.sight is None
        if counts:
            self._check = self._check.sighted(seen, pose, self.graph)
        if self.contradiction is not None and before is None:
            self._begin_anew()
        if counts:
            self._looks.append(CountedLook(seen.strongest(LISTED), share, step.frames, 0, change))
        elif self._looks and self.sight == "constant":
            self._looks[-1] = replace(self._looks[-1], constant=self._looks[-1].constant + 1)
        return step if self.contradiction is None else replace(step, odometry=None)

    def _begin_anew(self) -> None:
        """Make the belief anew from the last frames that counted, by the sequences of the map alone."""
        self.belief, self._pending = uninformed(len(self.graph)), Pending()
        self._smoother.clear()
        frames, self.frames, self.constant = self.frames, 0, 0
        for look in self._looks:
            self._filter(look.seen, Step(frames=look.frames), look.share, False, look.change)
            self.frames, self.constant = self.frames + 1, look.constant
        self.frames = frames

    def _confirms(self, sighting: Sighting | None) -> bool:
        """Whether a frame is recognized by itself where the last one that counted was."""
        if sighting is None or self._sighting is None:
            return False
        here, there = self.graph.places_at(np.array([self._sighting.row, sighting.row])).tolist()
        return here >= 0 and there in self.graph.same_place(here)

    def _filter(self, whole: Evidence, step: Step, share: float, stands: bool, change: float | None) -> bool:
        """Move the belief and weigh it by what was seen, and by how much the view has changed, if that is known.

        Returns:
            Whether what was seen is likelier where the robot is believed after its motion than outside of the map.
        """
        share = min(share, self._freshness(step))
        seen = whole.tempered(share * self._independence(step))
        moved, ahead = Transition(()), self.belief
        if not self.frames or stands:
            self._pending_reach = min(self._pending_reach + (step.reach or 0.0), self.graph.spacing)
            ahead = predicted(self.belief, moved, share) if self.frames else self.belief
        elif self._by_speed(step) and step.known and step.frames <= FARTHEST_STEPS:
            if self.options.lag:
                kernel = mixture(self.belief.speeds.overall(self.belief.given), step.frames, self.constant)
                everywhere = np.ones(len(self.graph), np.bool_)
                moved = Transition(tuple(along_sequences(self.graph, kernel, everywhere)))
            ahead = predicted_by_speed(self.belief, self.graph, step.frames, self.constant, share)
        else:
            stride = self._stride() if step.known else None
            moved = transition(self.graph, self._caught_up(step), stride, self._pending)
            self._pending_reach = 0.0
            ahead = predicted(self.belief, moved, share, JUMP if step.known else CARRIED)
        fitting = fits(ahead, whole, self.graph)
        if self.frames and share and self._by_speed(step):
            if change is not None:
                ahead = contradicted(ahead, plausible(change, step.frames, self.constant))
            new = np.minimum(1, news(step.frames, self.constant) / np.float32(share))
            self.belief = observed_by_speed(ahead, seen, self.graph, new)
        else:
            self.belief = observed(ahead, seen, self.graph)
        if len(seen.storeys):
            self.belief = undecided(ahead, self.belief, self.graph, seen.storeys)
        if self.options.lag:
            if not step.known:
                self._smoother.clear()
            self._smoother.append(self.belief, moved, seen, share)
        return fitting

    def _by_speed(self, step: Step) -> bool:
        """Whether the robot goes along the sequences at a speed that is to be learnt."""
        return self.options.stride is None and not by_poses(self.graph, step)

    def _independence(self, step: Step) -> float:
        """The weight of a frame as evidence, relative to one that follows another closely.

        Frames that are some of the map's frames apart make fewer mistakes in common: the weight grows with the root of
        the speed, up to that of a first look, after ``frames`` frames without evidence.
        """
        if self.blind == self.frames:
            return FIRST
        if by_poses(self.graph, step):
            return 1.0
        if self.options.stride is not None:
            return float(_apart(self.options.stride.advance))
        return float(self.belief.speeds.overall(self.belief.given) @ _apart(np.abs(SPEEDS)))

    def _stride(self) -> Stride | None:
        """The usual advance since the last frame in which the view changed: at most one place more than usual."""
        usual = self.options.stride
        if usual is None:
            return None
        return Stride(max(usual.advance, min(1.0, usual.advance * (1 + self.constant))), usual.backwards)

    def _caught_up(self, step: Step) -> Step:
        """The motion with what the robot may have moved while its view seemed the same: at most to the next place."""
        return step if step.reach is None else replace(step, reach=step.reach + self._pending_reach)

    def _freshness(self, step: Step) -> float:
        return freshness(step.odometry, self.graph.spacing) if self.frames else 1.0

    def estimate(self, count: int, alive: NDArray[np.bool_]) -> Estimate:
        """Where the robot is; this counts unrecognized frames, so call it once for each frame.

        Args:
            count: how many candidates to list.
            alive: bool [rows of the map]; places that were removed since the graph was made are not listed.
        """
        found = self.look(count, alive)
        if found.verdict == "recognized":
            self.unrecognized = 0
        elif self.unrecognized is not None:
            self.unrecognized += 1
        return found

    def look(self, count: int, alive: NDArray[np.bool_]) -> Estimate:
        """Where the robot is, without counting: for calls between two frames."""
        sighting = self._sighting
        if sighting is not None and self.blind:
            sighting = replace(sighting, probability=sighting.probability * FADING**self.blind)
        return self._estimate(self._now(), count, alive, sighting)

    def earlier(self, count: int, alive: NDArray[np.bool_]) -> Estimate | None:
        """Where the robot was ``lag`` frames ago, given all frames since; None if that is not known."""
        smoothed = self._smoother.smoothed(self.graph) if self.options.lag else None
        return None if smoothed is None else self._estimate(smoothed, count, alive)

    def _estimate(
        self, belief: Belief, count: int, alive: NDArray[np.bool_], sighting: Sighting | None = None
    ) -> Estimate:
        rows = self.graph.rows
        there = (rows < len(alive)) & alive[np.minimum(rows, max(len(alive) - 1, 0))] if len(alive) else rows < 0
        if not there.all():
            gone = float(belief.given[~there].sum(dtype=np.float64))
            unknown = belief.unknown + (1 - belief.unknown) * gone
            given = np.where(there, belief.given, np.float32(0)) / np.float32(max(1 - gone, 1e-9))
            belief = Belief(given.astype(np.float32), min(unknown, 1.0))
            if sighting is not None and not (sighting.row < len(alive) and alive[sighting.row]):
                sighting = None
        return estimate(belief, self.graph, count, sighting, self._guided)

    def _now(self) -> Belief:
        """The present belief; the belief to see the map fades while the view is covered, or unlike what is believed."""
        faded = FADING ** (self.blind + self.unlike)
        shown = weighed(self.belief, self.graph, self.storey)
        return replace(shown, unknown=1 - (1 - shown.unknown) * faded)

    def state(self) -> RunState:
        """The state from which the run can be continued."""
        masses = self.belief.given
        best = (
            np.argpartition(-masses, MOST_PLACES)[:MOST_PLACES] if len(masses) > MOST_PLACES else np.arange(len(masses))
        )
        return RunState(
            self.graph.rows[best],
            masses[best],
            self.belief.unknown,
            self.frames,
            self.unrecognized,
            self._pending.odometry,
            self._pending.reach,
            self._view,
            self.blind,
            self.constant,
            self._pending_reach,
            self.pose,
            self.belief.speeds.at(best),
            self._sighting,
            self.storey,
            self._check,
            tuple(self._looks),
            self.unlike,
        )

    @classmethod
    def restored(cls, options: RunOptions, graph: PlaceGraph, state: RunState) -> Run:
        """Continue a run from its state; removed places are left out, the others share what the state does not have."""
        run = cls(options, graph)
        run.frames, run.unrecognized = state.frames, state.unrecognized
        run._pending = Pending(state.odometry, state.reach)
        run._view, run.blind, run.constant = state.view, state.blind, state.constant
        run._pending_reach, run.pose, run._sighting = state.pending_reach, state.pose, state.sighting
        run.storey = state.storey.arrived() if state.storey.climbs(graph.neighborhood.height) else state.storey
        run._check, run._looks, run.unlike = state.check, deque(state.looks, REPLAYED), state.unlike
        if state.frames and len(graph):
            rest = max(0.0, 1 - float(state.masses.sum(dtype=np.float64)))
            given = np.full(len(graph), max(rest / len(graph), 1e-12), np.float32)
            places = graph.places_at(state.rows)
            given[places[places >= 0]] = np.maximum(state.masses[places >= 0], given[0])
            lost = float(state.masses[places < 0].sum(dtype=np.float64))
            unknown = state.unknown + (1 - state.unknown) * min(lost, 1.0)
            retained = np.flatnonzero(places[: len(state.shares)] >= 0)
            given /= np.float32(given.sum(dtype=np.float64))
            speeds = Speeds(places[retained], state.shares[retained], PRIOR)
            run.belief = Belief(given, unknown, speeds=replace(speeds, elsewhere=speeds.expected(given)))
        return run
