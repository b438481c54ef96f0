"""Events as JSON."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any, ClassVar, Literal, Self

from pydantic import BaseModel, Field

from core.belief import ContradictionKind
from core.judgement.verdict import Verdict
from core.maps.records import AlarmName
from core.places import Pose, Timestamp
from service.access.audit import ASKER, Asker

EventKind = Literal["query", "enrolment", "session", "job", "map", "alarm"]

PRIVATE = frozenset({"key", "explanation"})
"""Fields that a key of the role query does not get: the caller, and the path of a picture of the frame."""


class Event(BaseModel):
    """The fields of all events."""

    kind: ClassVar[EventKind]

    at: Timestamp = Field(description="When it happened.")
    map: str
    request_id: str | None = Field(description="The id of the request that did it; null if none did.")
    key: str | None = Field(
        default=None,
        description="The name of the caller's key; null without one. Only for keys of the role enrol.",
    )

    @classmethod
    def now(cls, map_id: str, by: Asker | None = None, **fields: Any) -> Self:
        """An event of this moment.

        Args:
            by: the caller; None: the present one (``service.access.audit.ASKER``).
        """
        asker = ASKER.get() if by is None else by
        key = asker.principal if asker.key is not None else None
        return cls(at=datetime.now(UTC), map=map_id, request_id=asker.request_id, key=key, **fields)


NO_ASKER = Asker("")
"""For what happens by itself, such as the end of a session that nobody used."""


class QueryEvent(Event):
    """A frame was located in the map."""

    kind: ClassVar[EventKind] = "query"

    operation: str | None = Field(description="The operation that was called, such as query or send_frame.")
    verdict: Verdict = Field(description="Of this frame alone.")
    run: Verdict | None = Field(
        default=None,
        description="Of the run that the frame belongs to, after it: what the robot was told; null: none.",
    )
    probability: float | None
    place: str | None = Field(description="Id of the place; non-null only if recognized.")
    best: str | None = Field(description="Id of the best match, with any verdict.")
    change: dict[str, Any] | None = Field(
        default=None, description="Whether the frame shows the map as it is, as in the answer."
    )
    pose: dict[str, Any] | None = Field(description="The estimated pose, as in the answer.")
    score: float | None
    decision: float | None
    threshold: float | None
    reason: str | None = Field(description="Why the verdict is unknown, where no score says it.")
    camera: str | None = None
    session: str | None = Field(default=None, description="The session that the frame belongs to.")
    frame: int | None = Field(default=None, description="The robot's number of the frame.")
    question: dict[str, Any] | None = Field(
        default=None,
        description="The parameters of a query that asks the same, without those at their defaults; null if they are "
        "longer than 2000 characters.",
    )
    file: str | None = Field(default=None, description="The name of the file part that the frame was.")
    trial: bool = Field(default=False, description="Whether a person tried it in the console; then it is not counted.")
    milliseconds: dict[str, float]
    revision: int | None = Field(description="The revision of the map that answered.")
    explanation: str | None = Field(
        default=None,
        description="The path of the picture that explains the answer, if it was requested. Only for keys of the role "
        "enrol.",
    )


class ChangedPlace(BaseModel):
    """A place that an enrolment changed."""

    id: str
    change: str
    sequence: str | None
    pose: Pose | None
    camera: str | None


class EnrolmentEvent(Event):
    """Places of the map were created, changed or deleted, in one commit."""

    kind: ClassVar[EventKind] = "enrolment"

    operation: str | None = Field(description="The operation that was called, such as enrol_place.")
    changes: dict[str, int] = Field(
        description="How many places were created, updated, replaced, unchanged, deleted; `look-added` and "
        "`look-removed` count looks."
    )
    places: list[ChangedPlace] = Field(default_factory=list, description="The first of those that changed.")
    sequence: str | None = Field(default=None, description="The traverse that was deleted as a whole.")
    total: int = Field(description="How many places the map has now.")


class SessionEvent(Event):
    """A session began or ended, or a frame moved its belief."""

    kind: ClassVar[EventKind] = "session"

    session: str
    change: Literal["begun", "moved", "ended"]
    reason: str | None = Field(default=None, description="Why the session ended.")
    camera: str | None = None
    frame: int | None = Field(default=None, description="The robot's number of the frame.")
    frames: int | None = Field(default=None, description="How many frames the session has processed.")
    verdict: Verdict | None = None
    probability: float | None = None
    unknown: float | None = None
    lost: bool | None = None
    place: str | None = Field(default=None, description="Id of the place; non-null only if recognized.")
    pose: Pose | None = Field(default=None, description="The pose of that place.")
    motion: str | None = Field(default=None, description="How the robot's motion was known, as in the answer.")
    contradiction: ContradictionKind | None = Field(
        default=None, description="What odometry looks like where frames contradict it, as in the answer."
    )
    contradiction_note: str | None = Field(default=None, description="A sentence for a person on that.")
    world: dict[str, Any] | None = Field(
        default=None, description="Whether the frame shows the map as it is, by the run: `change` of the answer."
    )


class JobEvent(Event):
    """A job of the map changed its state, or went on."""

    kind: ClassVar[EventKind] = "job"

    job: str
    job_kind: str = Field(description="The kind of the job, such as re-encode.")
    state: str
    progress: dict[str, Any] = Field(description="`done`, `total` and `message`.")
    cancelling: bool
    problem: dict[str, Any] | None = Field(description="Why the job failed.")


class MapEvent(Event):
    """The map itself was changed."""

    kind: ClassVar[EventKind] = "map"

    change: Literal["edited", "calibrated", "cameras", "deleted"]
    fields: list[str] = Field(default_factory=list, description="The settings that were edited.")
    revision: int | None = Field(description="The revision of the map's record; null if it was deleted.")


class AlarmEvent(Event):
    """A trend has reached the number that the map's settings name, or is under it again."""

    kind: ClassVar[EventKind] = "alarm"

    alarm: AlarmName
    raised: bool = Field(description="False: it is cleared.")
    count: int = Field(description="How many places or stretches there are.")
    limit: int | None = Field(description="From which number on it is raised; null: the setting was taken back.")
    sentence: str = Field(description="What has happened, and what to do about it.")
    places: list[str] = Field(description="The first of the places; of stretches, the first place of each.")


class Listening(BaseModel):
    """The first event of a stream: the selection of the events that follow."""

    map: str
    kinds: list[EventKind]
    verdicts: list[Verdict] | None = Field(description="The verdicts of the queries that are sent; null: all.")
    pictures: bool = Field(description="Whether queries come with a small picture of the frame.")


class Missed(BaseModel):
    """Events of the map are lost for this listener, which was away, or too slow, for too long."""

    map: str
    count: int | None = Field(description="How many, of any kind; null if that is not known.")
