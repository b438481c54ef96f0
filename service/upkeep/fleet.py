"""The fleet: robots of all maps by their open sessions and latest answers, and the answers of each hour."""

from __future__ import annotations

import json
from collections.abc import Iterable
from contextlib import suppress
from datetime import UTC, datetime, timedelta
from typing import Any

from fastapi import APIRouter, Depends
from pydantic import BaseModel, ConfigDict, Field

from core import errors
from core.judgement.verdict import Verdict
from core.maps import AlarmName
from core.places import Timestamp
from core.store import Map
from service.access.roles import Principal, covers
from service.engine.engine import Engine
from service.errors.problems import problem_documentation
from service.http.routing import EngineDep, PrincipalDep, StrictRoute, single_values
from service.queries.answers import StatisticsDep
from service.queries.counts import HourCount
from service.queries.given_answers import GivenAnswer, MapKey
from service.queries.histories.lost_robots import LISTED_FOR, LostRobot, robot_of
from service.queries.histories.tables import AlarmState
from service.queries.schemas import EstimatedPose
from service.queries.statistics import QueryStatistics, map_key
from service.sessions.routes import SessionsDep
from service.sessions.session import Session
from service.upkeep.trends import cleared, sentence

router = APIRouter(
    prefix="/v1/fleet", tags=["sessions"], route_class=StrictRoute, dependencies=[Depends(single_values)]
)

MOST_ROBOTS = 1000
"""Robots that are listed, those that were heard last."""

MOST_VERDICTS = 20
"""The latest verdicts of a robot that are listed."""

CLEARED_FOR = timedelta(days=1)
"""Alarms that were cleared are told for this time."""

SILENT_FOR = timedelta(hours=1)
"""A robot without an open session that has been silent for so long is lost no longer: it is not there."""

FLEET_EXAMPLE: dict[str, Any] = {
    "at": "2026-11-22T18:02:40Z",
    "maps": [
        {
            "map": "lab",
            "sessions": 1,
            "hours": [{"recognized": 840, "ambiguous": 12, "unknown": 48, "hour": "2026-11-22T18:00:00Z"}],
        }
    ],
    "robots": [
        {
            "map": "lab",
            "name": "robot-7",
            "session": "s-4f2a9c01d37be586",
            "camera": "front",
            "last_at": "2026-11-22T18:02:39Z",
            "verdict": "unknown",
            "place": "p7",
            "pose": None,
            "recognized_at": "2026-11-22T18:02:01Z",
            "lost_since": "2026-11-22T18:02:02Z",
            "contradiction_note": None,
            "verdicts": ["unknown", "unknown", "recognized"],
            "answers": 312,
        }
    ],
    "alarms": [
        {
            "map": "lab",
            "alarm": "changed_places",
            "raised": True,
            "count": 12,
            "since": "2026-11-22T06:10:00Z",
            "sentence": "12 places have changed. Add a look of each place as it is now.",
        }
    ],
    "lost": [
        {
            "map": "lab",
            "name": "robot-7",
            "session": "s-4f2a9c01d37be586",
            "camera": "front",
            "place": "p7",
            "raised": True,
            "since": "2026-11-22T18:02:02Z",
            "cleared_at": None,
            "last_at": "2026-11-22T18:02:39Z",
        }
    ],
}


class FleetMap(BaseModel):
    """The demand of robots on one map."""

    map: str
    sessions: int = Field(description="How many sessions are open.")
    hours: list[HourCount] = Field(description="Answers in each of the last 24 hours, if there were any.")


class FleetRobot(BaseModel):
    """One robot: an open session, or what one key or camera has asked without one."""

    map: str
    name: str | None = Field(description="The name of its key; null without one. Only for keys of the role enrol.")
    session: str | None = Field(description="Its open session, or the last one that it had; null: it had none.")
    camera: str | None
    last_at: Timestamp = Field(description="When its last frame came.")
    verdict: Verdict | None = Field(
        description="The latest one: of the session's belief, else of the single frame; null if it is no longer known."
    )
    place: str | None = Field(description="The place at which it was last recognized; null if that is not known.")
    pose: EstimatedPose | None = Field(description="The pose that was estimated there.")
    recognized_at: Timestamp | None = Field(
        description="When it was last told that it was recognized: by its run or, without one, by the frame."
    )
    lost_since: Timestamp | None = Field(
        description="The time of the first of its latest answers, none of which told it a place (less than three in a "
        "row do not count once it is an alarm); null if it is not lost."
    )
    contradiction_note: str | None = Field(
        default=None,
        description="What is wrong with its odometry, which its session does not use; null while nothing is.",
    )
    verdicts: list[Verdict] = Field(description="Of its latest single frames, the latest first.")
    answers: int = Field(description="How many of the latest answers of the map are its own.")


