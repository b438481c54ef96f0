"""The summary of a belief for a robot: the most probable place, its probability, and the alternatives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from core.belief.evidence import Sighting
from core.belief.filter import Belief
from core.belief.graph import PlaceGraph
from core.judgement.background import GUARD_FACTOR
from core.judgement.verdict import Verdict

RECOGNIZED = 0.5
"""A place is recognized from this probability on, its neighbours included; so is not being in the map."""

CLEAR = 2.0
"""A place is recognized if it is this many times as probable as any other: of two that look the same none is."""

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


def estimate(
    belief: Belief, graph: PlaceGraph, count: int, sighting: Sighting | None = None, guided: bool = False
) -> Estimate:
    """Summarize a belief.

    The verdict is ``unknown`` if not being in the map has a probability of at least RECOGNIZED, ``recognized`` if one
    place with its neighbours has, and is CLEAR of all others, else ``ambiguous``.

    Args:
        count: how many candidates to list.
        sighting: of the present frame, if it is recognized by itself.
        guided: whether the motion to this frame was known among the poses of the map.
    """
    candidates, unknown = [] if not len(graph) else _modes(belief.places, graph, max(count, MODES)), belief.unknown
    if sighting is not None and candidates:
        candidates, unknown = _sighted(candidates, unknown, sighting, graph, guided)
    return Estimate(_verdict(candidates, unknown, graph), tuple(candidates[:count]), unknown)


def agreement(found: Estimate, row: int, graph: PlaceGraph) -> float:
    """The probability, if the robot sees the map, that it is at or beside a place; 1 unless a place is recognized.

    Args:
        found: where the robot is.
        row: of the map, the place that the frame alone matches best.
    """
    (place,) = graph.places_at(np.array([row])).tolist()
    if found.verdict != "recognized" or found.unknown >= 1:
        return 1.0
    if place < 0:
        return 0.0
    near = _near(row, found.candidates, graph, GUARD_FACTOR)
    there = sum(one.probability for one, same in zip(found.candidates, near, strict=True) if same)
    return min(1.0, there / (1 - found.unknown))


def _verdict(candidates: Sequence[Candidate], unknown: float, graph: PlaceGraph) -> Verdict:
    if unknown >= RECOGNIZED or not candidates:
        return "unknown"
    elsewhere = ~_near(candidates[0].row, candidates, graph, GUARD_FACTOR)
    rival = max((one.probability for one, far in zip(candidates, elsewhere, strict=True) if far), default=0.0)
    return "recognized" if candidates[0].probability >= max(RECOGNIZED, CLEAR * rival) else "ambiguous"


def _near(row: int, candidates: Sequence[Candidate], graph: PlaceGraph, times: float = 1) -> NDArray[np.bool_]:
    """Which candidates are within ``times`` the reach of the same place as a row; bool [k]."""
    places = graph.places_at(np.array([row, *(one.row for one in candidates)]))
    return graph.whereabouts.take(places).near(0, graph.neighborhood.times(times))[1:]


def _sighted(
    candidates: list[Candidate], unknown: float, sighting: Sighting, graph: PlaceGraph, guided: bool
) -> tuple[list[Candidate], float]:
    """The candidates, best first, and the probability of not being in the map, where a sighting is surer than these.

    Its place gets its probability, and everything else shares the rest as before (Jeffrey's rule of conditioning).  A
    belief that is sure of another place is contradicted: one of the two is right at most, so that they share what they
    have, and neither is recognized.  But where exactly the robot is, a belief that is sure of a place beside it knows
    better, and so does one that is sure not to be in the map.
    """
    best, verdict = candidates[0], _verdict(candidates, unknown, graph)
    (place,) = graph.places_at(np.array([sighting.row])).tolist()
    if place < 0 or sighting.probability <= best.probability:
        return candidates, unknown
    near = _near(sighting.row, candidates, graph)
    beside = bool(_near(sighting.row, candidates[:1], graph, GUARD_FACTOR)[0])
    if (verdict == "unknown" and not near[0]) or (verdict == "recognized" and beside and (guided or not near[0])):
        return candidates, unknown
    believed = sum(one.probability for one, same in zip(candidates, near, strict=True) if same)
    others = [one for one, same in zip(candidates, near, strict=True) if not same]
    if verdict == "recognized" and not beside:
        half = (best.probability + believed) / 2
        claims, others, rest = [replace(best, probability=half), Candidate(sighting.row, half)], others[1:], 1.0
    else:
        probability = max(sighting.probability, believed)
        claims, rest = [Candidate(sighting.row, probability)], (1 - probability) / max(1 - believed, 1e-9)
    found = [*claims, *(replace(one, probability=rest * one.probability) for one in others)]
    return sorted(found, key=lambda one: -one.probability), rest * unknown


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
