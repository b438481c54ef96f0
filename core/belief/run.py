"""One robot's run: its belief, updated frame by frame, and the state from which it can be continued."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from core.belief.estimate import Estimate, estimate
from core.belief.evidence import NOTHING, Evidence
from core.belief.filter import Belief, Smoother, fits, observed, predicted, reindexed, uninformed
from core.belief.graph import PlaceGraph
from core.belief.motion import TURN_NOTED, Odometry, Pending, Step, Stride, Transition, transition
from core.belief.paths import PathSearch
from core.belief.view import HEIGHT, WIDTH, View, novelty

Sight = Literal["covered", "constant"]
"""Why a frame does not count: it shows hardly anything, or what the last frame that counted shows."""

LOST_AFTER = 5
"""After a first recognized frame, the robot is lost once this many frames in a row were not recognized."""

STANDING = 0.1
"""Weight of a further frame from the same spot: it shows the same things and leads to the same mistakes."""

FADING = 0.8
"""With each further frame that is covered, or constant and unlike the map, the robot is believed to see the map by this
factor less.  After three of them not even a belief that was sure is recognized."""

KEPT = 512
"""The state has the probabilities of this many places; the others share the rest."""


@dataclass(frozen=True)
class RunOptions:
    """How the belief of a run is computed.

    filter: ``bayes``, the hidden Markov model, or ``path``, the search for straight paths.
    stride: the usual advance along the sequence, used if neither odometry nor a speed limit is known.
    lag: after this many frames, the place of a frame is estimated again, given the frames since; 0: never.  Only for
        ``bayes``.
    path_frames: frames of a path.  Only for ``path``.
    """

    filter: Literal["bayes", "path"] = "bayes"
    stride: Stride = field(default_factory=Stride)
    lag: int = 0
    path_frames: int = 10


@dataclass(frozen=True, eq=False)
class RunState:
    """From what a run can be continued: all but the probabilities of the least likely places and the last frames.

    rows, masses: int64 [k] and float32 [k], the likeliest places and their probabilities if the robot sees the map.
    unknown: the probability that the robot does not see the map.
    frames, unrecognized: as of the :class:`Run`.
    odometry, reach: motion that was reported but not yet applied.
    seen: the evidence that the path search still uses.
    view: the last frame that counted; None before the first.
    blind, constant: as of the :class:`Run`.
    pending_reach: metres that the robot may have moved in the constant frames.
    """

    rows: NDArray[np.int64]
    masses: NDArray[np.float32]
    unknown: float
    frames: int
    unrecognized: int | None
    odometry: Odometry
    reach: float
    seen: tuple[Evidence, ...]
    view: View | None = None
    blind: int = 0
    constant: int = 0
    pending_reach: float = 0.0


class Run:
    """The belief of one run; two threads must not use it at the same time.

    frames: how many frames there were.
    unrecognized: how many frames since the last recognized one; None before the first.
    sight: why the last frame did not count; None if it did.
    blind: how many frames since the last one that told where the robot is, or that it is not in the map.
    constant: how many frames since the last one that counted showed the same as it.
    """

    def __init__(self, options: RunOptions, graph: PlaceGraph) -> None:
        self.options, self.graph = options, graph
        self.frames = 0
        self.unrecognized: int | None = None
        self.belief = uninformed(len(graph))
        self.sight: Sight | None = None
        self.blind = self.constant = 0
        self._view: View | None = None
        self._pending_reach = 0.0
        self._pending = Pending()
        self._smoother = Smoother(options.lag)
        self._paths = PathSearch(options.path_frames)

    @property
    def lost(self) -> bool:
        """Whether the robot was recognized once, but not in the last frames."""
        return self.unrecognized is not None and self.unrecognized >= LOST_AFTER

    @property
    def bytes(self) -> int:
        """Upper bound of the run's memory in bytes, without the graph."""
        moments = 1 + (self.options.lag + 1 if self.options.lag else 0)
        return 4 * len(self.graph) * moments + 2048 * self.options.path_frames + WIDTH * HEIGHT

    def place_on(self, graph: PlaceGraph) -> None:
        """Continue on another graph, after the map's places have changed."""
        if graph is not self.graph:
            self.belief = reindexed(self.belief, self.graph, graph)
            self._smoother.clear()
            self.graph = graph

    def advance(self, seen: Evidence, step: Step, view: View | None = None) -> None:
        """Update the belief with one frame.

        A frame that shows hardly anything tells nothing.  One that shows the same as the last one that counted is no
        second witness, and without odometry the robot is taken to stand.  A frame that shows partly the same counts in
        part.

        Args:
            seen: the evidence of the frame.
            step: the motion since the frame before; ignored for the first frame.
            view: what the frame shows; None: it is not known, and taken to be new.
        """
        change = 1.0 if view is None or self._view is None else novelty(view.change(self._view))
        fitting = fits(self.belief, seen, self.graph)
        shows_nothing = seen is NOTHING and len(self.graph) > 0
        if shows_nothing or (view is not None and view.uniform and not fitting):
            self.sight, seen, share = "covered", NOTHING, 1.0
            self.blind += 1
        elif not change:
            self.sight, seen, share = "constant", NOTHING, 0.0
            self.blind = 0 if fitting else self.blind + 1
        else:
            self.sight, self.blind, share = None, 0, change
            self._view = view or self._view
        stands = self.sight == "constant" and step.odometry is None
        if self.options.filter == "path":
            if not stands:
                self._paths.append(seen.tempered(share), step.frames - 1)
                self.belief = self._paths.belief(self.graph, self.options.stride)
        else:
            self._filter(seen, step, share, stands)
        self.constant = self.constant + 1 if stands else 0
        self.frames += 1

    def _filter(self, seen: Evidence, step: Step, share: float, stands: bool) -> None:
        """Move the belief and weigh it by what was seen."""
        share = min(share, self._freshness(step))
        seen = seen.tempered(share)
        if not self.frames or stands:
            moved = Transition(())
            self._pending_reach = min(self._pending_reach + (step.reach or 0.0), self.graph.spacing)
        else:
            moved = transition(self.graph, self._caught_up(step), self._stride(), self._pending)
            self._pending_reach = 0.0
        ahead = predicted(self.belief, moved, share) if self.frames else self.belief
        self.belief = observed(ahead, seen, self.graph)
        if self.options.lag:
            self._smoother.append(self.belief, moved, seen, share)

    def _stride(self) -> Stride:
        """The usual advance since the last frame in which the view changed: at most one place more than usual."""
        usual = self.options.stride
        return Stride(max(usual.advance, min(1.0, usual.advance * (1 + self.constant))), usual.backwards)

    def _caught_up(self, step: Step) -> Step:
        """The motion with what the robot may have moved while its view seemed the same: at most to the next place."""
        return step if step.reach is None else replace(step, reach=step.reach + self._pending_reach)

    def _freshness(self, step: Step) -> float:
        """The weight of a frame: less than 1 if odometry says that the robot has hardly moved since the last one."""
        if step.odometry is None or not self.frames or not self.graph.spacing:
            return 1.0
        moved = step.odometry.distance / (0.5 * self.graph.spacing)
        turned = abs(step.odometry.turn) / TURN_NOTED
        return float(min(1.0, max(STANDING, moved, turned)))

    def estimate(self, count: int, alive: NDArray[np.bool_]) -> Estimate:
        """Where the robot is; this counts unrecognized frames, so call it once for each frame.

        Args:
            count: how many candidates to list.
            alive: bool [rows of the map]; places that were removed since the graph was made are not listed.
        """
        found = self._estimate(self._now(), count, alive)
        if found.verdict == "recognized":
            self.unrecognized = 0
        elif self.unrecognized is not None:
            self.unrecognized += 1
        return found

    def look(self, count: int, alive: NDArray[np.bool_]) -> Estimate:
        """Where the robot is, without counting: for calls between two frames."""
        return self._estimate(self._now(), count, alive)

    def earlier(self, count: int, alive: NDArray[np.bool_]) -> Estimate | None:
        """Where the robot was ``lag`` frames ago, given all frames since; None if that is not known."""
        smoothed = self._smoother.smoothed(self.graph) if self.options.lag else None
        return None if smoothed is None else self._estimate(smoothed, count, alive)

    def _estimate(self, belief: Belief, count: int, alive: NDArray[np.bool_]) -> Estimate:
        rows = self.graph.rows
        there = (rows < len(alive)) & alive[np.minimum(rows, max(len(alive) - 1, 0))] if len(alive) else rows < 0
        if not there.all():
            gone = float(belief.given[~there].sum(dtype=np.float64))
            unknown = belief.unknown + (1 - belief.unknown) * gone
            given = np.where(there, belief.given, np.float32(0)) / np.float32(max(1 - gone, 1e-9))
            belief = Belief(given.astype(np.float32), min(unknown, 1.0))
        return estimate(belief, self.graph, count)

    def _now(self) -> Belief:
        """The present belief; what is believed to be seen fades while the view is covered or tells nothing."""
        return replace(self.belief, unknown=1 - (1 - self.belief.unknown) * FADING**self.blind)

    def state(self) -> RunState:
        """The state from which the run can be continued."""
        masses = self.belief.given
        best = np.argpartition(-masses, KEPT)[:KEPT] if len(masses) > KEPT else np.arange(len(masses))
        seen = self._paths.seen if self.options.filter == "path" else ()
        return RunState(
            self.graph.rows[best],
            masses[best],
            self.belief.unknown,
            self.frames,
            self.unrecognized,
            self._pending.odometry,
            self._pending.reach,
            seen,
            self._view,
            self.blind,
            self.constant,
            self._pending_reach,
        )

    @classmethod
    def restored(cls, options: RunOptions, graph: PlaceGraph, state: RunState) -> Run:
        """Continue a run from its state; removed places are left out, the others share what the state does not have."""
        run = cls(options, graph)
        run.frames, run.unrecognized = state.frames, state.unrecognized
        run._pending = Pending(state.odometry, state.reach)
        run._view, run.blind, run.constant = state.view, state.blind, state.constant
        run._pending_reach = state.pending_reach
        if options.filter == "path":
            run._paths = PathSearch(options.path_frames, state.seen)
            if state.seen:
                run.belief = run._paths.belief(graph, options.stride)
        elif state.frames and len(graph):
            rest = max(0.0, 1 - float(state.masses.sum(dtype=np.float64)))
            given = np.full(len(graph), max(rest / len(graph), 1e-12), np.float32)
            places = graph.places_at(state.rows)
            given[places[places >= 0]] = np.maximum(state.masses[places >= 0], given[0])
            lost = float(state.masses[places < 0].sum(dtype=np.float64))
            unknown = state.unknown + (1 - state.unknown) * min(lost, 1.0)
            run.belief = Belief(given / np.float32(given.sum(dtype=np.float64)), unknown)
        return run
