"""The JSON answer to a query, from the answer of :mod:`core.recognition`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Annotated

from fastapi import Depends

from core.judgement.change import UsualScore, WorldChange, change_of
from core.judgement.position import PoseEstimate
from core.recognition.recognition import Answer
from core.recognition.stages import Candidates
from core.store import Map
from service.engine.encoders import Encoded
from service.http.routing import FromState, rounded
from service.places.schemas import PlaceView
from service.queries.schemas import (
    ChangeView,
    EstimatedPose,
    Match,
    QueryAnswer,
    Reason,
    RivalGroup,
    ScoreParts,
    VerificationView,
)
from service.queries.statistics import QueryStatistics

UsualScores = Callable[[str], UsualScore]
"""Returns the usual score of recognized frames at a place, by its id."""

StatisticsDep = Annotated[QueryStatistics, Depends(FromState("statistics"))]


def answer_of(map_: Map, encoded: Encoded, found: Answer, usual: UsualScores | None = None) -> QueryAnswer:
    """The JSON answer to a frame.

    Args:
        usual: returns the usual score at a place; None: none is known.
    """
    judgement = found.judgement
    weights: Sequence[float | None] = found.weights or [None] * len(found.matches)
    matches = [
        Match(
            rank=at + 1, score=score, parts=score_parts(found.candidates, at), weight=weight, place=PlaceView.of(place)
        )
        for at, ((score, place), weight) in enumerate(zip(found.matches, weights, strict=True))
    ]
    recognized = judgement.verdict == "recognized"
    return QueryAnswer(
        verdict=judgement.verdict,
        place=matches[0].place if recognized else None,
        probability=judgement.probability,
        change=ChangeView.of(change_in(found, usual)),
        pose=estimated_pose(found.pose, matches[0].place, found.note) if recognized else None,
        score=judgement.score,
        margin=judgement.margin,
        decision=judgement.decision,
        threshold=found.calibration.threshold,
        reason=None if matches else _why_nothing(found, encoded),
        note=found.lens,
        matches=matches,
        rivals=[
            RivalGroup(places=list(group.places), score=group.score, same_place=group.same_place)
            for group in found.rivals
        ],
        verification=verification_view(found) if matches else None,
        revision=map_.record.revision,
        encoder=encoded.encoder.identity,
        milliseconds=rounded({**encoded.milliseconds, **_searching(found)}),
    )


def change_in(found: Answer, usual: UsualScores | None = None) -> WorldChange | None:
    """The change that a frame shows; None without a match, for several frames that were fused, and without a curve."""
    if not found.matches or found.candidates.first is None:
        return None
    known = UsualScore() if usual is None else usual(found.matches[0][1].id)
    return change_of(found.judgement, found.calibration, float(found.candidates.scores[0]), known)


def _why_nothing(found: Answer, encoded: Encoded) -> Reason:
    """Why there is no match."""
    if found.blank:
        return "no-regions" if encoded.few_values is None else "few-values"
    return "no-place-allowed" if found.candidates.places else "empty-map"


def _searching(found: Answer) -> dict[str, float]:
    """The times of the search and of the third stage, if there were any."""
    stage = found.third_stage
    times = {} if found.blank else {"search": found.search}
    return times | ({"verify": stage.milliseconds} if stage.state == "verified" else {})


def score_parts(candidates: Candidates, at: int) -> ScoreParts | None:
    """The parts of the score of the place at a position of a ranking; None where several frames were fused."""
    if candidates.first is None:
        return None
    verified = candidates.verifications[at] if at < len(candidates.verifications) else None
    similarity, score = float(candidates.first[at]), float(candidates.scores[at])
    geometry = None if candidates.geometry is None else float(candidates.geometry.gain[at])
    return ScoreParts(
        similarity=similarity,
        agreement=score - similarity,
        geometry=geometry,
        inliers=None if verified is None else verified.inlier_count,
        keypoints=None if verified is None else min(verified.keypoints),
        evidence=None if verified is None else verified.evidence,
    )


def verification_view(found: Answer) -> VerificationView:
    """The JSON view of the third stage."""
    stage = found.third_stage
    verified = sum(one is not None for one in found.candidates.verifications)
    keypoints = None if stage.keypoints is None else len(stage.keypoints)
    return VerificationView(state=stage.state, candidates=verified, keypoints=keypoints)


def estimate_at(estimate: PoseEstimate | None, best: PlaceView | None) -> PoseEstimate | None:
    """An estimated pose with a height if the place of the best match has one: on the Earth it is that of the place."""
    if estimate is None or best is None or best.pose is None:
        return estimate
    if estimate.pose.kind() == "geographic":
        return estimate.at_height(best.pose.z)
    return estimate.without_height() if best.pose.z is None else estimate


def estimated_pose(estimate: PoseEstimate | None, best: PlaceView, note: str | None = None) -> EstimatedPose | None:
    """The JSON view of an estimated pose; it has no ``z`` if the pose of the best match has none.

    Args:
        note: why the camera's intrinsics were not used, as ``core.errors.UnfitIntrinsics`` says it; None if they were,
            or if there are none.
    """
    if (estimate := estimate_at(estimate, best)) is None:
        return None
    return EstimatedPose(
        **estimate.pose.model_dump(exclude_none=True),
        spread=estimate.spread,
        heading_spread=estimate.heading_spread,
        places=estimate.places,
        heading_offset=estimate.heading_offset,
        offset_spread=estimate.offset_spread,
        source=estimate.source,
        note=note,
        covariance=estimate.covariance.ravel().tolist(),
    )