class FleetAlarm(BaseModel):
    """An alarm of a map, by its setting `alarms`."""

    map: str
    alarm: AlarmName
    raised: bool = Field(description="False: it was cleared.")
    count: int = Field(description="How many places or stretches there were when it was raised, or cleared.")
    since: Timestamp
    sentence: str = Field(description="What has happened, and what to do about it.")


class FleetLost(BaseModel):
    """A robot that was told no place for half a minute, until it was told one three times in a row."""

    map: str
    name: str | None = Field(description="The name of its key; null without one. Only for keys of the role enrol.")
    session: str | None = Field(description="The session of its run; null: it asked without one.")
    camera: str | None
    place: str | None = Field(
        description="The place that it was told last, before it was lost; null if that is not known."
    )
    raised: bool = Field(description="False: it is recognized again, or its run is over.")
    since: Timestamp = Field(description="When it was first told no place.")
    cleared_at: Timestamp | None = Field(description="When it was recognized again; null: it was not.")
    last_at: Timestamp | None = Field(description="When its last frame came, as far as that is known.")


class FleetState(BaseModel):
    """Robots, the one that was heard last first, and the maps that the key may use and that were asked, by id."""

    model_config = ConfigDict(json_schema_extra={"examples": [FLEET_EXAMPLE]})

    at: Timestamp = Field(description="The time of the service.")
    maps: list[FleetMap]
    robots: list[FleetRobot]
    alarms: list[FleetAlarm] = Field(
        description="Of all maps that the key may use: those that are raised, then those cleared within a day."
    )
    lost: list[FleetLost] = Field(
        description="Robots that are lost, then those that were within a day, the latest first."
    )


@router.get("", responses=problem_documentation(errors.StorageFull))
def read_fleet(
    engine: EngineDep, sessions: SessionsDep, statistics: StatisticsDep, principal: PrincipalDep
) -> FleetState:
    """Read where the robots of all maps are, how long they have been lost, how many answers each hour had, and alarms.

    What counts is what a robot was told: in a session the verdict of its run, not that of a frame alone. What a person
    tries in the console is no robot. A robot is an open session; what a key has asked without one, or in one that is
    over, is one robot, too, unless the key has an open session. It is known by the latest answers of its map, which a
    restart may forget.
    """
    private = covers(principal.role, "enrol")
    open_sessions = _by_map(sessions.all())
    hours, alarms = statistics.hours_of_all(), statistics.lost_robots()
    maps, robots, lost, now = [], [], [], datetime.now(UTC)
    for map_id, made in sorted({*open_sessions, *hours}):
        if not principal.may_use(map_id):
            continue
        with suppress(errors.PlacerecError):  # it was deleted, or is damaged: then nobody asks it
            map_ = engine.maps.find(map_id)
            if map_key(map_) == (map_id, made):
                found = open_sessions.get((map_id, made), [])
                maps.append(FleetMap(map=map_id, sessions=len(found), hours=hours.get((map_id, made), [])))
                groups = _groups(map_, found, statistics)
                of_map = [one for one in alarms if one.map == (map_id, made)]
                robots += _robots(map_, found, groups, of_map, private)
                lost += [told for one in of_map if (told := _lost(one, found, groups, now, private)) is not None]
    robots.sort(key=lambda one: one.last_at, reverse=True)
    lost.sort(key=lambda one: (one.raised, one.since), reverse=True)
    return FleetState(
        at=now,
        maps=maps,
        robots=robots[:MOST_ROBOTS],
        alarms=_alarms(engine, statistics.alarms_of_all(now - CLEARED_FOR), principal),
        lost=lost[:MOST_ROBOTS],
    )


def _alarms(engine: Engine, states: Iterable[AlarmState], principal: Principal) -> list[FleetAlarm]:
    found = []
    for one in states:
        map_id = one.map[0]
        with suppress(errors.PlacerecError):  # the map was deleted, or is damaged, which is told elsewhere
            if principal.may_use(map_id) and map_key(map_ := engine.maps.find(map_id)) == one.map:
                said = sentence(map_.record, one.alarm, one.count) if one.is_raised else cleared(one.count)
                found.append(
                    FleetAlarm(
                        map=map_id,
                        alarm=one.alarm,
                        raised=one.is_raised,
                        count=one.count,
                        since=one.since,
                        sentence=said,
                    )
                )
    return found


