"""Several cameras of a robot at one moment as one query to a map."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from core.judgement.fusion import CameraRanking, Fused, fuse
from core.judgement.position import estimate_pose
from core.judgement.priors import decision_slope
from core.maps import Map
from core.method.encoder import Encoder
from core.recognition.question import Query
from core.recognition.recognition import ATTEMPTS, Answer, locate
from core.recognition.stages import Candidates, calibration_of, neighborhood_of, rank_places


def locate_rig(
    map_: Map,
    encoder: Encoder,
    queries: Sequence[Query],
) -> Answer:
    """Search one snapshot of a map for the frames of a rig, and judge them as one query.

    Args:
        encoder: the map's encoder.
        queries: the rig's frames that have regions, with one question; at least one.  Several are never verified.

    Raises:
        StorageFailure: the map's files cannot be read.
    """
    if len(queries) == 1:
        return locate(map_, encoder, queries)[0]
    question, encodings = queries[0].question, [query.encoding for query in queries]
    began = time.perf_counter()
    calibration, neighborhood = calibration_of(map_, encoder), neighborhood_of(map_)
    for _attempt in range(ATTEMPTS):  # again, if places were deleted during the search
        ranked = rank_places(map_, encoder, encodings, question.selection)
        if not len(ranked[0].rows):
            return locate(map_, encoder, queries[:1])[0]  # no place is allowed, or there is none
        views = [CameraRanking(one.rows, one.scores, one.whereabouts, one.examined, one.weights) for one in ranked]
        fused = fuse(views, calibration, neighborhood)
        places = map_.places_at(fused.rows[: question.k].tolist())
        if None not in places:
            break
    # A place that is deleted all the same is not listed; the verdict holds unless it was the best one.
    retained = [position for position, place in enumerate(places) if place is not None]
    judgement = (
        fused.judgement if retained[:1] == [0] else replace(fused.judgement, verdict="unknown", probability=None)
    )
    matches = [
        (float(fused.scores[position]), place) for position in retained if (place := places[position]) is not None
    ]
    candidates = _candidates_of_rig(fused, ranked[0], decision_slope(calibration))
    weights = None if ranked[0].weights is None else np.exp(fused.weights[retained]).tolist()
    pose = estimate_pose(fused.whereabouts, fused.log_odds, neighborhood.radius)
    milliseconds = 1e3 * (time.perf_counter() - began)
    return Answer(judgement, matches, weights, calibration, milliseconds, pose, encodings[0], candidates)


def _candidates_of_rig(fused: Fused, one: Candidates, steepness: float) -> Candidates:
    """The fused ranking as if it were one camera's: ordered by the scores that would give it the same log odds."""
    return replace(
        one,
        rows=fused.rows,
        scores=fused.scores,
        first=None,
        whereabouts=fused.whereabouts,
        examined=np.full(len(fused.rows), one.examined.any()),
        weights=fused.weights,
        ordered=(fused.log_odds / steepness).astype(np.float32),
    )
