"""One robot's run: its belief, updated frame by frame, and the state from which it can be continued."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from core.belief.estimate import Estimate, estimate
from core.belief.evidence import Evidence
from core.belief.filter import Belief, Smoother, observed, predicted, reindexed, uninformed
from core.belief.graph import PlaceGraph
from core.belief.motion import TURN_NOTED, Odometry, Pending, Step, Stride, transition
from core.belief.paths import PathSearch

LOST_AFTER = 5
"""After a first recognized frame, the robot is lost once this many frames in a row were not recognized."""

STANDING = 0.1
"""Weight of a further frame from the same spot: it shows the same things and leads to the same mistakes."""

KEPT = 512
"""The state has the probabilities of this many places; the others share the rest."""


@dataclass(frozen=True)
class RunOptions:
    """How a run is followed.

    filter: ``bayes``, the hidden Markov model, or ``path``, the search for straight paths.
    stride: the usual pace along the sequence, where neither odometry nor a speed limit says more.
    lag: frames after which a place is told once more, in the light of the frames since; 0: never.  ``bayes`` alone.
    path_frames: frames of a path.  ``path`` alone.
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
    odometry, reach: motion told and not yet applied.
    seen: the evidence that the path search still uses.
    """

    rows: NDArray[np.int64]
    masses: NDArray[np.float32]
    unknown: float
    frames: int
    unrecognized: int | None
    odometry: Odometry
    reach: float
    seen: tuple[Evidence, ...]


class Run:
    """The belief of one run; two threads must not use it at the same time.

    frames: how many frames there were.
    unrecognized: how many frames since the last recognized one; None before the first.
    """

    def __init__(self, options: RunOptions, graph: PlaceGraph) -> None:
        self.options, self.graph = options, graph
        self.frames = 0
        self.unrecognized: int | None = None
        self.belief = uninformed(len(graph))
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
        return 4 * len(self.graph) * moments + 2048 * self.options.path_frames

    def place_on(self, graph: PlaceGraph) -> None:
        """Continue on another graph, after the map's places have changed."""
        if graph is not self.graph:
            self.belief = reindexed(self.belief, self.graph, graph)
            self._smoother.clear()
            self.graph = graph

    def advance(self, seen: Evidence, step: Step) -> None:
        """Update the belief with one frame.

        Args:
            seen: the evidence of the frame.
            step: the motion since the frame before; ignored for the first frame.
        """
        if self.options.filter == "path":
            self._paths.append(seen, step.frames - 1)
            self.belief = self._paths.belief(self.graph, self.options.stride)
            self.frames += 1
            return
        seen = seen.tempered(self._freshness(step))
        moved = transition(self.graph, step if self.frames else Step(), self.options.stride, self._pending)
        ahead = predicted(self.belief, moved) if self.frames else self.belief
        self.belief = observed(ahead, seen, self.graph)
        if self.options.lag:
            self._smoother.append(self.belief, moved, seen)
        self.frames += 1

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
        found = self._told(self.belief, count, alive)
        if found.verdict == "recognized":
            self.unrecognized = 0
        elif self.unrecognized is not None:
            self.unrecognized += 1
        return found

    def look(self, count: int, alive: NDArray[np.bool_]) -> Estimate:
        """Where the robot is, without counting: for calls between two frames."""
        return self._told(self.belief, count, alive)

    def earlier(self, count: int, alive: NDArray[np.bool_]) -> Estimate | None:
        """Where the robot was ``lag`` frames ago, given all frames since; None if that is not known."""
        smoothed = self._smoother.smoothed(self.graph) if self.options.lag else None
        return None if smoothed is None else self._told(smoothed, count, alive)

    def _told(self, belief: Belief, count: int, alive: NDArray[np.bool_]) -> Estimate:
        rows = self.graph.rows
        there = (rows < len(alive)) & alive[np.minimum(rows, max(len(alive) - 1, 0))] if len(alive) else rows < 0
        if not there.all():
            gone = float(belief.given[~there].sum(dtype=np.float64))
            unknown = belief.unknown + (1 - belief.unknown) * gone
            given = np.where(there, belief.given, np.float32(0)) / np.float32(max(1 - gone, 1e-9))
            belief = Belief(given.astype(np.float32), min(unknown, 1.0))
        return estimate(belief, self.graph, count)

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
        )

    @classmethod
    def restored(cls, options: RunOptions, graph: PlaceGraph, state: RunState) -> Run:
        """Continue a run from its state; removed places are left out, the others share what the state does not have."""
        run = cls(options, graph)
        run.frames, run.unrecognized = state.frames, state.unrecognized
        run._pending = Pending(state.odometry, state.reach)
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
