"""The sessions of all maps: found, bounded in number and memory, ended when nobody comes, kept over a restart."""

from __future__ import annotations

import asyncio
import json
import logging
import secrets
import sqlite3
import threading
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from core.belief import DamagedRecord, PlaceGraph, Run, RunState, from_bytes, place_graph, to_bytes
from core.disk.files import disk_errors
from core.errors import UnknownSequence
from core.places import Neighborhood
from core.recognition.selection import Conditions, Selection
from core.storage import Map, Snapshot
from service.errors.faults import QueueFull, SessionExpired, TooManySessions, UnknownSession
from service.sessions.schemas import NewSession
from service.sessions.store import SessionStore, StoredSession
from service.settings import Settings

WAITING = 8
"""Frames that may wait for their turn in one session; a robot that sends faster hears that it does."""

REMEMBERED_SECONDS = 24 * 3600.0
"""So long it is told that a session is over, before it is as if there had been none."""

REMEMBERED = 10_000

GRAPH_SHARE = 20.0
"""A map that is written to is looked at anew when so many times as long went by as that took the last time."""

CLOCKS_DIFFER = 1.0
"""Seconds by which two clocks part without one having been set: what is told of a session stays the same."""

EXPIRED = "No frame came for too long."
MAP_GONE = "Its map was deleted; the one of that name now is another."
STATE_LOST = "What it had come to believe was damaged on disk."

log = logging.getLogger("placerec.sessions")


@dataclass(eq=False)
class Session:
    """One robot's run in one map.

    created, used: seconds since 1970; of the creation and of the last frame.
    number, moment, request: of the last frame, as the robot counts it, when it was taken (seconds since 1970), and
        the id that the caller gave the request.
    lost: frames that a restart is known to have lost.
    answer: JSON of the last answer.
    run: None after a restart, until the next frame.
    idle_since: when the last frame came by the monotonic clock, by which it ends: the other one may be set.
    """

    id: str
    map_id: str
    map_created_at: str
    options: NewSession
    expires_after: float
    created: float
    used: float
    number: int | None = None
    moment: float | None = None
    request: str | None = None
    lost: int | None = None
    answer: str | None = None
    run: Run | None = None
    restored: bool = False
    streaming: bool = False
    waiting: int = 0
    idle_since: float = field(default_factory=time.monotonic)
    _lock: asyncio.Lock = field(default_factory=asyncio.Lock)

    @property
    def expires(self) -> float:
        """When it ends unless a frame comes, seconds since 1970, by the clock as it is set now."""
        used = time.time() - (time.monotonic() - self.idle_since)
        return self.expires_after + (self.used if abs(used - self.used) < CLOCKS_DIFFER else used)

    def touch(self) -> None:
        """A frame came, now."""
        self.used, self.idle_since = time.time(), time.monotonic()

    @property
    def selection(self) -> Selection | None:
        """What of the map it is about; None: everything."""
        names = self.options.sequences
        return None if names is None else Selection(Conditions(sequences=tuple(names)))

    @asynccontextmanager
    async def turn(self) -> AsyncIterator[None]:
        """The session's turn for one frame: first come, first served.

        Raises:
            QueueFull: too many wait already.
        """
        if self.waiting >= WAITING:
            raise QueueFull("Too many frames of this session wait for their turn; send this one again in a moment.")
        self.waiting += 1
        try:
            async with self._lock:
                yield
        finally:
            self.waiting -= 1


@dataclass(frozen=True, eq=False)
class _Charted:
    """The graph of a map's snapshot."""

    snapshot: Snapshot
    graph: PlaceGraph
    made: float
    took: float

    def serves(self, snapshot: Snapshot, now: float) -> bool:
        """Whether it is of this snapshot, or too new to be worth making again."""
        return self.snapshot is snapshot or now - self.made < GRAPH_SHARE * self.took


