"""The latest answers of each map, in memory: what an operator looks through to see how queries fare."""

from __future__ import annotations

import threading
from collections import OrderedDict, deque
from collections.abc import Mapping
from datetime import UTC, datetime
from typing import NamedTuple

from core.judgement.verdict import Verdict
from service.access.audit import ASKER, Asker
from service.queries.schemas import EstimatedPose, QueryAnswer

MOST_OF_MAP = 500
"""Answers of one map that are kept."""

MOST = 20_000
"""Answers of all maps together; those of the map that was asked least recently go first."""

MOST_MATCHES = 5
"""Matches that are kept of one answer, the best ones."""

MapKey = tuple[str, str]
"""The id of a map and the time of its creation: a new map of the same id has answers of its own."""


class AskedFrame(NamedTuple):
    """Whose a frame is that was asked; None where that is not known.

    camera: the name of the camera that took it.
    session, number: the session that it belongs to, and the robot's number of it.
    """

    camera: str | None = None
    session: str | None = None
    number: int | None = None


class RecentAnswer(NamedTuple):
    """What is kept of an answer: no frame and no metadata, whose size nobody bounds.

    frame: whose frame it was.
    matches: ids and scores of the best matches, best first.
    milliseconds: of the answer; its request adds the total when it is done.
    asker: who asked, with which request.
    """

    at: datetime
    frame: AskedFrame
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
    asker: Asker

    @classmethod
    def of(cls, answer: QueryAnswer, frame: AskedFrame) -> RecentAnswer:
        """What is kept of an answer that is being given now."""
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
            answer.milliseconds,
            ASKER.get(),
        )

    def rank_of(self, place_id: str) -> int | None:
        """The rank of a place among the matches; None if it is not among those that are kept."""
        return next((rank for rank, (found, _) in enumerate(self.matches, start=1) if found == place_id), None)


class RecentAnswers:
    """The latest answers of each map, bounded in number.  Any thread may use it."""

    def __init__(self) -> None:
        self._kept: OrderedDict[MapKey, deque[RecentAnswer]] = OrderedDict()
        self._count = 0
        self._lock = threading.Lock()

    def add(self, key: MapKey, answer: QueryAnswer, frame: AskedFrame) -> None:
        """Keep an answer of a map."""
        made = RecentAnswer.of(answer, frame)
        with self._lock:
            of_map = self._kept.get(key)
            if of_map is None:
                of_map = self._kept[key] = deque(maxlen=MOST_OF_MAP)
            else:
                self._kept.move_to_end(key)
            self._count += len(of_map) < MOST_OF_MAP
            of_map.append(made)
            while self._count > MOST:
                self._count -= len(self._kept.popitem(last=False)[1])

    def of_map(self, key: MapKey) -> list[RecentAnswer]:
        """The answers of a map, the latest first."""
        with self._lock:
            return list(reversed(self._kept.get(key, ())))
