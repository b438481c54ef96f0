"""The table of the sessions, one row each, in a file of the data directory or in the PostgreSQL that services share.

A row is written after every frame, before the frame is answered, so that a crash or a power cut loses no answered
frame.  Moments are seconds since 1970 UTC by the database's clock.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from sqlalchemy import (
    Column,
    ColumnElement,
    Index,
    MetaData,
    Table,
    and_,
    bindparam,
    delete,
    func,
    null,
    select,
    update,
)
from sqlalchemy.sql.selectable import Select

from core.disk.sqlite_file import DURABLE
from core.ledger import Ledger, Lock, Statement, Tables
from core.ledger.sqlite import SqliteLedger, file_of
from core.ledger.statements import binary, integer, real, seconds_now, text
from service.access.audit import Asker
from service.errors.faults import TooManySessions
from service.fairness import Holding, SharedRoom

FILE = "sessions.sqlite"

LOG_PAGES = 256
"""Pages of SQLite's log after which it is written back to the file."""

REMEMBERED_SECONDS = 24 * 3600.0
"""For how long an ended session is remembered as ended; later it counts as unknown."""

REMEMBERED = 10_000
"""How many ended sessions are remembered."""

REPEATED_SECONDS = 60.0
"""For how long a session that has no frame is the answer to the request that began it, sent again."""

LATE_SECONDS = 30.0
"""A session that services share is ended this time after it has expired, since a frame that came in time may still be
processed."""


@dataclass(frozen=True)
class SessionRecord:
    """One row of the table.

    options: ``NewSession`` as JSON.
    expires_after: seconds.
    created, used: when the session was created and when its last frame came; the table gives them.
    idle: seconds since its last frame when it was read.
    number, moment, request, lost, frames: as in :class:`service.sessions.session.Session`.
    revision: grows with every frame.
    ended: why the session has ended; None if it has not.
    state: the belief, as ``core.belief.record`` writes it; None where it is not read.
    answer: the last answer, JSON; None where it is not read.
    begun_by: the caller and the request that began it, from :func:`begun_by`, and whether another key has sent frames
        since; None if unknown.
    """

    id: str
    map: str
    map_created_at: str
    options: str
    expires_after: float
    created: float = 0.0
    used: float = 0.0
    number: int | None = None
    moment: float | None = None
    request: str | None = None
    lost: int | None = None
    frames: int = 0
    revision: int = 0
    ended: str | None = None
    begun_by: str | None = None
    idle: float = 0.0
    state: bytes | None = None
    answer: str | None = None


def begun_by(asker: Asker) -> str:
    """The caller, the id of the request that begins a session, and the name of the key, as JSON."""
    return json.dumps([asker.caller, asker.request_id, asker.principal if asker.key is not None else None])


def visited(begun_by: str | None) -> str:
    """The value of :func:`begun_by` for a session to which another key has sent a frame."""
    try:
        caller, request, key, *_ = json.loads(begun_by or "")
    except (ValueError, TypeError):
        caller = request = key = None
    return json.dumps([caller, request, key, True])


def is_visited(begun_by: str | None) -> bool:
    """Whether another key has sent a frame into a session, or it is not known with which it was begun."""
    try:
        return bool(json.loads(begun_by or "")[3:])
    except (ValueError, TypeError):
        return True


def is_begun_by(begun_by: str | None, asker: Asker) -> bool:
    """Whether a caller has the key with which a session was begun, or neither has any."""
    return asker.key == (None if key_of(begun_by) is None else caller_of(begun_by))


def caller_of(begun_by: str | None) -> str:
    """The caller of :func:`begun_by`."""
    try:
        return str(json.loads(begun_by or "")[0])
    except (ValueError, IndexError, KeyError, TypeError):
        return "unknown"


def key_of(begun_by: str | None) -> str | None:
    """The name of the key of :func:`begun_by`; None without one."""
    try:
        name = json.loads(begun_by or "")[2]
    except (ValueError, IndexError, KeyError, TypeError):
        return None
    return None if name is None else str(name)


_METADATA = MetaData()
_TABLE = Table(
    "sessions",
    _METADATA,
    Column("id", text(), primary_key=True),
    Column("map", text(), nullable=False),
    Column("map_created_at", text(), nullable=False),
    Column("options", text(), nullable=False),
    Column("expires_after", real(), nullable=False),
    Column("begun_by", text()),  # who, with which request, as JSON
    Column("created", real(), nullable=False),
    Column("used", real(), nullable=False),
    Column("number", integer()),
    Column("moment", real()),
    Column("request", text()),
    Column("lost", integer()),
    Column("frames", integer(), nullable=False),
    Column("revision", integer(), nullable=False),
    Column("ended", text()),
    Column("state", binary()),
    Column("answer", text()),
    sqlite_strict=True,
)
_C = _TABLE.c
_LIVES = _C.ended.is_(None)
_ENDED = _C.ended.is_not(None)
Index("living_sessions", _C.map, sqlite_where=_LIVES, postgresql_where=_LIVES)
Index("ended_sessions", _C.used, sqlite_where=_ENDED, postgresql_where=_ENDED)

