"""Robots that are lost: alarms by what each was told, which in a run is the verdict of the run.

An alarm is raised late and cleared late, so that neither a blink nor a stray frame that is recognized by itself changes
it.  Services that share a ledger share the alarms: whichever saw the last of a robot's answers raises or clears it.
"""

from __future__ import annotations

import json
import threading
from collections import OrderedDict
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, NamedTuple

from sqlalchemy import Column, MetaData, Table, bindparam, case, delete, select, update
from sqlalchemy.sql.elements import ColumnElement

from core.disk.sqlite_file import DURABLE
from core.ledger import Ledger, LedgerConnection, Statement, Tables
from core.ledger.disposable import DisposableLedger, once_more_if_replaced
from core.ledger.sqlite import file_of
from core.ledger.statements import text
from service.queries.count_tables import putting
from service.queries.given_answers import GivenAnswer, MapKey

FILE = "robots.sqlite"

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
    """Watches what robots are told, and has the alarms.  Any thread may use it.

    Args:
        ledger: has the ``TABLES``, and the alarms after a ``flush``; None: they are in memory alone.
    """

    def __init__(self, ledger: Ledger | None = None) -> None:
        self._ledger = ledger
        self._lock, self._writing = threading.Lock(), threading.Lock()
        self._watched: OrderedDict[tuple[MapKey, str], _Watched] = OrderedDict()
        self._changes: list[Change] = []  # that are not written yet, in their order

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
        self._changes = [*self._changes[1 - MOST :], change]

    @once_more_if_replaced
    def flush(self) -> None:
        """Write the changes of alarms; raises as the ledger does, and then they stay in memory."""
        with self._writing:
            if self._ledger is None or not (changes := self._changes):
                return
            with self._ledger.transaction("write down which robots are lost") as connection:
                _put(connection, changes, datetime.now(UTC))
            done = {id(one) for one in changes}
            with self._lock:
                self._changes = [one for one in self._changes if id(one) not in done]

    @once_more_if_replaced
    def alarms(self) -> list[LostRobot]:
        """Robots of all maps that are lost, and those that were within a day; the latest first.

        Raises:
            StorageFull, StorageFailure: the ledger refuses, or cannot be reached.
        """
        found: dict[tuple[MapKey, str], LostRobot] = {}
        with self._writing:
            if self._ledger is not None:
                rows = self._ledger.execute("read which robots are lost", _ALL)
                found = {(one.map, one.robot): one for one in (_alarm_of(*row) for row in rows)}
            changes = self._changes
        for key, robot, raised, cleared in changes:
            if raised is not None:
                found[key, robot] = raised
            elif (before := found.get((key, robot))) is not None and before.until is None:
                found[key, robot] = before._replace(until=cleared)
        return sorted(found.values(), key=lambda one: one.since, reverse=True)

    @once_more_if_replaced
    def forget(self, key: MapKey) -> None:
        """Forget the robots of a map, and their alarms; raises as :meth:`alarms`."""
        with self._writing:
            with self._lock:
                self._watched = OrderedDict((one, seen) for one, seen in self._watched.items() if one[0] != key)
                self._changes = [one for one in self._changes if one[0] != key]
            if self._ledger is not None:
                self._ledger.change("forget which robots were lost", _FORGET, id=key[0], made=key[1])

    def close(self) -> None:
        """Close the file."""
        if self._ledger is not None:
            self._ledger.close()


_METADATA = MetaData()
_ROBOTS = Table(
    "lost_robots",
    _METADATA,
    *(Column(name, text(), primary_key=True) for name in ("map", "made", "robot")),
    *(Column(name, text(), nullable=False) for name in ("since", "until", "key", "session", "camera", "place")),
    sqlite_strict=True,
    sqlite_with_rowid=False,
)
TABLES = Tables("lost_robots", 1, _METADATA)

_C = _ROBOTS.c
_OF_MAP = _C.map == bindparam("id"), _C.made == bindparam("made")
_WHO = "key", "session", "camera", "place"


def _combined(column: ColumnElement[Any], given: ColumnElement[Any]) -> ColumnElement[Any]:
    """An alarm that is raised already stays as old as it is."""
    return case((_C.until == "", column), else_=given) if column is _C.since else given


_RAISE = putting(_ROBOTS, _combined)
_CLEAR = Statement(
    update(_ROBOTS).values(until=bindparam("moment")).where(*_OF_MAP, _C.robot == bindparam("name"), _C.until == "")
)
_DELETE_OLD = Statement(
    delete(_ROBOTS).where(((_C.until != "") & (_C.until < bindparam("day"))) | (_C.since < bindparam("week")))
)
_ALL = Statement(select(*_ROBOTS.columns))
_FORGET = Statement(delete(_ROBOTS).where(*_OF_MAP))


def lost_robots_file(directory: Path) -> DisposableLedger:
    """The ledger of one data directory, which this process holds; a damaged file is put aside and made anew."""
    settings = {**DURABLE, "journal_size_limit": 1 << 20}
    readable = ["SELECT robot FROM lost_robots LIMIT 0"]
    return DisposableLedger(file_of(directory / FILE, TABLES, settings, readable, check_whole=False))


def _put(connection: LedgerConnection, changes: list[Change], now: datetime) -> None:
    """Raise and clear alarms, and delete those that are listed no longer."""
    for key, robot, raised, cleared in changes:
        if raised is not None:
            told = [getattr(raised, name) or "" for name in _WHO]
            connection.execute(_RAISE, rows=json.dumps([(*key, robot, raised.since.isoformat(), "", *told)]))
        if cleared is not None:
            connection.change(_CLEAR, id=key[0], made=key[1], name=robot, moment=cleared.isoformat())
    day, week = (now - LISTED_FOR).isoformat(), (now - 7 * LISTED_FOR).isoformat()
    connection.change(_DELETE_OLD, day=day, week=week)


def _alarm_of(map_id: str, made: str, robot: str, since: str, until: str, *who: str) -> LostRobot:
    ended = datetime.fromisoformat(until) if until else None
    return LostRobot((map_id, made), robot, datetime.fromisoformat(since), ended, *(one or None for one in who))