def _by_map(sessions: Iterable[Session]) -> dict[MapKey, list[Session]]:
    found: dict[MapKey, list[Session]] = {}
    for session in sessions:
        found.setdefault((session.map_id, session.map_created_at), []).append(session)
    return found


Groups = dict[str, list[GivenAnswer]]
"""The answers of each robot, the latest first, by its name (``robot_of``)."""


def _groups(map_: Map, sessions: list[Session], statistics: QueryStatistics) -> Groups:
    """The robots of one map: each open session, and each asker that has none open."""
    present = {session.id for session in sessions}
    names = {session.key for session in sessions if session.key is not None}
    groups: Groups = {f"session {one}": [] for one in present}
    for answer in statistics.recent.of_map(map_key(map_)):
        session = answer.frame.session if answer.frame.session in present else None
        if session is not None or _name(answer) is None or _name(answer) not in names:
            groups.setdefault(robot_of(answer, session), []).append(answer)
    return groups


def _robots(
    map_: Map, sessions: list[Session], groups: Groups, alarms: list[LostRobot], private: bool
) -> list[FleetRobot]:
    """The robots of one map."""
    present = {f"session {session.id}": session for session in sessions}
    lost = {one.robot: one.since for one in alarms if one.until is None}
    found = (_robot(map_, present.get(name), answers, lost.get(name), private) for name, answers in groups.items())
    return [robot for robot in found if robot is not None]


def _robot(
    map_: Map, session: Session | None, answers: list[GivenAnswer], alarm: datetime | None, private: bool
) -> FleetRobot | None:
    """A robot by its session and its latest answers, the latest first; None before its first frame.

    Args:
        alarm: since when it is lost, if that is an alarm.
    """
    came = None if session is None else session.last_frame_came
    if not answers and came is None:
        return None
    last = answers[0] if answers else None
    name = _name(last) if session is None else session.key
    recognized = next((number for number, one in enumerate(answers) if one.told == "recognized"), None)
    where = None if recognized is None else answers[recognized]
    last_at = last.at if last is not None else datetime.fromtimestamp(came or 0, UTC)
    verdict = None if last is None else last.told
    place, pose = (None, None) if where is None else (where.place, where.pose)
    unrecognized = answers[:recognized]
    lost_since = unrecognized[-1].at if unrecognized else None
    belief = _belief(session)
    if belief is not None:
        verdict, believed = belief
        if believed is not None:
            place, lost_since = believed, None
    return FleetRobot(
        map=map_.record.id,
        name=name if private else None,
        session=session.id if session is not None else last.frame.session if last else None,
        camera=session.options.camera if session is not None else last.frame.camera if last else None,
        last_at=last_at,
        verdict=verdict,
        place=place,
        pose=pose,
        recognized_at=None if where is None else where.at,
        lost_since=lost_since if alarm is None else alarm,
        contradiction_note=None if session is None or session.contradiction is None else session.contradiction.note,
        verdicts=[one.verdict for one in answers[:MOST_VERDICTS]],
        answers=len(answers),
    )


def _lost(alarm: LostRobot, sessions: list[Session], groups: Groups, now: datetime, private: bool) -> FleetLost | None:
    """An alarm as it is told; None if it is over for longer than a day."""
    answers = groups.get(alarm.robot, [])
    session = next((one for one in sessions if f"session {one.id}" == alarm.robot), None)
    came = None if session is None else session.last_frame_came
    last_at = answers[0].at if answers else None if came is None else datetime.fromtimestamp(came, UTC)
    is_there = session is not None or (last_at is not None and now - last_at < SILENT_FOR)
    raised = alarm.until is None and is_there
    if not raised and (alarm.until or alarm.since) < now - LISTED_FOR:
        return None
    return FleetLost(
        map=alarm.map[0],
        name=alarm.key if private else None,
        session=alarm.session,
        camera=alarm.camera,
        place=alarm.place,
        raised=raised,
        since=alarm.since,
        cleared_at=alarm.until,
        last_at=last_at,
    )


def _name(answer: GivenAnswer | None) -> str | None:
    """The name of the key that asked; None without one."""
    return answer.asker.principal if answer is not None and answer.asker.key is not None else None


def _belief(session: Session | None) -> tuple[Verdict, str | None] | None:
    """The verdict of a session's belief after its last frame, and its place if it was recognized; None where it is not
    at hand."""
    if session is None or session.answer is None:
        return None
    with suppress(ValueError, KeyError, TypeError):  # a record of another version, or a damaged one
        told = json.loads(session.answer)  # a model would take ten times as long
        return told["verdict"], None if told["place"] is None else told["place"]["id"]
    return None
