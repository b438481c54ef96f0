"""From a query's encoding to its answer: search, examine the best, judge, look up; no HTTP."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from core.agreement import Cells, reranked
from core.encoder import Encoder, Encoding
from core.places import Place
from core.storage import Map, Ranking, Snapshot
from core.verdict import Calibration, Judgement, Neighborhood, judge

ATTEMPTS = 3
"""Snapshots to try while places are deleted under the search."""


@dataclass(frozen=True)
class Located:
    """The answer to one query.

    matches: score and place, best first; at most k.
    search: milliseconds of search, second stage, judgement and look-up.
    """

    judgement: Judgement
    matches: list[tuple[float, Place]]
    calibration: Calibration
    search: float


def locate(map_: Map, encoder: Encoder, encodings: Sequence[Encoding], k: int) -> list[Located]:
    """Search one snapshot of a map for several queries and judge each.

    Args:
        encoder: that of the map.
        encodings: of the queries, made by it; at least one.
        k: how many matches to list.

    Raises:
        StorageFailure: the map's files cannot be read.
    """
    began = time.perf_counter()
    snapshot = map_.snapshot()
    rankings = snapshot.search_batch(np.stack([encoding.descriptor for encoding in encodings]))
    share = 1e3 * (time.perf_counter() - began) / len(encodings)
    located = []
    for encoding, ranking in zip(encodings, rankings, strict=True):
        began = time.perf_counter()
        current, attempt = snapshot, 1
        scored = examine(encoder, current, encoding.local, ranking)
        while (found := _judge(map_, encoder, current, scored, k, settle=attempt == ATTEMPTS)) is None:
            current, attempt = map_.snapshot(), attempt + 1
            scored = examine(encoder, current, encoding.local, current.search(encoding.descriptor))
        judgement, matches, calibration = found
        located.append(Located(judgement, matches, calibration, share + 1e3 * (time.perf_counter() - began)))
    return located


def examine(encoder: Encoder, snapshot: Snapshot, local: Cells, ranking: Ranking) -> Ranking:
    """The second stage: the first ``encoder.candidates`` of a ranking gain by how far they agree with the query.

    No gain is negative, so that the order among the first is all that can change.

    Args:
        local: of the query, int8 [C, L].
        ranking: of the snapshot's search, rows int64 [n] and inner products float32 [n].

    Returns:
        The rows, best first, and their scores, float32 [n].
    """
    rows, inner_products = ranking
    scores = encoder.scores_from_inner_products(inner_products)
    gains = encoder.agreement(local, snapshot.locals_at(rows[: encoder.candidates]))
    order, scores = reranked(scores, gains)
    return rows[order], scores


def _judge(
    map_: Map, encoder: Encoder, snapshot: Snapshot, scored: Ranking, k: int, settle: bool
) -> tuple[Judgement, list[tuple[float, Place]], Calibration] | None:
    """Judge what was found; None if a place was deleted since the snapshot, unless it is to settle for the others."""
    record = map_.record
    rows, scores = scored
    places = map_.places_at(rows[:k].tolist())
    if None in places:
        if not settle:
            return None
        kept = np.ones(len(rows), np.bool_)
        kept[: len(places)] = [place is not None for place in places]
        rows, scores = rows[kept], scores[kept]
    calibration = record.calibration or encoder.calibration
    neighborhood = Neighborhood(record.same_place_radius, record.same_place_frames)
    judgement = judge(scores, snapshot.whereabouts.take(rows), calibration, neighborhood, encoder.candidates)
    present = [place for place in places if place is not None]
    matches = [(float(score), place) for score, place in zip(scores, present, strict=False)]
    return judgement, matches, calibration
