"""Routes of the latest answers of a map, and of those in which one place was found."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Query
from pydantic import BaseModel, ConfigDict, Field

from core import errors
from core.judgement.verdict import Verdict
from core.places import Timestamp
from service.access.roles import Principal
from service.errors.problems import problem_documentation
from service.http.routing import EngineDep, MapId, PlaceId, PrincipalDep, StrictRoute, single_values
from service.http.schemas import Parameters
from service.queries.answers import StatisticsDep
from service.queries.counts import HourCount
from service.queries.given_answers import GivenAnswer
from service.queries.recent_answers import MOST_OF_MAP
from service.queries.schemas import CHANGE_EXAMPLE, ChangeView, EstimatedPose
from service.queries.statistics import map_key

router = APIRouter(
    prefix="/v1/maps/{map}", tags=["queries"], route_class=StrictRoute, dependencies=[Depends(single_values)]
)

ANSWER_EXAMPLE: dict[str, Any] = {
    "at": "2026-11-22T18:02:31.977000Z",
    "verdict": "recognized",
    "run": None,
    "probability": 0.97,
    "place": "p7",
    "change": CHANGE_EXAMPLE,
    "pose": None,
    "score": 0.41,
    "margin": 0.12,
    "decision": 0.32,
    "threshold": 0.09,
    "reason": None,
    "matches": [{"place": "p7", "score": 0.41}, {"place": "p8", "score": 0.29}],
    "camera": "front",
    "session": None,
    "frame": None,
    "operation": "query",
    "milliseconds": 21.3,
    "request_id": "565799d7ff8041ac7be3833c12160c09",
    "principal": "robot-7",
    "key": "c69fcf6b7439",
    "client": "10.0.0.7",
}


class RecentMatch(BaseModel):
    """A place that resembled a query."""

    place: str = Field(description="Id of the place.")
    score: float


class RecentAnswerView(BaseModel):
    """The answer to a query of the last time, without the frame."""

    model_config = ConfigDict(json_schema_extra={"examples": [ANSWER_EXAMPLE]})

    at: Timestamp
    verdict: Verdict = Field(description="Of this frame alone.")
    run: Verdict | None = Field(
        default=None,
        description="Of the run that the frame belongs to, after it: what the robot was told; null: none.",
    )
    probability: float | None
    place: str | None = Field(description="Id of the place, if it was recognized.")
    change: ChangeView | None = None
    pose: EstimatedPose | None
    score: float | None
    margin: float | None
    decision: float | None
    threshold: float
    reason: str | None
    matches: list[RecentMatch] = Field(description="The best five.")
    camera: str | None = Field(description="The name of the camera that took the frame, if the request named it.")
    session: str | None = Field(description="The session that the frame belongs to; null: none.")
    frame: int | None = Field(description="The robot's number of the frame of the session.")
    operation: str | None = Field(description="The operation that gave the answer, such as `query` or `send_frame`.")
    milliseconds: float | None = Field(description="From the arrival of the request; null for a part of a request.")
    request_id: str | None
    principal: str | None = Field(description="The name of the caller's key; only admins see it, and the next two.")
    key: str | None
    client: str | None

    @classmethod
    def fields_of(cls, answer: GivenAnswer, principal: Principal) -> dict[str, Any]:
        """The fields of an answer, as a caller may see them."""
        asker, sees_all = answer.asker, principal.role == "admin"
        return {
            **{name: getattr(answer, name) for name in _SAME},
            "matches": [RecentMatch(place=place, score=score) for place, score in answer.matches],
            "camera": answer.frame.camera,
            "session": answer.frame.session,
            "frame": answer.frame.number,
            "operation": asker.operation,
            "milliseconds": answer.milliseconds.get("total"),
            "request_id": asker.request_id,
            "principal": asker.principal if sees_all else None,
            "key": asker.key if sees_all else None,
            "client": asker.client if sees_all else None,
        }


_SAME = (
    "at", "verdict", "run", "probability", "place", "change", "pose", "score", "margin", "decision", "threshold",
    "reason",
)  # fmt: skip


class PlaceMatchView(RecentAnswerView):
    """An answer that lists a certain place."""

    model_config = ConfigDict(json_schema_extra={"examples": [ANSWER_EXAMPLE | {"rank": 1}]})

    rank: int = Field(description="The rank of the place among the matches.")


class RecentAnswerList(BaseModel):
    """The latest answers of a map, the latest first, on one page."""

    items: list[RecentAnswerView]
    next_cursor: None = None
    kept: int = Field(description=f"How many answers are stored now; at most {MOST_OF_MAP}, of this process.")
    hours: list[HourCount] = Field(
        description="Answers in each of the last 24 hours, if there were any; over restarts."
    )


class PlaceMatchList(BaseModel):
    """The latest answers that list a place, the latest first, on one page."""

    items: list[PlaceMatchView]
    next_cursor: None = None
    best: int = Field(description="How often the place was the best match since the counting began.")
    recognized: int = Field(description="How often it was recognized.")
    last_at: Timestamp | None = Field(description="When it was last the best match.")


class LatestParameters(Parameters):
    """How many answers, and of which frames."""

    limit: int = Field(default=100, ge=1, le=MOST_OF_MAP, description="Most answers, the latest ones.")
    camera: str | None = Field(default=None, max_length=128, description="Only answers to frames of this camera.")
    session: str | None = Field(default=None, max_length=128, description="Only answers to frames of this session.")

    def wants(self, answer: GivenAnswer) -> bool:
        """Whether an answer is to be listed."""
        frame = answer.frame
        return self.camera in (None, frame.camera) and self.session in (None, frame.session)


class AnswerParameters(LatestParameters):
    """Which answers."""

    verdict: Verdict | None = Field(default=None, description="Only answers with this verdict.")

    def wants(self, answer: GivenAnswer) -> bool:
        """Whether an answer is to be listed."""
        return self.verdict in (None, answer.verdict) and super().wants(answer)


@router.get("/answers", responses=problem_documentation(errors.StorageFull))
def list_answers(
    map_id: MapId,
    options: Annotated[AnswerParameters, Query()],
    engine: EngineDep,
    statistics: StatisticsDep,
    principal: PrincipalDep,
) -> RecentAnswerList:
    """List the latest answers of a map, and how many there were in each of the last 24 hours.

    The answers are held in memory, so a restart forgets them; the counts are stored on disk. The caller is shown to
    admins. What a person tries in the console is neither listed nor counted.
    """
    key = map_key(engine.maps.get(map_id))
    stored = statistics.recent.of_map(key)
    wanted = [one for one in stored if options.wants(one)][: options.limit]
    return RecentAnswerList(
        items=[RecentAnswerView(**RecentAnswerView.fields_of(one, principal)) for one in wanted],
        kept=len(stored),
        hours=statistics.hours(key),
    )


@router.get("/places/{place}/matches", responses=problem_documentation(errors.UnknownPlace, errors.StorageFull))
def list_place_matches(
    map_id: MapId,
    place_id: PlaceId,
    options: Annotated[LatestParameters, Query()],
    engine: EngineDep,
    statistics: StatisticsDep,
    principal: PrincipalDep,
) -> PlaceMatchList:
    """List the latest answers that have a place among their five best matches, and how often it was the best."""
    map_ = engine.maps.get(map_id)
    map_.place(place_id)
    key = map_key(map_)
    stored = [one for one in statistics.recent.of_map(key) if options.wants(one)]
    found = [(one, rank) for one in stored if (rank := one.rank_of(place_id)) is not None]
    count = statistics.of_place(key, place_id)
    return PlaceMatchList(
        items=[
            PlaceMatchView(**PlaceMatchView.fields_of(one, principal), rank=rank)
            for one, rank in found[: options.limit]
        ],
        best=count.best,
        recognized=count.recognized,
        last_at=datetime.fromisoformat(count.last) if count.last else None,
    )