UNCOMPRESSED = "ALTER TABLE sessions ALTER COLUMN state SET STORAGE EXTERNAL"
"""Compressing beliefs would only take time."""

TABLES = Tables("sessions", 2, _METADATA, 0x504C5253, more={"postgresql": [UNCOMPRESSED]})  # "PLRS"

_NAMED = _C.id == bindparam("session")
_OF_MAP = and_(_C.map == bindparam("map"), _C.map_created_at == bindparam("map_created_at"))
_EXPIRES = _C.used + _C.expires_after
_IN_TIME = and_(_LIVES, seconds_now() < _EXPIRES)
_HEAD = [
    (seconds_now() - _C.used).label("idle") if name == "idle" else _C[name]
    for name in SessionRecord.__dataclass_fields__
    if name not in ("state", "answer")
]


def _heads(*conditions: ColumnElement[bool]) -> Select[Any]:
    """Sessions without their states and answers, by id."""
    return select(*_HEAD).where(*conditions).order_by(_C.id)


_ENDING: dict[Any, Any] = {"ended": bindparam("ended"), "used": seconds_now(), "state": null(), "answer": null()}
_OTHERS = _TABLE.alias()
_FIRST_FORGOTTEN = (
    select(_OTHERS.c.used)
    .where(_OTHERS.c.ended.is_not(None))
    .order_by(_OTHERS.c.used.desc())
    .limit(1)
    .offset(REMEMBERED)
    .scalar_subquery()
)

_ADD = Statement(
    lambda insert: (
        insert(_TABLE)
        .values(
            {name: bindparam(name) for name in ("id", "map", "map_created_at", "options", "expires_after", "begun_by")}
            | {"created": seconds_now(), "used": seconds_now(), "frames": 0, "revision": 0, "state": bindparam("state")}
        )
        .returning(_C.created)
    )
)
_COUNT = Statement(select(func.count()).select_from(_TABLE).where(_IN_TIME))
_ONE = Statement(_heads(_NAMED))
_NEWER = Statement(select(*_HEAD, _C.state, _C.answer).where(_NAMED, _LIVES, _C.revision != bindparam("known")))
_LIVING = Statement(_heads(_LIVES))
_LIVING_OF_MAP = Statement(_heads(_OF_MAP, _IN_TIME))
_BEGUN = Statement(
    select(_C.id).where(
        *(_OF_MAP, _IN_TIME, _C.begun_by == bindparam("begun_by"), _C.options == bindparam("options")),
        *(_C.expires_after == bindparam("expires_after"), _C.revision == 0),
        _C.used > seconds_now() - REPEATED_SECONDS,
    )
)
_OF_FRAMES = ("number", "moment", "request", "lost", "frames", "state", "answer", "begun_by")
_RENEW = Statement(
    update(_TABLE)
    .where(_NAMED, _LIVES, _C.revision == bindparam("known"))
    .values({name: bindparam(name) for name in _OF_FRAMES} | {"used": seconds_now(), "revision": _C.revision + 1})
)
_BY_USE = Statement(select(*_HEAD).where(_IN_TIME).order_by(_C.used.desc(), _C.id))
_END = Statement(update(_TABLE).where(_NAMED, _LIVES).values(_ENDING))
_END_EXPIRED = Statement(
    update(_TABLE).where(_LIVES, seconds_now() - LATE_SECONDS > _EXPIRES).values(_ENDING).returning(*_HEAD)
)
_FORGET = Statement(delete(_TABLE).where(_NAMED))
_FORGET_ENDED = Statement(
    delete(_TABLE).where(_ENDED, (_C.used < seconds_now() - REMEMBERED_SECONDS) | (_C.used <= _FIRST_FORGOTTEN))
)


def session_file(folder: Path) -> SqliteLedger:
    """The file of the sessions of one data directory, which is made if it is missing; a damaged one is put aside.

    Raises:
        StorageFull, StorageFailure: the disk refuses.
    """
    readable = [_LIVING.compiled("sqlite").text, "SELECT state, answer FROM sessions LIMIT 1"]
    file = file_of(folder / FILE, TABLES, {**DURABLE, "wal_autocheckpoint": LOG_PAGES}, readable)
    return SqliteLedger.open(file, replace_damaged=True)


