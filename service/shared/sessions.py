"""Sessions that any number of services share.

A session's record in PostgreSQL is what counts.  A service holds the belief in memory, too, with the revision of the
record that it was saved as: if that is still the record's, the next frame goes on from memory, else the belief is read.
A frame is saved only onto the revision that it was processed from, so that of two frames that two services process at
the same time one comes after the other.  A session expires by the database's clock.
"""

from __future__ import annotations

import json
import logging
import time
from dataclasses import dataclass
from typing import Any

from core.belief import DamagedRecord, Run, from_bytes
from core.errors import StorageFailure, StorageFull
from core.maps import Map
from service.errors.faults import SessionExpired, TooManySessions, UnknownSession
from service.events.events import Events
from service.peers.replica import ServiceReplica
from service.sessions.schemas import NewSession
from service.sessions.sessions import (
    EXPIRED,
    MAP_GONE,
    REMEMBERED,
    REMEMBERED_SECONDS,
    REPEATED_SECONDS,
    Session,
    SessionMoved,
    Sessions,
    asking_now,
    creation_time,
    restored_run,
    session_of,
    stored_of,
)
from service.sessions.store import COLUMNS, StoredSession
from service.settings import Settings
from service.shared.database import SharedDatabase

ADDING = 7_061_636_574
"""The lock of whoever adds a session, so that together they keep to the limit."""

LATE_SECONDS = 30
"""A session is ended this time after it has expired, since a frame that came in time may still be in the works."""

TIDYING_BEATS = 30
"""Number of beats between deletions of the records of sessions that ended long ago."""

_TIMES = {"created", "used"}
_READ = ", ".join(f"extract(epoch FROM {name})::float8" if name in _TIMES else name for name in COLUMNS)

log = logging.getLogger("placerec.sessions")


@dataclass(frozen=True)
class Head:
    """The state of a session that a service needs before each frame.

    idle: seconds since its last frame.
    """

    map: str
    map_created_at: str
    ended: str | None
    expires_after: float
    idle: float
    revision: int


