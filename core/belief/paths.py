"""Straight paths through the last frames: the sequence search of SeqSLAM, over past frames only.

Milford, Wyeth: SeqSLAM: Visual Route-based Navigation for Sunny Summer Days and Stormy Winter Nights, ICRA 2012.
SeqSLAM searches for paths of nearly constant velocity in a matrix of differences; here they are searched for in the
evidence of the last frames, which already compares each score with the others of its frame, as SeqSLAM's contrast
enhancement does.  A path ends at the present frame.  Only the pace is assumed to be known.  As nothing older than the
last frames counts, a robot that was carried away is found again after as many frames.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from core.belief.evidence import NOTHING, Evidence
from core.belief.filter import Belief, uninformed
from core.belief.graph import PlaceGraph
from core.belief.motion import Stride
from core.kernels.belief import add_along

PACES = tuple(round(0.5 + 0.1 * step, 1) for step in range(11))
"""Velocities of the paths, as multiples of the usual advance."""


SHARE = 0.25
"""Weight of a frame's evidence: the frames of a path lead to the same mistakes, and nothing else softens their sum."""

BEST = 2.0
"""Not being in the map counts this much more than in the filter, as it is compared with the best of many paths."""


class PathSearch:
    """The evidence of a run's last frames, and the best paths through it.

    Args:
        frames: how many frames a path has, at least 1.
        seen: the evidence of earlier frames, oldest first.
    """

    def __init__(self, frames: int, seen: Sequence[Evidence] = ()) -> None:
        self.frames = frames
        self._seen: deque[Evidence] = deque(seen, maxlen=frames)

    @property
    def seen(self) -> tuple[Evidence, ...]:
        """The evidence that counts, oldest first."""
        return tuple(self._seen)

    def append(self, seen: Evidence, missed: int = 0) -> None:
        """Add one frame, after ``missed`` frames that did not arrive and say nothing."""
        for _ in range(min(missed, self.frames)):
            self._seen.append(NOTHING)
        self._seen.append(seen)

    def belief(self, graph: PlaceGraph, stride: Stride) -> Belief:
        """The belief in which each place has the likelihood of the best path that ends there.

        All paths have the same prior.  "Not in the map" is compared with the best path, not with the sum of all: a
        robot is no likelier to be in a map of many places than in a map of few.
        """
        n = len(graph)
        if not n:
            return uninformed(0)
        best = np.zeros(n, np.float32)
        velocities = sorted({round(stride.advance * pace, 3) for pace in PACES})
        signs = (1, -1) if stride.backwards else (1,)
        placed = [(graph.places_at(seen.rows), seen.gains) for seen in self._seen]
        shifts: set[tuple[int, ...]] = set()
        for velocity in velocities:
            for sign in signs:
                ages = range(len(placed) - 1, -1, -1)
                shifts.add(tuple(sign * int(np.floor(velocity * age + 0.5)) for age in ages))
        for path in sorted(shifts):
            totals = np.zeros(n, np.float32)
            for shift, (places, gains) in zip(path, placed, strict=True):
                add_along(places, gains, shift, graph.first, graph.last, totals)
            np.maximum(best, totals, out=best)
        unknown = sum(seen.unknown for seen in self._seen)
        return _normalised(np.float32(SHARE) * best, SHARE * BEST * unknown)


def _normalised(likelihoods: NDArray[np.float32], unknown: float) -> Belief:
    best = float(likelihoods.max())
    given: NDArray[np.float32] = np.exp(likelihoods - np.float32(best))
    return Belief(given / np.float32(given.sum(dtype=np.float64)), 1 / (1 + math.exp(min(best - unknown, 500.0))))
