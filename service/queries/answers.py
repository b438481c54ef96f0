"""From what was located to what callers are told."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from core.judgement.position import PoseEstimate
from core.recognition.localization import Located, calibration_of, locate
from core.recognition.selection import Selection
from core.storage import Map
from service.engine.engine import Engine
from service.engine.queue import Encoded
from service.http.dependencies import rounded
from service.places.schemas import PlaceView
from service.queries.schemas import EstimatedPose, Match, QueryAnswer

MOST_AHEAD = 4000
"""Places of a map that is searched where frames are encoded, in some milliseconds."""


async def answer_queries(
    engine: Engine, map_: Map, encoded: Sequence[Encoded], k: int, selection: Selection | None = None
) -> list[QueryAnswer]:
    """The answers to frames that were encoded by the map's encoder, in their order; counted.

    Raises:
        StorageFailure: the map's files cannot be read.
    """
    seen = [one for one in encoded if len(one.encoding.regions)]
    if len(seen) == 1 and seen[0].followed is not None:
        located: list[Located] = seen[0].followed
    else:
        encodings = [one.encoding for one in seen]
        located = await engine.searches.locate(map_, seen[0].encoder, encodings, k, selection) if seen else []
    remaining = iter(located)
    answers = []
    for one in encoded:
        answer = answer_of(one, next(remaining)) if len(one.encoding.regions) else blank_answer(map_, one)
        count_answer(engine, map_, answer)
        answers.append(answer)
    return answers


@dataclass(frozen=True)
class SearchAhead:
    """The search for frames in a map, to be done where they were encoded; equal ones are done together."""

    map_: Map
    k: int

    def __call__(self, encoded: Sequence[Encoded]) -> list[list[Located] | None]:
        """What was located of each frame; None for those that are searched for in their own place."""
        seen = [one for one in encoded if len(one.encoding.regions)]
        if not seen or not self.map_.snapshot().holds:  # what is not in memory comes from the disk
            return [None] * len(encoded)
        found = iter(locate(self.map_, seen[0].encoder, [one.encoding for one in seen], self.k))
        return [[next(found)] if len(one.encoding.regions) else None for one in encoded]


def search_ahead(map_: Map, k: int, selection: Selection | None) -> SearchAhead | None:
    """The search for a frame where it was encoded; None where other frames might wait long for it."""
    if selection is not None or map_.count_places() > MOST_AHEAD:
        return None
    return SearchAhead(map_, k)


def count_answer(engine: Engine, map_: Map, answer: QueryAnswer) -> None:
    """Count an answer in the service's figures and in those of the map's health."""
    engine.metrics.observe_answer(map_.record.id, answer.verdict, answer.score)
    engine.upkeep.observe(map_.record.id, answer)
    if "search" in answer.milliseconds:
        engine.metrics.searches.observe(answer.milliseconds["search"] / 1e3)


def answer_of(encoded: Encoded, located: Located) -> QueryAnswer:
    """The answer to a frame that was searched for."""
    judgement = located.judgement
    weights: Sequence[float | None] = located.weights or [None] * len(located.matches)
    matches = [
        Match(rank=rank, score=score, weight=weight, place=PlaceView.of(place))
        for rank, ((score, place), weight) in enumerate(zip(located.matches, weights, strict=True), start=1)
    ]
    recognized = judgement.verdict == "recognized"
    return QueryAnswer(
        verdict=judgement.verdict,
        place=matches[0].place if recognized else None,
        probability=judgement.probability,
        pose=estimated_pose(located.pose, matches[0].place) if recognized else None,
        score=judgement.score,
        margin=judgement.margin,
        decision=judgement.decision,
        threshold=located.calibration.threshold,
        reason=None if matches else "no-place-allowed" if located.scored.places else "empty-map",
        matches=matches,
        encoder=encoded.encoder.identity,
        milliseconds=rounded({**encoded.milliseconds, "search": located.search}),
    )


def estimated_pose(estimate: PoseEstimate | None, best: PlaceView) -> EstimatedPose | None:
    """An estimate as callers see it; in the plane where the best match's pose is."""
    if estimate is None:
        return None
    pose = estimate.pose
    if best.pose is not None and best.pose.z is None:
        pose = pose.model_copy(update={"z": None})
    return EstimatedPose(
        **pose.model_dump(exclude_none=True),
        spread=estimate.spread,
        heading_spread=estimate.heading_spread,
        places=estimate.places,
    )


def blank_answer(map_: Map, encoded: Encoded) -> QueryAnswer:
    """The answer to a frame without regions: there is nothing to compare."""
    return QueryAnswer(
        verdict="unknown",
        place=None,
        probability=None,
        pose=None,
        score=None,
        margin=None,
        decision=None,
        threshold=calibration_of(map_, encoded.encoder).threshold,
        reason="no-regions",
        matches=[],
        encoder=encoded.encoder.identity,
        milliseconds=rounded(encoded.milliseconds),
    )
