"""From a query's encoding to its answer: choose, search, examine the best, judge, look up; no HTTP."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from core.judgement.examination import examine
from core.judgement.position import PoseEstimate, estimate_pose
from core.judgement.priors import Values, log_odds_per_score, weighed
from core.judgement.verdict import TOP_PLACES, Calibration, Judgement, Neighborhood, Whereabouts, completed, judge
from core.method.agreement import Cells
from core.method.encoder import Encoder, Encoding
from core.places import Place
from core.recognition.selection import EVERYTHING, Choice, Selection
from core.storage import Map, Ranking, Snapshot

ATTEMPTS = 3
"""Snapshots to try while places are deleted under the search."""

HEAD = 500
"""So much of a ranking is looked at, unless too little of it is another place than the best: the rest decides nothing
but where the score is judged by the spread of all."""


@dataclass(frozen=True)
class Scored:
    """The best of a ranking after the second stage.

    rows: int64 [n], best first, and their scores, float32 [n].
    whereabouts: of those places.
    examined: bool [n], which of them the second stage has compared cell by cell.
    weights: float64 [n], log prior of those places; None: nothing was known.
    ordered: float32 [n], what they are in order of: the scores, as the prior has changed them.
    is_part: a score is not known of every place that may be found.
    places: how many places the map has, those that may not be found included.
    """

    rows: NDArray[np.int64]
    scores: NDArray[np.float32]
    whereabouts: Whereabouts
    examined: NDArray[np.bool_]
    weights: Values | None
    ordered: NDArray[np.float32]
    is_part: bool
    places: int

    def take(self, kept: NDArray[np.int64]) -> Scored:
        """Only some of them."""
        return replace(
            self,
            rows=self.rows[kept],
            scores=self.scores[kept],
            whereabouts=self.whereabouts.take(kept),
            examined=self.examined[kept],
            weights=None if self.weights is None else self.weights[kept],
            ordered=self.ordered[kept],
        )


@dataclass(frozen=True)
class Located:
    """The answer to one query.

    matches: score and place, best first; at most k.
    weights: of the matches, how much the prior speaks for each, in (0, 1]; None: nothing was known.
    calibration: by which it was judged.
    search: milliseconds of search, second stage, judgement and look-up.
    pose: of the frame, by the poses of the best match and of its neighbours; None without poses.
    encoding: of the frame.
    scored: the best of the ranking, from which the matches are taken.
    """

    judgement: Judgement
    matches: list[tuple[float, Place]]
    weights: list[float] | None
    calibration: Calibration
    search: float
    pose: PoseEstimate | None
    encoding: Encoding
    scored: Scored

    @property
    def probability(self) -> float | None:
        """That the best match is right; None in an empty map or without a calibrated curve."""
        return self.judgement.probability


def calibration_of(map_: Map, encoder: Encoder) -> Calibration:
    """The map's own calibration or else its encoder's."""
    return completed(map_.record.calibration, encoder.calibration, encoder.candidates > 0)


def neighborhood_of(map_: Map) -> Neighborhood:
    """What counts as the same place in a map."""
    return Neighborhood(map_.record.same_place_radius, map_.record.same_place_frames)


def locate(
    map_: Map, encoder: Encoder, encodings: Sequence[Encoding], k: int, selection: Selection | None = None
) -> list[Located]:
    """Search one snapshot of a map for several queries and judge each.

    Args:
        encoder: that of the map.
        encodings: of the queries, made by it; at least one.
        k: how many matches to list.
        selection: what is known of the place asked for; None: nothing.

    Raises:
        StorageFailure: the map's files cannot be read.
    """
    began = time.perf_counter()
    snapshot = map_.snapshot()
    choice = selection.choice(map_, snapshot) if selection else EVERYTHING
    rankings = search(snapshot, np.stack([encoding.descriptor for encoding in encodings]), choice)
    share = 1e3 * (time.perf_counter() - began) / len(encodings)
    located = []
    for encoding, ranking in zip(encodings, rankings, strict=True):
        began = time.perf_counter()
        scored = second_stage(map_, encoder, snapshot, encoding.local, ranking, choice)
        attempt = 1
        while (found := _judged(map_, encoder, encoding, scored, k, settle=attempt == ATTEMPTS)) is None:
            scored, attempt = examined_ranking(map_, encoder, map_.snapshot(), encoding, selection), attempt + 1
        located.append(replace(found, search=share + 1e3 * (time.perf_counter() - began)))
    return located


def examined_ranking(
    map_: Map, encoder: Encoder, snapshot: Snapshot, encoding: Encoding, selection: Selection | None = None
) -> Scored:
    """Both stages for one query against a snapshot of the map, nothing judged yet.

    Raises:
        StorageFailure: the map's files cannot be read.
    """
    choice = selection.choice(map_, snapshot) if selection else EVERYTHING
    (ranking,) = search(snapshot, encoding.descriptor[np.newaxis], choice)
    return second_stage(map_, encoder, snapshot, encoding.local, ranking, choice)


def search(snapshot: Snapshot, descriptors: NDArray[np.float32], choice: Choice = EVERYTHING) -> list[Ranking]:
    """The first stage: what of the choice is most like each query, float32 [B, D]; rows and inner products.

    An index that returns only its best would hide places that a prior speaks for behind others that score a little
    better: these are searched for apart, and stand among the others.
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


