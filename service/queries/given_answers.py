"""Answers as they were given, for listeners, counts, lists and review."""

from __future__ import annotations

import json
from collections.abc import Mapping
from datetime import UTC, datetime
from typing import Any, NamedTuple

from core.judgement.verdict import Verdict
from service.access.audit import ASKER, Asker
from service.events.schemas import QueryEvent
from service.queries.schemas import ChangeView, EstimatedPose, QueryAnswer
from service.telemetry.requests import is_trial

MOST_MATCHES = 5
"""Matches that are stored of one answer, the best ones."""

LONGEST_QUESTION = 2000
"""Characters of the JSON of a question that listeners get."""

MapKey = tuple[str, str]
"""The id of a map and the time of its creation: a new map of the same id has answers of its own."""


class QueriedFrame(NamedTuple):
    """The origin of a queried frame; None where it is not known.

    camera: the name of the camera that took it.
    session, number: the session that it belongs to, and the robot's number of it.
    question: the parameters of the question, as :meth:`~service.queries.parameters.FilterParameters.again` gives them.
    taken: when it was taken, as the robot said.
    """

    camera: str | None = None
    session: str | None = None
    number: int | None = None
    question: Mapping[str, Any] | None = None
    taken: datetime | None = None


class GivenAnswer(NamedTuple):
    """An answer without the frame and without metadata, whose size nobody bounds.

    frame: the origin of the frame.
    matches: ids and scores of the best matches, best first.
    milliseconds: of the answer and of its request.
    revision: of the map that answered.
    asker: the caller, and its request.
    run: the verdict of the run that the frame belongs to, after it; None: it belongs to none.
    """

    at: datetime
    frame: QueriedFrame
    verdict: Verdict
    probability: float | None
    place: str | None
    pose: EstimatedPose | None
    score: float | None
    margin: float | None
    decision: float | None
    threshold: float
    reason: str | None
    matches: tuple[tuple[str, float], ...]
    milliseconds: Mapping[str, float]
    revision: int | None
    asker: Asker
    change: ChangeView | None = None
    run: Verdict | None = None

    @classmethod
    def of(
        cls,
        answer: QueryAnswer,
        frame: QueriedFrame,
        milliseconds: Mapping[str, float] | None = None,
        run: Verdict | None = None,
    ) -> GivenAnswer:
        """An answer that is being given now.

        Args:
            milliseconds: of the whole request, where the answer does not say it.
            run: as of the fields.
        """
        return cls(
            datetime.now(UTC),
            frame,
            answer.verdict,
            answer.probability,
            None if answer.place is None else answer.place.id,
            answer.pose,
            answer.score,
            answer.margin,
            answer.decision,
            answer.threshold,
            answer.reason,
            tuple((match.place.id, match.score) for match in answer.matches[:MOST_MATCHES]),
            {**answer.milliseconds, **(milliseconds or {})},
            answer.revision,
            ASKER.get(),
            answer.change,
            run,
        )

    @property
    def told(self) -> Verdict:
        """The verdict that the robot was told: of its run or, without one, of the frame."""
        return self.verdict if self.run is None else self.run

    @property
    def best(self) -> str | None:
        """The id of the best match, with any verdict."""
        return self.matches[0][0] if self.matches else None

    def event(self, map_id: str, file: str | None = None, explanation: str | None = None) -> QueryEvent:
        """The event for the listeners of the map.

        Args:
            file: the name of the file part that the frame was.
            explanation: the path of the picture that explains the answer.
        """
        same = {name: getattr(self, name) for name in _SAME}
        question = dict(self.frame.question or {})
        short = len(json.dumps(question)) <= LONGEST_QUESTION
        return QueryEvent(
            **same,
            map=map_id,
            request_id=self.asker.request_id,
            key=self.asker.principal if self.asker.key is not None else None,
            operation=self.asker.operation,
            change=None if self.change is None else self.change.model_dump(),
            pose=None if self.pose is None else self.pose.model_dump(exclude_none=True),
            camera=self.frame.camera,
            session=self.frame.session,
            frame=self.frame.number,
            question=question if short else None,
            file=file,
            trial=is_trial(),
            milliseconds=dict(self.milliseconds),
            explanation=explanation,
        )

    def for_review(self, event: QueryEvent) -> dict[str, Any]:
        """The part of the answer that is stored with a frame for review, as JSON values."""
        shown = event.model_dump(mode="json", include=REVIEWED)
        taken = {} if self.frame.taken is None else {"taken": self.frame.taken.isoformat()}
        return shown | taken | {"matches": [{"place": place, "score": score} for place, score in self.matches]}

    def rank_of(self, place_id: str) -> int | None:
        """The rank of a place among the matches; None if it is not among the stored ones."""
        return next((rank for rank, (found, _) in enumerate(self.matches, start=1) if found == place_id), None)


_SAME = ("at", "verdict", "run", "probability", "place", "best", "score", "decision", "threshold", "reason", "revision")

REVIEWED = {
    "request_id", "key", "operation", "verdict", "probability", "best", "score", "decision", "threshold", "reason",
    "camera", "session", "frame", "file", "revision",
}  # fmt: skip
