"""The summary of a belief for a robot: the most probable place, its probability, and the alternatives."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from core.belief.filter import Belief
from core.belief.graph import PlaceGraph
from core.judgement.verdict import Verdict

RECOGNIZED = 0.5
"""A place is recognized from this probability on, its neighbours included; so is not being in the map."""

MODES = 8
"""At least this many distinct places are looked for, each with its neighbours."""

LIKELY = 512
"""At most this many of the likeliest places are looked at."""


@dataclass(frozen=True)
class Candidate:
    """A place where the robot may be.

    row: of the map.
    probability: of the place and of the frames that are the same place, but for those that a better candidate counts.
    """

    row: int
    probability: float


@dataclass(frozen=True)
class Estimate:
    """The summary of a belief.

    candidates: distinct places, best first; none in an empty map.
    unknown: the probability that the robot is not in the map.
    """

    verdict: Verdict
    candidates: tuple[Candidate, ...]
    unknown: float


def estimate(belief: Belief, graph: PlaceGraph, count: int) -> Estimate:
    """Summarize a belief.

    The verdict is ``unknown`` if not being in the map has a probability of at least RECOGNIZED, ``recognized`` if one
    place with its neighbours has, else ``ambiguous``.

    Args:
        count: how many candidates to list.
    """
    modes = [] if not len(graph) else _modes(belief.places, graph, max(count, MODES))
    verdict: Verdict = "ambiguous"
    if belief.unknown >= RECOGNIZED or not modes:
        verdict = "unknown"
    elif modes[0].probability >= RECOGNIZED:
        verdict = "recognized"
    return Estimate(verdict, tuple(modes[:count]), belief.unknown)


def _modes(masses: NDArray[np.float32], graph: PlaceGraph, count: int) -> list[Candidate]:
    """Distinct places by the probability of their neighbourhoods, best first."""
    found: list[Candidate] = []
    taken: set[int] = set()
    if not masses.max() > 0:
        return []
    likely = np.flatnonzero(masses >= 1e-3 * masses.max())
    if len(likely) > LIKELY:
        likely = likely[np.argpartition(-masses[likely], LIKELY)[:LIKELY]]
    for place in likely[np.argsort(-masses[likely], kind="stable")].tolist():
        if place in taken:
            continue
        same = graph.same_place(place)
        own = [other for other in same.tolist() if other not in taken]
        taken.update(own)
        middle = _middle(place, same, masses, graph)
        found.append(Candidate(int(graph.rows[middle]), float(masses[own].sum(dtype=np.float64))))
        if len(found) == count:
            break
    return sorted(found, key=lambda mode: -mode.probability)


def _middle(place: int, same: NDArray[np.int64], masses: NDArray[np.float32], graph: PlaceGraph) -> int:
    """The median, by probability, of the frames around ``place`` in its sequence that are the same place.

    It is steadier than the likeliest frame, which jumps between neighbours, and closer to the truth.
    """
    stretch = same[(same >= graph.first[place]) & (same < graph.last[place])]
    pieces = np.split(stretch, np.flatnonzero(np.diff(stretch) > 1) + 1)
    around = next(piece for piece in pieces if place in piece)
    sums = np.cumsum(masses[around], dtype=np.float64)
    return int(around[np.searchsorted(sums, 0.5 * sums[-1])])
