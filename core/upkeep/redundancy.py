"""Places that their neighbours stand in for, and what leaving them out costs in recall."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from core.places import NO_POSE, Neighborhood, Whereabouts
from core.upkeep.hubness import NONE

MOST_NEIGHBOURS = 32
"""A place is held against so many of its nearest at most: where a robot stood still, pairs would be without number."""


def neighbour_pairs(where: Whereabouts, neighborhood: Neighborhood) -> NDArray[np.int64]:
    """Pairs of places that are the same place (``Whereabouts.near``), each once, the lesser first: int64 [m, 2]."""
    pairs: list[NDArray[np.int64]] = [np.empty((0, 2), np.int64)]
    for kind in np.unique(where.kind[where.kind != NO_POSE]):
        members = np.flatnonzero(where.kind == kind)
        count = min(len(members), MOST_NEIGHBOURS + 1)
        tree = cKDTree(where.position[members])
        # The tree's own bound is exclusive, and rounded; places at exactly the radius are near.
        bound = 1.001 * neighborhood.radius + 1e-6
        apart, found = tree.query(where.position[members], k=[*range(1, count + 1)], distance_upper_bound=bound)
        first = np.repeat(np.arange(len(members)), count)
        second = found.reshape(-1)
        there = apart.reshape(-1) <= neighborhood.radius
        pairs.append(np.stack([members[first[there]], members[second[there]]], axis=1))
    pairs += _along_sequences(where, neighborhood.frames)
    ordered = np.sort(np.concatenate(pairs), axis=1)
    return np.unique(ordered[ordered[:, 0] != ordered[:, 1]], axis=0)


def _along_sequences(where: Whereabouts, frames: int) -> list[NDArray[np.int64]]:
    """Pairs of one sequence, so many frames apart at most, that have no poses of one kind to go by."""
    pairs = []
    reach = min(frames, MOST_NEIGHBOURS // 2)
    order = np.lexsort((where.ordinal, where.sequence))
    for step in range(1, reach + 1):
        first, second = order[:-step], order[step:]
        near = (where.sequence[first] == where.sequence[second]) & (
            np.abs(where.ordinal[second] - where.ordinal[first]) <= frames
        )
        posed = (where.kind[first] == where.kind[second]) & (where.kind[first] != NO_POSE)
        chosen = near & ~posed
        pairs.append(np.stack([first[chosen], second[chosen]], axis=1))
    return pairs


def thinned(
    places: int,
    pairs: NDArray[np.int64],
    similarity: NDArray[np.float32],
    least: float,
    free: NDArray[np.bool_] | None = None,
) -> NDArray[np.bool_]:
    """The places to keep, so that each that goes has a kept one that is the same place and looks alike.

    Greedy: places go one after the other, those with the most alike neighbour first, each only if it has a kept
    neighbour that stands in for it, and if all that it stands in for have another one.

    Args:
        pairs: int64 [m, 2], of places that are the same place, each pair once.
        similarity: float32 [m], score of each pair.
        least: the score from which on one stands in for the other.
        free: bool [places], those that may go; None: all.

    Returns:
        bool [places].
    """
    may_go = np.ones(places, np.bool_) if free is None else free
    kept = np.ones(places, np.bool_)
    near: list[list[int]] = [[] for _ in range(places)]
    best = np.full(places, -np.inf)
    for (a, b), score in zip(pairs.tolist(), similarity.tolist(), strict=True):
        if score >= least:
            near[a].append(b)
            near[b].append(a)
            best[a], best[b] = max(best[a], score), max(best[b], score)
    stand_ins = [len(others) for others in near]  # of each place, those that are kept
    for place in np.argsort(-best, kind="stable").tolist():
        if not (may_go[place] and stand_ins[place]):
            continue
        if not any(not kept[other] and stand_ins[other] == 1 for other in near[place]):
            kept[place] = False
            for other in near[place]:
                stand_ins[other] -= 1
    return kept


@dataclass(frozen=True)
class Trial:
    """Queries whose truth is known, held against a map once; what remains of it can then be judged without searching.

    positions: int64 [q, c], the best places for each query by the first stage, best first; NONE behind the last.
    scores: float32 [q, c], of the first stage.
    gains: float32 [q, c], of the second stage, at least 0.
    right: bool [q, c], which of the places are the query's own.
    candidates: that the second stage examines of each query; 0: there is none.
    """

    positions: NDArray[np.int64]
    scores: NDArray[np.float32]
    gains: NDArray[np.float32]
    right: NDArray[np.bool_]
    candidates: int

    def found(self, kept: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """For which queries the best match among the places that are kept is right; bool [q].

        Args:
            kept: bool [places].
        """
        there = (self.positions != NONE) & kept[np.maximum(self.positions, 0)]
        examined = there & (there.cumsum(axis=1) <= self.candidates)
        values = np.where(there, self.scores + np.where(examined, self.gains, 0), -np.inf)
        if self.candidates:  # what was not examined comes behind what was, as its order says
            values = np.where(there & ~examined, -np.inf, values)
        best = np.argmax(values, axis=1)[:, np.newaxis]
        return np.take_along_axis(self.right & there, best, axis=1)[:, 0]


@dataclass(frozen=True)
class Thinning:
    """One way to thin a map.

    least: how alike two places must look for one to stand in for the other.
    kept: bool [places].
    before, after: queries that are answered right by the whole map, and by what is kept; bool [q].
    """

    least: float
    kept: NDArray[np.bool_]
    before: NDArray[np.bool_]
    after: NDArray[np.bool_]

    @property
    def loss(self) -> float:
        """What it costs: recall before minus recall after."""
        return float(self.before.mean() - self.after.mean())


def steps(similarity: NDArray[np.float32], count: int) -> list[float]:
    """Scores to try, highest first: quantiles of those of the pairs there are."""
    if not len(similarity):
        return []
    shares = np.linspace(1.0, 0.0, count + 1)[1:]
    return [float(score) for score in sorted({*np.quantile(similarity, shares).tolist()}, reverse=True)]


def best_thinning(tried: Sequence[Thinning], most_loss: float) -> Thinning | None:
    """The one that removes most, of those up to the first that costs too much; None if already that one does.

    Args:
        tried: from the gentlest on.
        most_loss: of recall.
    """
    chosen = None
    for thinning in tried:
        if thinning.loss > most_loss:
            break
        chosen = thinning
    return chosen
