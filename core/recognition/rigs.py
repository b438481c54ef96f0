"""Several cameras of one moment as one query to a map; no HTTP."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from core.judgement.fusion import Fused, View, fuse
from core.judgement.position import estimate_pose
from core.judgement.priors import log_odds_per_score
from core.method.encoder import Encoder, Encoding
from core.recognition.recognition import ATTEMPTS, Answer, locate
from core.recognition.selection import EVERYTHING, Selection
from core.recognition.stages import Candidates, agree, calibration_of, neighborhood_of, search
from core.storage import Map


def locate_rig(
    map_: Map, encoder: Encoder, encodings: Sequence[Encoding], k: int, selection: Selection | None = None
) -> Answer:
    """Search one snapshot of a map for the frames of a rig and judge them as one.

    Args:
        encoder: that of the map.
        encodings: of the frames that have regions, made by it; at least one.
        k: how many matches to list.
        selection: what is known of the place asked for; None: nothing.

    Raises:
        StorageFailure: the map's files cannot be read.
    """
    if len(encodings) == 1:
        return locate(map_, encoder, encodings, k, selection)[0]
    began = time.perf_counter()
    attempt = 1
    while (found := _attempt(map_, encoder, encodings, k, selection, settle=attempt == ATTEMPTS)) is None:
        attempt += 1
    return replace(found, search=1e3 * (time.perf_counter() - began))


def _attempt(
    map_: Map, encoder: Encoder, encodings: Sequence[Encoding], k: int, selection: Selection | None, settle: bool
) -> Answer | None:
    """None if a place was deleted since the snapshot, unless it is to settle for the others."""
    snapshot = map_.snapshot()
    choice = selection.choice(map_, snapshot) if selection else EVERYTHING
    rankings = search(snapshot, np.stack([encoding.descriptor for encoding in encodings]), choice)
    found = [
        agree(map_, encoder, snapshot, encoding.local, ranking, choice)
        for encoding, ranking in zip(encodings, rankings, strict=True)
    ]
    if not len(found[0].rows):
        return locate(map_, encoder, encodings[:1], k, selection)[0]
    views = [View(one.rows, one.scores, one.whereabouts, one.examined, one.weights) for one in found]
    calibration, neighborhood = calibration_of(map_, encoder), neighborhood_of(map_)
    fused = fuse(views, calibration, neighborhood, encoder.candidates > 0)
    places = map_.places_at(fused.rows[:k].tolist())
    if None in places and not settle:
        return None
    # One that is gone by now is not told; the verdict stands if it is not the best one.
    kept = [position for position, place in enumerate(places) if place is not None]
    judgement = fused.judgement if kept[:1] == [0] else replace(fused.judgement, verdict="unknown", probability=None)
    matches = [(float(fused.scores[position]), place) for position in kept if (place := places[position]) is not None]
    pose = estimate_pose(fused.whereabouts, fused.log_odds, neighborhood.radius)
    steepness = log_odds_per_score(calibration, encoder.candidates > 0)
    candidates = _candidates_of_rig(fused, found[0], steepness)
    weights = None if choice.weights is None else np.exp(fused.weights[kept]).tolist()
    return Answer(judgement, matches, weights, calibration, 0.0, pose, encodings[0], candidates)


def _candidates_of_rig(fused: Fused, one: Candidates, steepness: float) -> Candidates:
    """The ranking of a rig as that of a query: in the order of what would give one camera the same log odds."""
    return replace(
        one,
        rows=fused.rows,
        scores=fused.scores,
        whereabouts=fused.whereabouts,
        examined=np.full(len(fused.rows), one.examined.any()),
        weights=fused.weights,
        ordered=(fused.log_odds / steepness).astype(np.float32),
    )
