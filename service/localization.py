"""From a query's descriptor to its answer: search, judge, look up; no HTTP."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from core.encoder import Encoder
from core.places import Place
from core.storage import Map, Ranking, Snapshot
from core.verdict import Calibration, Judgement, Neighborhood, judge

ATTEMPTS = 3
"""Snapshots to try while places are deleted under the search."""


@dataclass(frozen=True)
class Located:
    """The answer to one query.

    matches: score and place, best first; at most k.
    search: milliseconds of search, judgement and look-up.
    """

    judgement: Judgement
    matches: list[tuple[float, Place]]
    calibration: Calibration
    search: float


def locate(map_: Map, encoder: Encoder, descriptors: Sequence[NDArray[np.float32]], k: int) -> list[Located]:
    """Search one snapshot of a map for several queries and judge each.

    Args:
        encoder: that of the map.
        descriptors: float32 [D] each; at least one.
        k: how many matches to list.

    Raises:
        StorageFailure: the map's files cannot be read.
    """
    began = time.perf_counter()
    snapshot = map_.snapshot()
    rankings = snapshot.search_batch(np.stack(descriptors))
    share = 1e3 * (time.perf_counter() - began) / len(descriptors)
    located = []
    for descriptor, ranking in zip(descriptors, rankings, strict=True):
        began = time.perf_counter()
        current, attempt = snapshot, 1
        while (found := _judge(map_, encoder, current, ranking, k, settle=attempt == ATTEMPTS)) is None:
            current, attempt = map_.snapshot(), attempt + 1
            ranking = current.search(descriptor)
        judgement, matches, calibration = found
        located.append(Located(judgement, matches, calibration, share + 1e3 * (time.perf_counter() - began)))
    return located


def _judge(
    map_: Map, encoder: Encoder, snapshot: Snapshot, ranking: Ranking, k: int, settle: bool
) -> tuple[Judgement, list[tuple[float, Place]], Calibration] | None:
    """Judge a ranking; None if a place was deleted since the snapshot, unless it is to settle for the others."""
    record = map_.record
    rows, inner_products = ranking
    places = map_.places_at(rows[:k].tolist())
    if None in places:
        if not settle:
            return None
        kept = np.ones(len(rows), np.bool_)
        kept[: len(places)] = [place is not None for place in places]
        rows, inner_products = rows[kept], inner_products[kept]
    scores = encoder.scores_from_inner_products(inner_products)
    calibration = record.calibration or encoder.calibration
    neighborhood = Neighborhood(record.same_place_radius, record.same_place_frames)
    judgement = judge(scores, snapshot.whereabouts.take(rows), calibration, neighborhood)
    present = [place for place in places if place is not None]
    matches = [(float(score), place) for score, place in zip(scores, present, strict=False)]
    return judgement, matches, calibration