class SessionTable:
    """The table of the sessions; a :class:`service.sessions.store.SessionRecords`.

    Moments are those of the database's clock; the moments in a record are not read.  Every method but
    ``close`` may raise StorageFull and StorageFailure.
    """

    def __init__(self, database: SharedDatabase) -> None:
        self._database = database

    def close(self) -> None:
        """Do nothing: the connections are not of this table."""

    def all(self) -> list[StoredSession]:
        """All sessions, including ended ones."""
        found = self._database.query("read the sessions", f"SELECT {_READ} FROM service.sessions")
        return [_stored(row) for row in found]

    def read(self, session_id: str) -> StoredSession | None:
        """One session with all columns; None if there is no such session."""
        query = f"SELECT {_READ} FROM service.sessions WHERE id = %s"
        found = self._database.query("read a session", query, (session_id,))
        return _stored(found[0]) if found else None

    def newer(self, session_id: str, revision: int | None) -> tuple[StoredSession, int] | None:
        """A living session and its revision; None if there is none, or if it still has the revision that is known."""
        query = (
            f"SELECT {_READ}, revision FROM service.sessions"
            " WHERE id = %s AND ended IS NULL AND revision IS DISTINCT FROM %s"
        )
        found = self._database.query("read a session", query, (session_id, revision))
        return (_stored(found[0][:-1]), found[0][-1]) if found else None

    def head(self, session_id: str) -> Head | None:
        """The state of a session that is needed before a frame; None if there is no such session."""
        query = (
            "SELECT map, map_created_at, ended, expires_after,"
            " extract(epoch FROM clock_timestamp() - used)::float8, revision FROM service.sessions WHERE id = %s"
        )
        found = self._database.query("read a session", query, (session_id,))
        return Head(*found[0]) if found else None

    def write(self, session: StoredSession, begun_by: str | None = None, most: int | None = None) -> None:
        """Write a session, new or changed.

        Args:
            begun_by: the caller, and the request.
            most: how many sessions may live.

        Raises:
            TooManySessions: as many as may live do.
        """
        columns: dict[str, Any] = {name: getattr(session, name) for name in COLUMNS if name not in _TIMES}
        columns |= {"expires_after": _expires_after(session), "begun_by": begun_by}
        names, marks = ", ".join(columns), ", ".join(["%s"] * len(columns))
        again = ", ".join(f"{name} = excluded.{name}" for name in columns if name != "id")
        query = (
            f"INSERT INTO service.sessions ({names}) VALUES ({marks}) ON CONFLICT (id) DO UPDATE"
            f" SET {again}, used = clock_timestamp(), revision = sessions.revision + 1"
        )
        with self._database.text_transaction("keep a session", ADDING) as connection:
            if most is not None:
                ((living,),) = connection.execute(f"SELECT count(*) FROM service.sessions WHERE {_LIVES}").fetchall()
                if living >= most:
                    raise TooManySessions(f"There are {living} sessions already; delete one that is over.")
            connection.execute(query, tuple(columns.values()))

    def renew(self, session: StoredSession, revision: int) -> bool:
        """Write a changed session; returns False, and writes nothing, if it has ended or has another revision."""
        changing = ("number", "moment", "request", "lost", "state", "answer")
        query = (
            f"UPDATE service.sessions SET {', '.join(f'{name} = %s' for name in changing)},"
            " used = clock_timestamp(), revision = revision + 1"
            " WHERE id = %s AND revision = %s AND ended IS NULL RETURNING id"
        )
        values = [getattr(session, name) for name in changing]
        return bool(self._database.query("save a session", query, (*values, session.id, revision)))

    def end(self, session_id: str, reason: str, moment: float) -> None:
        """Mark a session as ended, for a reason, and delete its state and answer."""
        self._database.query("end a session", f"{_END} WHERE id = %s AND ended IS NULL", (reason, session_id))

    def end_expired(self) -> list[StoredSession]:
        """End the sessions that have expired; each is given to one service only."""
        query = (
            f"{_END} WHERE ended IS NULL AND used < clock_timestamp() - make_interval(secs => expires_after + %s)"
            f" RETURNING {_READ}"
        )
        return [_stored(row) for row in self._database.query("end sessions", query, (EXPIRED, LATE_SECONDS))]

    def forget(self, session_id: str) -> None:
        """Delete a session."""
        self._database.query("delete a session", "DELETE FROM service.sessions WHERE id = %s", (session_id,))

    def forget_ended(self) -> None:
        """Delete the sessions that ended long ago, and the oldest ones if they are too many."""
        query = (
            "DELETE FROM service.sessions WHERE ended IS NOT NULL AND (used < clock_timestamp() - make_interval("
            "secs => %s) OR used < (SELECT used FROM service.sessions WHERE ended IS NOT NULL"
            " ORDER BY used DESC OFFSET %s LIMIT 1))"
        )
        self._database.query("forget sessions", query, (REMEMBERED_SECONDS, REMEMBERED))

    def living_of(self, map_id: str, made: str) -> list[tuple[StoredSession, float]]:
        """The sessions of a map that have not ended, by id, without states and answers; and how long they are idle."""
        heads = _READ.replace(", state, answer", ", NULL::bytea, NULL")
        query = (
            f"SELECT {heads}, extract(epoch FROM clock_timestamp() - used)::float8 FROM service.sessions"
            f" WHERE map = %s AND map_created_at = %s AND {_LIVES} ORDER BY id"
        )
        found = self._database.query("list sessions", query, (map_id, made))
        return [(_stored(row[:-1]), row[-1]) for row in found]

    def begun_by(self, asker: str, map_id: str, made: str, options: str) -> str | None:
        """The id of the session without a frame that a request has begun a moment ago; None if there is none."""
        query = (
            "SELECT id FROM service.sessions WHERE begun_by = %s AND map = %s AND map_created_at = %s"
            " AND options::jsonb - 'expires_after' = %s::jsonb AND revision = 0 AND answer IS NULL AND ended IS NULL"
            " AND used > clock_timestamp() - make_interval(secs => %s) LIMIT 1"
        )
        found = self._database.query("find a session", query, (asker, map_id, made, options, REPEATED_SECONDS))
        return found[0][0] if found else None

    def count(self) -> int:
        """The number of sessions that have not ended."""
        query = f"SELECT count(*) FROM service.sessions WHERE {_LIVES}"
        return int(self._database.query("count the sessions", query)[0][0])


_LIVES = "ended IS NULL AND used > clock_timestamp() - make_interval(secs => expires_after)"
_END = "UPDATE service.sessions SET ended = %s, used = clock_timestamp(), state = NULL, answer = NULL"


def _stored(row: tuple[Any, ...]) -> StoredSession:
    return StoredSession(*row)


def _expires_after(session: StoredSession) -> float:
    return float(json.loads(session.options)["expires_after"])


