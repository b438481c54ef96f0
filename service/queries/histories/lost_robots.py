"""Robots that are lost: alarms by what each was told, which in a run is the verdict of the run.

An alarm is raised late and cleared late, so that neither a blink nor a stray frame that is recognized by itself changes
it.  Services that share a ledger share the alarms: whichever saw the last of a robot's answers raises or clears it.
"""

from __future__ import annotations

import json
import threading
from collections import OrderedDict
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any, NamedTuple

from sqlalchemy import bindparam, case, delete, select, update
from sqlalchemy.sql.elements import ColumnElement

from core.ledger import LedgerConnection, Statement
from service.queries.count_tables import LOST_ROBOTS, MAPS, THE_MAP, number_of, of_map, putting
from service.queries.given_answers import GivenAnswer, MapKey

RAISED_BY, RAISED_AFTER = 3, timedelta(seconds=30)
"""An alarm is raised by so many answers in a row without a place, the first of which was so long ago."""

CLEARED_BY = 3
"""It is cleared by so many answers in a row with a place."""

LISTED_FOR = timedelta(days=1)
"""Alarms that are over are listed for this time."""

MOST = 20_000
"""Robots that are watched; those that asked longest ago go first."""


def robot_of(answer: GivenAnswer, session: str | None) -> str:
    """The name by which a robot is known: its session or, without one, its key, or its camera and address."""
    if session is not None:
        return f"session {session}"
    if answer.asker.key is not None:
        return f"key {answer.asker.principal}"
    return f"camera {answer.frame.camera or ''} at {answer.asker.client or ''}"


class LostRobot(NamedTuple):
    """A robot that was told no place for long.

    robot: as :func:`robot_of` names it.
    since: when it was first told none.
    until: when it was told one again; None: it was not yet.
    key, session, camera: who asked.
    place: the last that it was told.
    """

    map: MapKey
    robot: str
    since: datetime
    until: datetime | None = None
    key: str | None = None
    session: str | None = None
    camera: str | None = None
    place: str | None = None


@dataclass
class _Watched:
    """The latest answers of a robot: how many in a row named no place, since when, and how many in a row named one."""

    missed: int = 0
    since: datetime | None = None
    found: int = 0
    place: str | None = None
    raised: LostRobot | None = None


Change = tuple[MapKey, str, LostRobot | None, datetime | None]
"""The map and the robot, its alarm if it is raised, and when one is cleared."""


class LostRobots:
    """Watches what robots are told.  Any thread may use it; nothing is written here.

    changes: of alarms, that are not written yet, in their order.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._watched: OrderedDict[tuple[MapKey, str], _Watched] = OrderedDict()
        self.changes: list[Change] = []

    def observe(self, key: MapKey, answer: GivenAnswer) -> None:
        """Note an answer of a map."""
        robot = robot_of(answer, answer.frame.session)
        with self._lock:
            seen = self._watched.setdefault((key, robot), _Watched())
            self._watched.move_to_end((key, robot))
            if len(self._watched) > MOST:
                self._watched.popitem(last=False)
            if answer.told == "recognized":
                seen.found, seen.place = seen.found + 1, answer.place or seen.place
                if seen.found == CLEARED_BY:  # another service, or this one before a restart, may have raised one
                    self._change((key, robot, None, answer.at))
                if seen.found >= CLEARED_BY or seen.raised is None:
                    seen.missed, seen.since, seen.raised = 0, None, None
                return
            seen.found, seen.missed, seen.since = 0, seen.missed + 1, seen.since or answer.at
            if seen.raised is None and seen.missed >= RAISED_BY and answer.at - seen.since >= RAISED_AFTER:
                name = answer.asker.principal if answer.asker.key is not None else None
                who = name, answer.frame.session, answer.frame.camera, seen.place
                seen.raised = LostRobot(key, robot, seen.since, None, *who)
                self._change((key, robot, seen.raised, None))

    def _change(self, change: Change) -> None:
        self.changes = [*self.changes[1 - MOST :], change]

    def forget(self, key: MapKey) -> None:
        """Forget the robots of a map."""
        with self._lock:
            self._watched = OrderedDict((one, seen) for one, seen in self._watched.items() if one[0] != key)
            self.changes = [one for one in self.changes if one[0] != key]

    def written(self, changes: list[Change]) -> None:
        """Drop changes that are written."""
        done = {id(one) for one in changes}
        with self._lock:
            self.changes = [one for one in self.changes if id(one) not in done]


_T = LOST_ROBOTS.c
_COLUMNS = "key", "session", "camera", "place"


def _combined(column: ColumnElement[Any], given: ColumnElement[Any]) -> ColumnElement[Any]:
    """An alarm that is raised already stays as old as it is."""
    return case((_T.until == "", column), else_=given) if column is _T.since else given


_RAISE = putting(LOST_ROBOTS, _combined)
_CLEAR = Statement(
    update(LOST_ROBOTS)
    .values(until=bindparam("moment"))
    .where(of_map(LOST_ROBOTS), _T.robot == bindparam("one"), _T.until == "")
)
_OLD = Statement(
    delete(LOST_ROBOTS).where(((_T.until != "") & (_T.until < bindparam("day"))) | (_T.since < bindparam("week")))
)
_ALL = Statement(
    select(MAPS.c.id, MAPS.c.made, *LOST_ROBOTS.columns[1:]).join_from(LOST_ROBOTS, MAPS).order_by(_T.since.desc())
)
_FORGET = Statement(delete(LOST_ROBOTS).where(_T.map == select(MAPS.c.code).where(*THE_MAP).scalar_subquery()))


def put_changes(connection: LedgerConnection, changes: list[Change], now: datetime) -> None:
    """Raise and clear alarms, and delete those that are listed no longer."""
    for key, robot, raised, cleared in changes:
        code = number_of(connection, key, now.isoformat())
        if raised is not None:
            told = [getattr(raised, name) or "" for name in _COLUMNS]
            connection.execute(_RAISE, rows=json.dumps([(code, robot, raised.since.isoformat(), "", *told)]))
        if cleared is not None:
            connection.change(_CLEAR, code=code, one=robot, moment=cleared.isoformat())
    day, week = (now - LISTED_FOR).isoformat(), (now - 7 * LISTED_FOR).isoformat()
    connection.change(_OLD, day=day, week=week)


def read_lost(connection: LedgerConnection, waiting: list[Change]) -> list[LostRobot]:
    """All alarms, the latest first, with changes that are not written yet."""
    rows = (_alarm_of(*row) for row in connection.execute(_ALL))
    found = {(one.map, one.robot): one for one in rows}
    for key, robot, raised, cleared in waiting:
        if raised is not None:
            found[key, robot] = raised
        elif (before := found.get((key, robot))) is not None and before.until is None:
            found[key, robot] = before._replace(until=cleared)
    return sorted(found.values(), key=lambda one: one.since, reverse=True)


def _alarm_of(map_id: str, made: str, robot: str, since: str, until: str, *who: str) -> LostRobot:
    ended = datetime.fromisoformat(until) if until else None
    return LostRobot((map_id, made), robot, datetime.fromisoformat(since), ended, *(one or None for one in who))


def forget_lost(connection: LedgerConnection, key: MapKey) -> None:
    """Delete the alarms of a map."""
    connection.change(_FORGET, id=key[0], made=key[1])
