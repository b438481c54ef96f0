"""What follows an answer: the listeners of the map are told of it, and a doubtful frame is kept for review."""

from __future__ import annotations

from collections.abc import Mapping

from core.maps import Map
from service.access.audit import ASKER
from service.engine.engine import Engine
from service.events.schemas import QueryEvent
from service.queries.recent_answers import AskedFrame
from service.queries.schemas import QueryAnswer

REVIEWED = {
    "request_id", "key", "operation", "verdict", "probability", "best", "score", "decision", "threshold", "reason",
    "camera", "session", "frame", "file", "revision",
}  # fmt: skip
"""What is kept of an answer with a frame for review …"""

MOST_MATCHES = 5
"""… beside so many of its best matches."""


def follow_answer(
    engine: Engine,
    map_: Map,
    answer: QueryAnswer,
    frame: bytes,
    asked: AskedFrame,
    file: str | None = None,
    milliseconds: Mapping[str, float] | None = None,
    review: bool = True,
) -> None:
    """Tell the listeners of a map, if it has any, how a frame was answered, and keep the frame if the map says so.

    Neither is waited for.

    Args:
        frame: the bytes of the frame's file; listeners see a picture of it only if the map keeps pictures.
        asked: whose frame it is.
        file: the name of the file part that the frame was.
        milliseconds: of the whole request, where the answer does not say it.
        review: whether the map may keep the frame.
    """
    record = map_.record
    is_kept = review and record.review is not None and answer.verdict in record.review.verdicts
    if not is_kept and not engine.events.heard(record.id):
        return
    explanation = answer.explanation
    event = QueryEvent.now(
        record.id,
        operation=ASKER.get().operation,
        verdict=answer.verdict,
        probability=answer.probability,
        place=None if answer.place is None else answer.place.id,
        best=answer.matches[0].place.id if answer.matches else None,
        pose=None if answer.pose is None else answer.pose.model_dump(exclude_none=True),
        score=answer.score,
        decision=answer.decision,
        threshold=answer.threshold,
        reason=answer.reason,
        camera=asked.camera,
        session=asked.session,
        frame=asked.number,
        file=file,
        milliseconds={**answer.milliseconds, **(milliseconds or {})},
        revision=answer.revision,
        explanation=None if explanation is None else explanation.picture,
    )
    engine.events.publish(event, frame if record.keep != "none" else None)
    if is_kept:
        told = event.model_dump(mode="json", include=REVIEWED)
        matches = [{"place": match.place.id, "score": match.score} for match in answer.matches[:MOST_MATCHES]]
        engine.review_keeper.offer(map_, frame, told | {"matches": matches})