class SessionTable:
    """The table of the sessions.  Any thread may use it.

    A write is durable when it returns.  Every method may raise StorageFull, StorageFailure and Damage.
    """

    def __init__(self, ledger: Ledger) -> None:
        self._ledger = ledger

    def add(self, session: SessionRecord, most: int, reason: str = "") -> tuple[float, list[SessionRecord]]:
        """Add a session that has no frame yet.

        Args:
            most: how many sessions may live.
            reason: why one ends that gives way to it.

        Returns:
            When that was, and the session that has ended to make room for it, if any: that of the caller with most
            sessions, and of its map with most, that has waited longest for a frame.

        Raises:
            TooManySessions: as many as may live do, and the caller has no fewer than the others.
        """
        with self._ledger.transaction("keep a session", Lock.SESSIONS) as connection:
            ((living,),) = connection.execute(_COUNT)
            given_way = [] if living < most else _give_way(session, connection.execute(_BY_USE))
            for one in given_way:
                connection.change(_END, session=one.id, ended=reason)
            ((created,),) = connection.execute(_ADD, **vars(session))
        return float(created), given_way

    def begun(self, session: SessionRecord) -> str | None:
        """The id of the session without a frame that the request of ``session`` has begun a moment ago, with its map
        and its options; None if there is none."""
        found = self._ledger.execute("find a session", _BEGUN, **vars(session))
        return found[0][0] if found else None

    def head(self, session_id: str) -> SessionRecord | None:
        """A session, which may have ended, without its state and answer; None if there is no such session."""
        found = self._ledger.execute("read a session", _ONE, session=session_id)
        return SessionRecord(*found[0]) if found else None

    def read(self, session_id: str, known: int = -1) -> SessionRecord | None:
        """A living session with state and answer; None if there is none, or if it has the revision that is known."""
        found = self._ledger.execute("read a session", _NEWER, session=session_id, known=known)
        return SessionRecord(*found[0]) if found else None

    def living(self) -> list[SessionRecord]:
        """The sessions that have not ended, though some may have expired, without states and answers."""
        return [SessionRecord(*row) for row in self._ledger.execute("read the sessions", _LIVING)]

    def living_of(self, map_id: str, map_created_at: str) -> list[SessionRecord]:
        """The sessions of a map that have neither ended nor expired, by id, without states and answers."""
        values = {"map": map_id, "map_created_at": map_created_at}
        return [SessionRecord(*row) for row in self._ledger.execute("list sessions", _LIVING_OF_MAP, **values)]

    def count(self) -> int:
        """The number of sessions that have neither ended nor expired."""
        return int(self._ledger.execute("count the sessions", _COUNT)[0][0])

    def renew(self, session: SessionRecord) -> bool:
        """Write a session after a frame; returns False, and writes nothing, if it was deleted, has ended or has another
        revision."""
        values = vars(session)
        return self._ledger.change("save a session", _RENEW, **values, session=session.id, known=session.revision) > 0

    def end(self, session_id: str, reason: str) -> None:
        """Mark a session as ended, for a reason, and delete its state and answer."""
        with self._ledger.transaction("end a session") as connection:
            connection.change(_END, session=session_id, ended=reason)
            connection.change(_FORGET_ENDED)

    def end_expired(self, reason: str) -> list[SessionRecord]:
        """End the sessions that have expired; each is given to one service only."""
        found = self._ledger.execute("end sessions", _END_EXPIRED, ended=reason)
        if found:
            self._ledger.change("forget sessions", _FORGET_ENDED)
        return [SessionRecord(*row) for row in found]

    def forget(self, session_id: str) -> None:
        """Delete a session."""
        self._ledger.change("delete a session", _FORGET, session=session_id)


def _give_way(session: SessionRecord, rows: Sequence[Sequence[Any]]) -> list[SessionRecord]:
    """The session that gives way to a new one, among those that live, the latest used first.

    Raises:
        TooManySessions: no other caller has more sessions, and no map of this one.
    """
    chosen: list[SessionRecord] = []
    room = SharedRoom(len(rows))
    for one in (SessionRecord(*row) for row in rows):
        room.take(Holding(partial(_choose, chosen, one), one.map, caller_of(one.begun_by)))
    if not room.take(Holding(lambda: False, session.map, caller_of(session.begun_by))):
        raise TooManySessions(f"There are {len(rows)} sessions already; delete one that is over.")
    return chosen


def _choose(chosen: list[SessionRecord], session: SessionRecord) -> bool:
    chosen.append(session)
    return True
