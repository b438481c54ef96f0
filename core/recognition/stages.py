"""The two stages of a search, and which places the second one looks at.

The first stage ranks all places of a map by the inner product of their descriptors with the query's (equation 3.12).
The second compares the best of that ranking with the query cell by cell.

Where frames were taken densely, or the robot stood still, the neighbours of one place can fill the whole list of
candidates.  Then nothing would be examined that the best place could be held against: a twin elsewhere would keep its
low first score, the lead would be large by construction, and the answer could never be ambiguous.  So the list goes on
past the neighbours of the best place until a few other places have been compared as closely.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from core.judgement.priors import Values, weighed
from core.judgement.verdict import TOP_PLACES, Calibration, completed
from core.method.agreement import Cells
from core.method.encoder import Encoder
from core.places import Neighborhood, Whereabouts
from core.recognition.selection import EVERYTHING, Choice
from core.storage import Map, Ranking, Snapshot

Array = NDArray[np.float32]
Positions = NDArray[np.int64]

ROUNDS = 3
"""A further place may turn out to be the best and have neighbours of its own, so others are counted this often."""

HEAD = 500
"""This much of a ranking is examined and judged, unless it holds too few places other than the best one."""


@dataclass(frozen=True)
class Candidates:
    """The best places of a ranking after the second stage.

    rows: int64 [n], best first, and their scores, float32 [n].
    whereabouts: of those places.
    examined: bool [n], which of them the second stage has compared with the query cell by cell.
    weights: float64 [n], log prior of those places; None: nothing was known.
    ordered: float32 [n], the values by which they are ordered: the scores as the prior has changed them.
    is_part: whether there are places that may be found and whose score is not known.
    places: how many places the map has, those that may not be found included.
    """

    rows: Positions
    scores: Array
    whereabouts: Whereabouts
    examined: NDArray[np.bool_]
    weights: Values | None
    ordered: Array
    is_part: bool
    places: int

    def take(self, kept: Positions) -> Candidates:
        """Only some of them, by their positions."""
        return replace(
            self,
            rows=self.rows[kept],
            scores=self.scores[kept],
            whereabouts=self.whereabouts.take(kept),
            examined=self.examined[kept],
            weights=None if self.weights is None else self.weights[kept],
            ordered=self.ordered[kept],
        )


def calibration_of(map_: Map, encoder: Encoder) -> Calibration:
    """The map's own calibration or, if it has none, its encoder's."""
    return completed(map_.record.calibration, encoder.calibration, encoder.candidates > 0)


def neighborhood_of(map_: Map) -> Neighborhood:
    """What counts as the same place in a map."""
    return Neighborhood(map_.record.same_place_radius, map_.record.same_place_frames)


def search(snapshot: Snapshot, descriptors: Array, choice: Choice = EVERYTHING) -> list[Ranking]:
    """The first stage: the places most like each query, by the inner products of descriptors (equation 3.12).

    An index that returns only its best places would hide those that a prior favours behind others that score a little
    better, so favoured places are searched for apart and put among the others.

    Args:
        descriptors: of the queries, float32 [B, D].
        choice: the places that may be found, and their priors.

    Returns:
        For each query rows, int64 [n], and inner products, float32 [n], best first.
    """
    rankings = snapshot.search_batch(descriptors, choice.allowed)
    favoured = choice.favoured
    if favoured is None or len(rankings[0][0]) >= len(snapshot):
        return rankings
    more = snapshot.search_batch(descriptors, favoured)
    return [_merged(ranking, other) for ranking, other in zip(rankings, more, strict=True)]


def _merged(a: Ranking, b: Ranking) -> Ranking:
    rows, first = np.unique(np.concatenate([a[0], b[0]]), return_index=True)
    products = np.concatenate([a[1], b[1]])[first]
    order = np.argsort(-products, kind="stable")
    return rows[order], products[order]


def agree(
    map_: Map, encoder: Encoder, snapshot: Snapshot, local: Cells, ranking: Ranking, choice: Choice = EVERYTHING
) -> Candidates:
    """The second stage: compare the best of a ranking with the query cell by cell, after its prior has been applied.

    Args:
        local: the query's local descriptors, int8 [C, L].
        ranking: of :func:`search`, rows int64 [n] and inner products float32 [n].

    Returns:
        At most the first ``HEAD`` of the ranking if they hold all that a verdict needs, else all of it.

    Raises:
        StorageFailure: local descriptors cannot be read from disk.
    """
    calibration, neighborhood = calibration_of(map_, encoder), neighborhood_of(map_)
    by_all = not encoder.candidates and calibration.decision != "leading" and not snapshot.coded
    scores = encoder.scores_from_inner_products(ranking[1])
    rows, ordered, weights = ranking[0], scores, None
    if choice.weights is not None:
        weights = choice.weights[rows]
        ordered = weighed(scores, weights, calibration, encoder.candidates > 0)
        order = np.argsort(-ordered, kind="stable")
        rows, scores, ordered, weights = rows[order], scores[order], ordered[order], weights[order]

    def gains(positions: Positions) -> Array:
        return encoder.agreement(local, snapshot.locals_in_place(rows[positions]))

    for length in (len(rows) if by_all else HEAD, len(rows)):
        places = snapshot.whereabouts_at(rows[:length])
        found = examine(ordered[:length], places, neighborhood, encoder.candidates, gains)
        order = found.order
        candidates = Candidates(
            rows[order],
            scores[order] + (found.scores - ordered[order]),
            places.take(order),
            found.examined,
            None if weights is None else weights[order],
            found.scores,
            snapshot.coded > 0,
            len(snapshot),
        )
        if length >= len(rows) or _is_enough(candidates, neighborhood, encoder.candidates > 0):
            break
    return candidates


def _is_enough(candidates: Candidates, neighborhood: Neighborhood, has_second_stage: bool) -> bool:
    """Whether they hold as many places other than the best as a verdict looks at."""
    others = ~candidates.whereabouts.near(0, neighborhood)
    return int((others & candidates.examined if has_second_stage else others).sum()) >= TOP_PLACES


@dataclass(frozen=True)
class Examined:
    """A ranking of n places after its candidates have gained.

    order: int64 [n], positions in the old ranking, best first; equal scores keep their order.
    scores: float32 [n], in the new order.
    examined: bool [n], which of the places, in the new order, were examined.
    """

    order: Positions
    scores: Array
    examined: NDArray[np.bool_]


def examine(
    scores: Array,
    whereabouts: Whereabouts,
    neighborhood: Neighborhood,
    candidates: int,
    gains: Callable[[Positions], Array],
    others: int = TOP_PLACES,
) -> Examined:
    """Raise the scores of the best of a ranking by what the second stage finds.

    The first ``candidates`` are examined; then, as long as fewer than ``others`` of the examined places are another
    place than the best one, the best of those that are.

    Args:
        scores: float32 [n], of the first stage, best first.
        whereabouts: of the same n places in the same order.
        neighborhood: what counts as the same place.
        candidates: of the encoder; 0: it has no second stage, and nothing is examined.
        gains: gives what the second stage adds to the scores at positions in the ranking, int64 [k] to float32 [k],
            at least 0.
    """
    raised = scores.copy()
    done = np.zeros(len(scores), np.bool_)
    ahead = np.arange(min(candidates, len(scores)))
    for _ in range(ROUNDS):
        if not len(ahead):
            break
        raised[ahead] += gains(ahead)
        done[ahead] = True
        best = int(np.flatnonzero(done)[np.argmax(raised[done])])
        elsewhere = ~whereabouts.near(best, neighborhood)
        missing = max(0, others - int((done & elsewhere).sum()))
        ahead = np.flatnonzero(elsewhere & ~done)[:missing]
    order = np.argsort(-raised, kind="stable")
    return Examined(order, raised[order], done[order])
