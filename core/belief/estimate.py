"""What to tell a robot of a belief: the place, how probable it is, and what else it could be."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from core.belief.filter import Belief
from core.belief.graph import PlaceGraph
from core.judgement.verdict import Verdict

RECOGNIZED = 0.5
"""Least probability of a place, its neighbours included, with which it is told; the same of not being in the map."""

MODES = 8
"""Places looked at, each with its neighbours, besides those that belong to one already."""

LIKELY = 512
"""Of a belief that is spread over the map, no more places are looked at."""


@dataclass(frozen=True)
class Candidate:
    """One place that it may be.

    row: of the map.
    probability: of it and of the places that are the same place.
    """

    row: int
    probability: float


@dataclass(frozen=True)
class Estimate:
    """A belief in a few numbers.

    candidates: distinct places, best first; none in an empty map.
    unknown: probability of not being in the map.
    """

    verdict: Verdict
    candidates: tuple[Candidate, ...]
    unknown: float


def estimate(belief: Belief, graph: PlaceGraph, count: int) -> Estimate:
    """Sum a belief up.

    The verdict is ``unknown`` where not being in the map is as probable as being in it, ``recognized`` where one place
    with its neighbours is, else ``ambiguous``.

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
        taken.update(same.tolist())
        middle = _middle(place, same, masses, graph)
        found.append(Candidate(int(graph.rows[middle]), float(masses[same].sum(dtype=np.float64))))
        if len(found) == count:
            break
    return sorted(found, key=lambda mode: -mode.probability)


def _middle(place: int, same: NDArray[np.int64], masses: NDArray[np.float32], graph: PlaceGraph) -> int:
    """Of the frames around ``place`` in its sequence that are the same place, the one at half their probability.

    The likeliest single frame jumps to and fro between neighbours; this one is steadier and nearer the truth.
    """
    stretch = same[(same >= graph.first[place]) & (same < graph.last[place])]
    pieces = np.split(stretch, np.flatnonzero(np.diff(stretch) > 1) + 1)
    around = next(piece for piece in pieces if place in piece)
    sums = np.cumsum(masses[around], dtype=np.float64)
    return int(around[np.searchsorted(sums, 0.5 * sums[-1])])