class Sessions:
    """All sessions; any thread may call any method."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._store = SessionStore(settings.data_dir)
        self._lock = threading.RLock()
        self._charting = threading.Lock()
        self._charts: dict[tuple[str, str, tuple[str, ...]], _Charted] = {}
        self._living: dict[str, Session] = {}
        self._ended: dict[str, tuple[str, str]] = {}
        self._load()

    def close(self) -> None:
        """Let the file go; every frame that was answered is in it."""
        with self._lock:
            self._store.close()

    def _load(self) -> None:
        now, kept = time.time(), []
        for stored in sorted(self._store.all(), key=lambda one: -one.used):
            if stored.ended is not None:
                if now - stored.used > REMEMBERED_SECONDS or len(self._ended) >= REMEMBERED:
                    self._store.forget(stored.id)
                else:
                    self._ended[stored.id] = (stored.map, stored.ended)
                continue
            try:
                content = json.loads(stored.options)
                expires_after = float(content.pop("expires_after"))
                options = NewSession.model_validate(content)
            except (ValueError, KeyError, TypeError, ValidationError) as error:
                log.error("session %s cannot be taken up: %s", stored.id, error)
                self._store.end(stored.id, STATE_LOST, now)
                self._ended[stored.id] = (stored.map, STATE_LOST)
                continue
            kept.append(stored.id)
            self._living[stored.id] = Session(
                stored.id, stored.map, stored.map_created_at, options, expires_after, stored.created, stored.used,
                stored.number, stored.moment, stored.request, stored.lost, restored=True,
                idle_since=time.monotonic() - max(0.0, now - stored.used),
            )  # fmt: skip
        if kept:
            log.info("sessions are taken up", extra={"sessions": len(kept)})

    # Finding

    def create(self, map_: Map, options: NewSession) -> Session:
        """Begin a run; blocks, so call it in a thread.

        Raises:
            TooManySessions: there is no room for one more.
            UnknownSequence: the map has no traverse of a name that is given.
            StorageFull, StorageFailure: it cannot be written down.
        """
        names = options.sequences or []
        if absent := set(names) - set(map_.attributes.sequence_codes(names)):
            raise UnknownSequence(f"The map has no sequence {min(absent)!r}.")
        graph = self.graph(map_, None if options.sequences is None else Selection(Conditions(sequences=tuple(names))))
        now, longest = time.time(), self._settings.session_expiry
        expires_after = min(options.expires_after or longest, longest)
        session = Session(
            f"s-{secrets.token_hex(8)}", map_.record.id, _created(map_), options, expires_after, now, now,
            run=Run(options.run_options(), graph),
        )  # fmt: skip
        assert session.run is not None
        with self._lock:
            self._sweep()
            if len(self._living) >= self._settings.max_sessions:
                raise TooManySessions(f"There are {len(self._living)} sessions already; delete one that is over.")
            graphs = {id(one.run.graph): one.run.graph.bytes for one in self._living.values() if one.run}
            graphs[id(graph)] = graph.bytes
            held = sum(graphs.values()) + sum(one.run.bytes for one in self._living.values() if one.run)
            if held + session.run.bytes > self._settings.max_session_memory:
                raise TooManySessions(
                    f"The sessions would hold {(held + session.run.bytes) >> 20} MiB, more than they are allowed to; "
                    "delete one that is over."
                )
            self._living[session.id] = session
        try:
            with disk_errors("keep a session"):
                self._store.write(_stored(session))
        except BaseException:
            with self._lock:
                self._living.pop(session.id, None)
            raise
        return session

    def find(self, map_: Map, session_id: str) -> Session:
        """A living session of a map.

        Raises:
            UnknownSession, SessionExpired: there is none.
        """
        with self._lock:
            self._sweep()
            session = self._living.get(session_id)
            if session is not None and session.map_id == map_.record.id and session.map_created_at != _created(map_):
                self._end(session, MAP_GONE)
                session = None
            if session is not None and session.map_id == map_.record.id:
                return session
            ended = self._ended.get(session_id)
        if ended is not None and ended[0] == map_.record.id:
            raise SessionExpired(f"The session {session_id[:80]} is over. {ended[1]} Begin a new one.")
        raise UnknownSession(f"The map has no session {session_id[:80]!r}.")

    def of_map(self, map_: Map) -> list[Session]:
        """The living sessions of a map, by id."""
        with self._lock:
            self._sweep()
            found = [one for one in self._living.values() if one.map_id == map_.record.id]
        return sorted((one for one in found if one.map_created_at == _created(map_)), key=lambda one: one.id)

    def count(self) -> int:
        """Sessions that are under way, of all maps."""
        return len(self._living)

    def delete(self, session: Session) -> None:
        """End a run; it is as if there had been none.

        Raises:
            StorageFull, StorageFailure: the disk refuses.
        """
        with self._lock:  # a frame of it that is under way is not to write it down again
            with disk_errors("delete a session"):
                self._store.forget(session.id)
            self._living.pop(session.id, None)
            self._drop_charts()

    def _sweep(self) -> None:
        now = time.monotonic()
        over = [one for one in self._living.values() if now - one.idle_since >= one.expires_after and not one.waiting]
        for session in over:
            self._end(session, EXPIRED)

    def _end(self, session: Session, reason: str) -> None:
        self._living.pop(session.id, None)
        self._ended[session.id] = (session.map_id, reason)
        while len(self._ended) > REMEMBERED:
            self._forget_quietly(next(iter(self._ended)))
        self._drop_charts()
        try:
            self._store.end(session.id, reason, time.time())
        except sqlite3.Error as error:
            log.warning("the end of session %s is not written down: %s", session.id, error)

    def _forget_quietly(self, session_id: str) -> None:
        self._ended.pop(session_id)
        try:
            self._store.forget(session_id)
        except sqlite3.Error as error:
            log.warning("session %s cannot be forgotten: %s", session_id, error)

    # Going on

    def graph(self, map_: Map, selection: Selection | None) -> PlaceGraph:
        """The places as they are now, or were a moment ago where they change faster than they can be looked at."""
        names = selection.filters.sequences or () if selection else ()
        key = (map_.record.id, _created(map_), names)
        neighborhood = Neighborhood(map_.record.same_place_radius, map_.record.same_place_frames)
        with self._charting:
            snapshot, known, now = map_.snapshot(), self._charts.get(key), time.monotonic()
            if known is not None and known.graph.neighborhood == neighborhood and known.serves(snapshot, now):
                return known.graph
            living = snapshot.alive
            if selection is not None:
                allowed = selection.scope(map_, snapshot).allowed
                living = living if allowed is None else living & allowed
            graph = place_graph(snapshot.whereabouts, np.flatnonzero(living), snapshot.rows, neighborhood)
            done = time.monotonic()
            self._charts[key] = _Charted(snapshot, graph, done, done - now)
            if len(self._charts) > self._settings.max_sessions:  # of sessions that were refused, or are over
                with self._lock:
                    self._drop_charts()
            return graph

    def _drop_charts(self) -> None:
        """Those of maps and sequences that no session is about."""
        used = {(one.map_id, one.map_created_at, tuple(one.options.sequences or ())) for one in self._living.values()}
        for key in list(self._charts):
            if key not in used:
                self._charts.pop(key, None)

    def run(self, map_: Map, session: Session) -> Run:
        """The session's run over the places as they are now; call it in the session's turn.

        Raises:
            SessionExpired: what it believed cannot be read any more.
        """
        graph = self.graph(map_, session.selection)
        if session.run is None:
            try:
                stored = self._store.read(session.id)
                state = None if stored is None or stored.state is None else from_bytes(stored.state)
            except (sqlite3.Error, DamagedRecord) as error:
                log.error("session %s cannot be taken up: %s", session.id, error)
                with self._lock:
                    self._end(session, STATE_LOST)
                raise SessionExpired(f"The session {session.id} is over. {STATE_LOST} Begin a new one.") from error
            options = session.options.run_options()
            session.run = Run(options, graph) if state is None else Run.restored(options, graph, state)
            session.answer = None if stored is None else stored.answer
        session.run.place_on(graph)
        return session.run

    def frames_of(self, session: Session) -> int:
        """How many frames a session has taken in, without taking it up; 0 if that cannot be read."""
        if session.run is not None:
            return session.run.frames
        try:
            stored = self._store.read(session.id)
            return 0 if stored is None or stored.state is None else from_bytes(stored.state).frames
        except (sqlite3.Error, DamagedRecord):
            return 0

    def save(self, session: Session) -> bool:
        """Write a session down as it is; False if the disk refuses, which is no reason not to answer, and for a session
        that was ended meanwhile."""
        try:
            # Without our lock: a sync takes a while, and others look for theirs.
            return self._store.renew(_stored(session))
        except sqlite3.Error as error:
            log.warning("session %s is not written down: %s", session.id, error)
            return False


def alive_rows(map_: Map) -> NDArray[np.bool_]:
    """Which rows of the map hold a place at this moment."""
    return map_.snapshot().alive


def _created(map_: Map) -> str:
    return map_.record.created_at.isoformat()


def _stored(session: Session) -> StoredSession:
    options = {**session.options.model_dump(mode="json"), "expires_after": session.expires_after}
    state: RunState | None = None if session.run is None else session.run.state()
    return StoredSession(
        session.id,
        session.map_id,
        session.map_created_at,
        json.dumps(options),
        session.created,
        session.used,
        session.number,
        session.moment,
        session.request,
        session.lost,
        None,
        None if state is None else to_bytes(state),
        session.answer,
    )