def second_stage(
    map_: Map, encoder: Encoder, snapshot: Snapshot, local: Cells, ranking: Ranking, choice: Choice = EVERYTHING
) -> Scored:
    """Weigh the best of a ranking by what is known, and examine the best of those cell by cell.

    Args:
        local: of the query, int8 [C, L].
        ranking: of ``search``, rows int64 [n] and inner products float32 [n].

    Returns:
        At most the first HEAD of the ranking, where they hold all that a verdict needs; else all of it.
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

    def gains(positions: NDArray[np.int64]) -> NDArray[np.float32]:
        return encoder.agreement(local, snapshot.locals_in_place(rows[positions]))

    for length in (len(rows) if by_all else HEAD, len(rows)):
        places = snapshot.whereabouts_at(rows[:length])
        found = examine(ordered[:length], places, neighborhood, encoder.candidates, gains)
        order = found.order
        scored = Scored(
            rows[order],
            scores[order] + (found.scores - ordered[order]),
            places.take(order),
            found.examined,
            None if weights is None else weights[order],
            found.scores,
            snapshot.coded > 0,
            len(snapshot),
        )
        if length >= len(rows) or _is_enough(scored, neighborhood, encoder.candidates > 0):
            break
    return scored


def _is_enough(scored: Scored, neighborhood: Neighborhood, has_second_stage: bool) -> bool:
    """Whether as many other places than the best are among them as a verdict looks at."""
    others = ~scored.whereabouts.near(0, neighborhood)
    return int((others & scored.examined if has_second_stage else others).sum()) >= TOP_PLACES


def _judged(map_: Map, encoder: Encoder, encoding: Encoding, scored: Scored, k: int, settle: bool) -> Located | None:
    """Judge what was found; None if a place was deleted since the snapshot, unless it is to settle for the others."""
    places = map_.places_at(scored.rows[:k].tolist()) if len(scored.rows) else []
    if None in places:
        if not settle:
            return None
        kept = np.ones(len(scored.rows), np.bool_)
        kept[: len(places)] = [place is not None for place in places]
        scored = scored.take(np.flatnonzero(kept))
    calibration, neighborhood = calibration_of(map_, encoder), neighborhood_of(map_)
    judgement = judge(scored.ordered, scored.whereabouts, calibration, neighborhood, scored.examined, scored.is_part)
    present = [place for place in places if place is not None]
    matches = [(float(score), place) for score, place in zip(scored.scores, present, strict=False)]
    if matches:
        judgement = replace(judgement, score=matches[0][0])
    steepness = log_odds_per_score(calibration, encoder.candidates > 0)
    pose = estimate_pose(scored.whereabouts, steepness * scored.ordered.astype(np.float64), neighborhood.radius)
    weights = None if scored.weights is None else np.exp(scored.weights[: len(matches)]).tolist()
    return Located(judgement, matches, weights, calibration, 0.0, pose, encoding, scored)
