"""One robot's run: frames come in one by one, the belief goes on; what has to be kept of it between two frames."""

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
"""A robot that was recognized once is lost when so many frames in a row were not."""

STANDING = 0.1
"""What a further look from the same spot counts: it shows the same, so it is mistaken about the same."""

KEPT = 512
"""Places whose probabilities are written down one by one; the others share what is left."""


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
    """What a run can be taken up from again: all but the probabilities of the least likely places, and the lag.

    rows, masses: int64 and float32 [k], the likeliest places and their probabilities if the robot sees the map.
    seen: evidence that the path search still counts.
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
    """The belief of one run.  Not to be used by two threads at a time.

    frames: frames taken in so far.
    unrecognized: frames since the last that was recognized; None before the first.
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
        """Whether it was known where the robot is, and has not been for some frames."""
        return self.unrecognized is not None and self.unrecognized >= LOST_AFTER

    @property
    def bytes(self) -> int:
        """Of memory that the run holds at most, the graph not counted."""
        moments = 1 + (self.options.lag + 1 if self.options.lag else 0)
        return 4 * len(self.graph) * moments + 2048 * self.options.path_frames

    def place_on(self, graph: PlaceGraph) -> None:
        """Go on over the places as they are now."""
        if graph is not self.graph:
            self.belief = reindexed(self.belief, self.graph, graph)
            self._smoother.clear()
            self.graph = graph

    def advance(self, seen: Evidence, step: Step) -> None:
        """Take in one frame.

        Args:
            seen: what it says.
            step: the motion since the frame before; of the first frame it does not matter.
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
        """How much a frame says that the one before did not; all, where nothing is known of the motion."""
        if step.odometry is None or not self.frames or not self.graph.spacing:
            return 1.0
        moved = step.odometry.distance / (0.5 * self.graph.spacing)
        turned = abs(step.odometry.turn) / TURN_NOTED
        return float(min(1.0, max(STANDING, moved, turned)))

    def estimate(self, count: int, alive: NDArray[np.bool_]) -> Estimate:
        """Where the robot is; counts whether it was recognized, so call it once a frame.

        Args:
            count: candidates to list.
            alive: bool [rows of the map]; places that have died since the graph was made are not told.
        """
        found = self._told(self.belief, count, alive)
        if found.verdict == "recognized":
            self.unrecognized = 0
        elif self.unrecognized is not None:
            self.unrecognized += 1
        return found

    def look(self, count: int, alive: NDArray[np.bool_]) -> Estimate:
        """The same between two frames; nothing is counted."""
        return self._told(self.belief, count, alive)

    def earlier(self, count: int, alive: NDArray[np.bool_]) -> Estimate | None:
        """Where the robot was ``lag`` frames ago, given all frames since; None where that is not known."""
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
        """What to write down."""
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
        """A run taken up again; places that are no more are left out, the others share what was not written down."""
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
