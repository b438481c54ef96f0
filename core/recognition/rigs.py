"""Several cameras of a robot at one moment as one query to a map."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from core.geometry.verification import Verification
from core.judgement.fusion import CameraRanking, Fused, fuse, witnesses
from core.judgement.position import estimate_pose
from core.judgement.priors import decision_slope
from core.judgement.verdict import Judgement
from core.method.encoder import Encoder
from core.recognition.pose_survey import place_errors
from core.recognition.question import Query
from core.recognition.recognition import ATTEMPTS, Answer, first_looks, judgement_of, locate, places_of, rival_places
from core.recognition.stages import Candidates, calibration_of, neighborhood_of, rank_places
from core.recognition.verification import ThirdStage, VerificationState, third_stage
from core.store import Map


def locate_rig(
    map_: Map,
    encoder: Encoder,
    queries: Sequence[Query],
) -> Answer:
    """Search one snapshot of a map for the frames of a rig, and judge them as one query.

    Args:
        encoder: the map's encoder.
        queries: the rig's frames that have regions, with one question; at least one.  With ``auto`` the candidates of
            all cameras are verified if the scores of one leave doubt: a place that was verified for one camera alone
            cannot be compared with those of another.

    Raises:
        StorageFailure: the map's files cannot be read.
    """
    if len(queries) == 1:
        return locate(map_, encoder, queries)[0]
    question, encodings = queries[0].question, [query.encoding for query in queries]
    began = time.perf_counter()
    calibration, neighborhood = calibration_of(map_, encoder), neighborhood_of(map_)
    judged = partial(judgement_of, map_, encoder)
    for _attempt in range(ATTEMPTS):  # again, if places were deleted during the search
        ranked = rank_places(map_, encoder, encodings, question.selection)
        if not len(ranked[0].rows):
            return locate(map_, encoder, queries[:1])[0]  # no place is allowed, or there is none
        saying = witnesses([_ranking(*one) for one in zip(ranked, queries, strict=True)], calibration)
        if len(saying) == 1:
            return locate(map_, encoder, [queries[saying[0]]])[0]
        ranked, queries = [ranked[one] for one in saying], [queries[one] for one in saying]
        verified = [
            third_stage(map_, encoder, candidates, judged, query)
            for candidates, query in zip(ranked, queries, strict=True)
        ]
        alone = [int(one.rows[0]) if found.verdict == "recognized" else None for one, found, _ in verified]
        if any(stage.state == "verified" for *_, stage in verified):
            verified = [
                one if _is_verified(one[0]) else _later(one, third_stage(map_, encoder, candidates, judged, query))
                for one, candidates, query in zip(verified, ranked, map(_all_of, queries), strict=True)
            ]
        finals, stage = [candidates for candidates, _, _ in verified], _joint_stage([stage for *_, stage in verified])
        twins = [tuple(one.rows[list(found.twins)].tolist()) for one, found, _ in verified]
        views = [_ranking(*one) for one in zip(finals, queries, alone, twins, strict=True)]
        fused = fuse(views, calibration, neighborhood)
        places = places_of(map_, fused.rows, question.k)
        if None not in places:
            break
    # A place that is deleted all the same is not listed; the verdict holds unless it was the best one.
    retained = first_looks(places)
    judgement = (
        fused.judgement if retained[:1] == [0] else replace(fused.judgement, verdict="unknown", probability=None)
    )
    matches = [
        (float(fused.scores[position]), place) for position in retained if (place := places[position]) is not None
    ]
    candidates = _candidates_of_rig(fused, finals, decision_slope(calibration))
    weights = None if ranked[0].weights is None else np.exp(fused.weights[retained]).tolist()
    level = fused.whereabouts.on_level_of(0, neighborhood.height)
    errors = place_errors(map_, fused.rows.tolist(), level, surveyed=False)
    pose = estimate_pose(level, fused.log_odds, neighborhood.radius, errors=errors)
    rivals = rival_places(map_, candidates, judgement)
    if len(retained) < len(places):
        candidates = candidates.take(np.append(retained, np.arange(len(places), len(candidates.rows))))
    milliseconds = 1e3 * (time.perf_counter() - began) - stage.milliseconds
    return Answer(judgement, matches, weights, calibration, milliseconds, pose, encodings[0], candidates, stage, rivals)


Verified = tuple[Candidates, Judgement, ThirdStage]


def _ranking(
    one: Candidates, query: Query, recognized: int | None = None, twins: tuple[int, ...] = ()
) -> CameraRanking:
    """The candidates of one camera as the fusion sees them.

    Args:
        recognized: the row that the camera recognizes as a plain query.
        twins: rows of places on other storeys that it may as well see.
    """
    ranked = one.rows, one.scores, one.whereabouts, one.examined, one.weights, one.geometry
    return CameraRanking(*ranked, query.encoding.descriptor, recognized, twins)


def _all_of(query: Query) -> Query:
    """The query with its candidates to be verified in any case, and its keypoints, if they were found already."""
    if (verifier := query.verifier) is None:
        return query
    question = replace(query.question, verify="always")
    return replace(query, question=question, find_keypoints=lambda: verifier.keypoints)


def _is_verified(candidates: Candidates) -> bool:
    """Whether more than the best match was verified."""
    return sum(one is not None for one in candidates.verifications) > 1


def _later(before: Verified, after: Verified) -> Verified:
    """The outcome of a second verification, which took the time of both."""
    candidates, judgement, stage = after
    return candidates, judgement, replace(stage, milliseconds=before[2].milliseconds + stage.milliseconds)


def _joint_stage(stages: Sequence[ThirdStage]) -> ThirdStage:
    """The outcome of the third stage for all cameras: ``verified`` if any was."""
    order: tuple[VerificationState, ...] = ("verified", "not-needed", "no-keypoints", "never")
    state = min((stage.state for stage in stages), key=order.index)
    return ThirdStage(state, milliseconds=sum(stage.milliseconds for stage in stages))


def _candidates_of_rig(fused: Fused, views: Sequence[Candidates], steepness: float) -> Candidates:
    """The fused ranking as if it were one camera's: ordered by the scores that would give it the same log odds.

    Of several verifications of one place it has the one with the most evidence.
    """
    one = views[0]
    found: dict[int, Verification] = {}
    for view in views:
        for row, result in zip(view.rows.tolist(), view.verifications, strict=False):
            if result is not None and (row not in found or result.evidence > found[row].evidence):
                found[row] = result
    return replace(
        one,
        rows=fused.rows,
        scores=fused.scores,
        first=None,
        whereabouts=fused.whereabouts,
        examined=np.full(len(fused.rows), one.examined.any()),
        weights=fused.weights,
        ordered=(fused.log_odds / steepness).astype(np.float32),
        geometry=None,
        verifications=tuple(found.get(row) for row in fused.rows.tolist()) if found else (),
    )