class SharedSessions(Sessions):
    """All sessions of all services.  Thread-safe; methods that ask PostgreSQL block.

    Every method may raise StorageFailure: PostgreSQL cannot be reached.  A frame that cannot be saved is answered all
    the same, and says so; the next one at this service goes on from it.
    """

    def __init__(self, settings: Settings, events: Events, replica: ServiceReplica, database: SharedDatabase) -> None:
        self._table, self._counted, self._beats = SessionTable(database), 0, 0
        super().__init__(settings, events, self._table)
        replica.every(self.tidy)

    def _load(self) -> None:
        """Hold nothing yet: a session is read when its next frame comes here."""

    def count(self) -> int:
        return self._counted

    def tidy(self) -> None:
        """End what has expired, and let go of what this service holds in vain."""
        for stored in self._table.end_expired():
            try:
                session = session_of(stored)
            except (ValueError, KeyError, TypeError):
                continue
            self._tell(session, "ended", EXPIRED)
        self._beats += 1
        if self._beats % TIDYING_BEATS == 0:
            self._table.forget_ended()
        now = time.monotonic()
        with self._lock:
            for one in list(self._living.values()):
                if now - one.idle_since >= one.expires_after and not one.waiting and not one.streaming:
                    self._let_go(one)
        self._counted = self._table.count()

    def _let_go(self, session: Session) -> None:
        with self._lock:
            self._living.pop(session.id, None)
            self._drop_unused_graphs()

    def _begun_before(self, map_: Map, options: NewSession) -> Session | None:
        if (asker := _asker()) is None:
            return None
        wanted = options.model_dump(mode="json")
        wanted.pop("expires_after")
        found = self._table.begun_by(asker, map_.record.id, creation_time(map_), json.dumps(wanted))
        if found is None:
            return None
        session = self.find(map_, found)
        longest = self._settings.session_expiry
        return session if session.expires_after == min(options.expires_after or longest, longest) else None

    def _keep(self, session: Session) -> None:
        with self._lock:
            self._hold(session)
        try:
            self._table.write(stored_of(session), _asker(), self._settings.max_sessions)
        except BaseException:
            self._let_go(session)
            raise

    def find(self, map_: Map, session_id: str) -> Session:
        head, session = self._table.head(session_id), self._living.get(session_id)
        if head is None or head.map != map_.record.id:
            if session is not None:
                self._let_go(session)
            raise UnknownSession(f"The map has no session {session_id[:80]!r}.")
        ended = head.ended
        if ended is None and head.map_created_at != creation_time(map_):
            ended = MAP_GONE
            self._table.end(session_id, ended, 0.0)
        elif ended is None and head.idle >= head.expires_after and not (session is not None and session.waiting):
            ended = EXPIRED
        if ended is not None:
            if session is not None:
                self._let_go(session)
            raise SessionExpired(f"The session {session_id[:80]} is over. {ended} Begin a new one.")
        if session is None:
            session = self._read(session_id)
        session.idle_since = time.monotonic() - head.idle
        session.used = time.time() - head.idle
        return session

    def _read(self, session_id: str) -> Session:
        stored = self._table.read(session_id)
        if stored is None:
            raise UnknownSession(f"The map has no session {session_id[:80]!r}.")
        try:
            session = session_of(stored)
        except (ValueError, KeyError, TypeError) as error:
            self._table.end(session_id, "Its record was damaged.", 0.0)
            raise SessionExpired(f"The session {session_id[:80]} is over. Begin a new one.") from error
        session.revision = -1
        with self._lock:
            return self._living.setdefault(session_id, session)

    def of_map(self, map_: Map) -> list[Session]:
        found = []
        for stored, idle in self._table.living_of(map_.record.id, creation_time(map_)):
            session = session_of(stored)
            session.idle_since = time.monotonic() - idle
            found.append(session)
        return found

    def delete(self, session: Session) -> None:
        self._table.forget(session.id)
        self._let_go(session)
        self._tell(session, "ended", "It was deleted.")

    def _end(self, session: Session, reason: str) -> None:
        self._let_go(session)
        self._table.end(session.id, reason, 0.0)
        self._tell(session, "ended", reason)

    def _sweep(self) -> None:
        """Do nothing: :meth:`tidy` does it at every beat."""

    def run(self, map_: Map, session: Session) -> Run:
        graph = self.graph(map_, session.selection)
        read = self._table.newer(session.id, session.revision if session.run is not None else None)
        if read is not None:
            stored, session.revision = read
            try:
                state = None if stored.state is None else from_bytes(stored.state)
            except DamagedRecord as error:
                raise self._damaged(session, error) from error
            session.number, session.moment, session.request = stored.number, stored.moment, stored.request
            session.lost, session.answer = stored.lost, stored.answer
            session.run = restored_run(session, graph, state)
        if session.run is None:  # it ended since it was found
            raise SessionExpired(f"The session {session.id} is over. Begin a new one.")
        session.run.place_on(graph)
        return session.run

    def frames_of(self, session: Session) -> int:
        try:
            stored = self._table.read(session.id)
            return 0 if stored is None or stored.state is None else from_bytes(stored.state).frames
        except DamagedRecord:
            return 0

    def save(self, session: Session) -> bool:
        try:
            if self._table.renew(stored_of(session), session.revision):
                session.revision += 1
                return True
            head = self._table.head(session.id)
        except (StorageFull, StorageFailure) as error:
            log.warning("session %s is not saved: %s", session.id, error)
            return False
        session.run = None  # what was saved by another service counts
        if head is None or head.ended is not None:
            return False
        raise SessionMoved


def _asker() -> str | None:
    asking = asking_now()
    return None if asking is None else json.dumps(asking)
