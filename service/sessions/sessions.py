"""The sessions of all maps: they are limited in number and memory, expire without frames, and survive a restart."""

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
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from core.belief import DamagedRecord, PlaceGraph, Run, RunState, from_bytes, place_graph, to_bytes
from core.disk.files import disk_errors
from core.errors import UnknownSequence
from core.maps import Map, Snapshot
from core.maps.selection import Conditions, Selection
from core.recognition.stages import neighborhood_of
from service.access.audit import ASKER
from service.errors.faults import QueueFull, SessionExpired, TooManySessions, UnknownSession
from service.events.events import Events
from service.events.schemas import NO_ASKER, SessionEvent
from service.sessions.schemas import NewSession
from service.sessions.store import SessionRecords, SessionStore, StoredSession
from service.settings import Settings

WAITING = 8
"""The most frames of one session that may wait for their turn."""

REMEMBERED_SECONDS = 24 * 3600.0
"""For how long an ended session is remembered as ended; later it counts as unknown."""

REMEMBERED = 10_000
"""How many ended sessions are remembered."""

GRAPH_REUSE = 20.0
"""The graph of a map that changes is used for this multiple of the time it took to build, then built again."""

REPEATED_SECONDS = 60.0
"""For how long a session that has no frame is the answer to the request that began it, sent again."""

CLOCKS_DIFFER = 1.0
"""Two clocks that differ by fewer seconds count as equal, so that the reported expiry of a session does not jitter."""

EXPIRED = "No frame came for too long."
MAP_GONE = "Its map was deleted; the map of that id is another one now."
STATE_LOST = "Its saved belief was damaged on disk."

log = logging.getLogger("placerec.sessions")


@dataclass(eq=False)
class Session:
    """One robot's run in one map.

    created, used: when the session was created and when its last frame came, seconds since 1970 UTC.
    number: the robot's number of the last frame.
    moment: when the last frame was taken, seconds since 1970 UTC.
    request: the id that the client gave the request of the last frame.
    lost: how many frames were lost by a restart; None if that is not known.
    answer: the last answer, JSON.
    run: the belief; None after a restart, until the next frame.
    restored: whether the session was restored after a restart.
    streaming: whether a WebSocket streams into the session.
    begun_by: who began it, and the id of that request; None after a restart.
    waiting: how many frames are being processed or wait for that.
    revision: of its record, where services share it; grows with every frame.
    idle_since: when the last frame came, by the monotonic clock: the session expires by this clock, because the other
        one may be set.
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
    begun_by: tuple[str, str | None, str | None] | None = None
    waiting: int = 0
    revision: int = 0
    idle_since: float = field(default_factory=time.monotonic)
    _lock: asyncio.Lock = field(default_factory=asyncio.Lock)

    @property
    def expires(self) -> float:
        """When the session expires unless a frame comes, seconds since 1970 UTC, by the clock as it is set now."""
        used = time.time() - (time.monotonic() - self.idle_since)
        return self.expires_after + (self.used if abs(used - self.used) < CLOCKS_DIFFER else used)

    def touch(self) -> None:
        """Note that a frame has come now."""
        self.used, self.idle_since = time.time(), time.monotonic()

    @property
    def selection(self) -> Selection | None:
        """The filter for the session's sequences; None: all places of the map."""
        names = self.options.sequences
        return None if names is None else Selection(Conditions(sequences=tuple(names)))

    @asynccontextmanager
    async def turn(self) -> AsyncIterator[None]:
        """Hold the session's turn for one frame; frames get it in the order of their arrival.

        Raises:
            QueueFull: too many frames of the session wait already.
        """
        if self.waiting >= WAITING:
            raise QueueFull("Too many frames of this session are waiting; send this one again in a moment.")
        self.waiting += 1
        try:
            async with self._lock:
                yield
        finally:
            self.waiting -= 1


@dataclass(frozen=True, eq=False)
class _CachedGraph:
    """The graph of a map's snapshot.

    made: when it was finished, by the monotonic clock.
    took: how many seconds it took to build.
    """

    snapshot: Snapshot
    graph: PlaceGraph
    made: float
    took: float

    def serves(self, snapshot: Snapshot, now: float) -> bool:
        """Whether the graph is that of the snapshot, or recent enough to be used for it."""
        return self.snapshot is snapshot or now - self.made < GRAPH_REUSE * self.took


class SessionMoved(Exception):
    """Another service that shares the session has processed a frame of it in the meantime."""


class Sessions:
    """All sessions.  Thread-safe.

    Args:
        events: receives the begin and the end of sessions.
        store: keeps the sessions; None: a file in the data directory.
    """

    def __init__(self, settings: Settings, events: Events, store: SessionRecords | None = None) -> None:
        self._settings, self._events = settings, events
        self._store = SessionStore(settings.data_dir) if store is None else store
        self._lock = threading.RLock()
        self._graph_lock = threading.Lock()
        self._graphs: dict[tuple[str, str, tuple[str, ...]], _CachedGraph] = {}
        self._living: dict[str, Session] = {}
        self._ended: dict[str, tuple[str, str]] = {}
        self._load()

    def close(self) -> None:
        """Close the file, which has every answered frame."""
        with self._lock:
            self._store.close()

    def _load(self) -> None:
        now, restored = time.time(), []
        for stored in sorted(self._store.all(), key=lambda one: -one.used):
            if stored.ended is not None:
                if now - stored.used > REMEMBERED_SECONDS or len(self._ended) >= REMEMBERED:
                    self._store.forget(stored.id)
                else:
                    self._ended[stored.id] = (stored.map, stored.ended)
                continue
            try:
                session = session_of(stored)
            except (ValueError, KeyError, TypeError, ValidationError) as error:
                log.error("session %s cannot be restored: %s", stored.id, error)
                self._store.end(stored.id, STATE_LOST, now)
                self._ended[stored.id] = (stored.map, STATE_LOST)
                continue
            restored.append(stored.id)
            session.restored, session.idle_since = True, time.monotonic() - max(0.0, now - stored.used)
            self._living[stored.id] = session
        if restored:
            log.info("sessions are restored", extra={"sessions": len(restored)})

    # Creating, finding and ending sessions

    def create(self, map_: Map, options: NewSession) -> Session:
        """Create a session; blocks, so call it in a thread.

        The same request again, because its answer was lost, gets the session that it has begun, if no frame has come.

        Raises:
            TooManySessions: there are too many sessions, or they would need too much memory.
            UnknownSequence: the map has no sequence of one of the names.
            StorageFull, StorageFailure: the session cannot be saved.
        """
        names = options.sequences or []
        if absent := map_.unknown_sequences(names):
            raise UnknownSequence(f"The map has no sequence {min(absent)!r}.")
        if (begun := self._begun_before(map_, options)) is not None:
            return begun
        graph = self.graph(map_, None if options.sequences is None else Selection(Conditions(sequences=tuple(names))))
        now, longest = time.time(), self._settings.session_expiry
        expires_after = min(options.expires_after or longest, longest)
        session = Session(
            f"s-{secrets.token_hex(8)}", map_.record.id, creation_time(map_), options, expires_after, now, now,
            run=Run(options.run_options(), graph),
        )  # fmt: skip
        self._keep(session)
        session.begun_by = asking_now()
        self._tell(session, "begun")
        return session

    def _keep(self, session: Session) -> None:
        """Keep a new session, if there is room for it."""
        with self._lock:
            self._sweep()
            if len(self._living) >= self._settings.max_sessions:
                raise TooManySessions(f"There are {len(self._living)} sessions already; delete one that is over.")
            self._hold(session)
        try:
            with disk_errors("keep a session"):
                self._store.write(stored_of(session))
        except BaseException:
            with self._lock:
                self._living.pop(session.id, None)
            raise

    def _hold(self, session: Session) -> None:
        """Hold a new session in memory; the caller holds the lock.

        Raises:
            TooManySessions: it would need too much memory.
        """
        assert session.run is not None
        runs = [one.run for one in (*self._living.values(), session) if one.run]
        graphs = {id(run.graph): run.graph.bytes for run in runs}
        held = sum(graphs.values()) + sum(run.bytes for run in runs)
        if held > self._settings.max_session_memory:
            raise TooManySessions(
                f"The sessions would hold {held >> 20} MiB, more than they are allowed to; delete one that is over."
            )
        self._living[session.id] = session

    def _begun_before(self, map_: Map, options: NewSession) -> Session | None:
        """The session without a frame that this request has begun a moment ago; None if it comes for the first time."""
        asking, oldest = asking_now(), time.monotonic() - REPEATED_SECONDS
        if asking is None:
            return None
        with self._lock:
            self._sweep()
            for one in self._living.values():
                same = one.begun_by == asking and one.idle_since >= oldest and one.options == options
                unused = one.number is None and one.answer is None and not one.waiting and not one.streaming
                if same and unused and (one.map_id, one.map_created_at) == (map_.record.id, creation_time(map_)):
                    return one
        return None

    def find(self, map_: Map, session_id: str) -> Session:
        """A session of a map that has not ended.

        Raises:
            UnknownSession: the map has no such session.
            SessionExpired: the session has ended.
        """
        with self._lock:
            self._sweep()
            session = self._living.get(session_id)
            if (
                session is not None
                and session.map_id == map_.record.id
                and session.map_created_at != creation_time(map_)
            ):
                self._end(session, MAP_GONE)
                session = None
            if session is not None and session.map_id == map_.record.id:
                return session
            ended = self._ended.get(session_id)
        if ended is not None and ended[0] == map_.record.id:
            raise SessionExpired(f"The session {session_id[:80]} is over. {ended[1]} Begin a new one.")
        raise UnknownSession(f"The map has no session {session_id[:80]!r}.")

    def of_map(self, map_: Map) -> list[Session]:
        """The sessions of a map that have not ended, in the order of their ids."""
        with self._lock:
            self._sweep()
            found = [one for one in self._living.values() if one.map_id == map_.record.id]
        return sorted((one for one in found if one.map_created_at == creation_time(map_)), key=lambda one: one.id)

    def count(self) -> int:
        """The number of sessions of all maps that have not ended."""
        return len(self._living)

    def delete(self, session: Session) -> None:
        """Delete a session; later it counts as unknown.

        Raises:
            StorageFull, StorageFailure: the disk refuses.
        """
        with self._lock:  # so that a frame that is being processed does not save the session again
            with disk_errors("delete a session"):
                self._store.forget(session.id)
            self._living.pop(session.id, None)
            self._drop_unused_graphs()
        self._tell(session, "ended", "It was deleted.")

    def _tell(self, session: Session, change: Literal["begun", "ended"], reason: str | None = None) -> None:
        """Tell the listeners of a session's map, if it has any; a session that ends by itself was ended by nobody."""
        if not self._events.heard(session.map_id):
            return
        by = NO_ASKER if reason in (EXPIRED, MAP_GONE, STATE_LOST) else None
        camera = session.options.camera
        event = SessionEvent.now(
            session.map_id, by, session=session.id, change=change, reason=reason, camera=camera, frame=session.number
        )
        self._events.publish(event)

    def _sweep(self) -> None:
        now = time.monotonic()
        over = [one for one in self._living.values() if now - one.idle_since >= one.expires_after and not one.waiting]
        for session in over:
            self._end(session, EXPIRED)

    def _end(self, session: Session, reason: str) -> None:
        self._living.pop(session.id, None)
        self._ended[session.id] = (session.map_id, reason)
        while len(self._ended) > REMEMBERED:
            self._forget_on_disk(next(iter(self._ended)))
        self._drop_unused_graphs()
        try:
            self._store.end(session.id, reason, time.time())
        except sqlite3.Error as error:
            log.warning("the end of session %s is not saved: %s", session.id, error)
        self._tell(session, "ended", reason)

    def _forget_on_disk(self, session_id: str) -> None:
        self._ended.pop(session_id)
        try:
            self._store.forget(session_id)
        except sqlite3.Error as error:
            log.warning("session %s cannot be deleted on disk: %s", session_id, error)

    # Graphs and runs

    def graph(self, map_: Map, selection: Selection | None) -> PlaceGraph:
        """The graph of the places that a session is about; while the map changes it may be slightly out of date."""
        names = selection.filters.sequences or () if selection else ()
        key = (map_.record.id, creation_time(map_), names)
        neighborhood = neighborhood_of(map_)
        with self._graph_lock:
            snapshot, known, now = map_.snapshot(), self._graphs.get(key), time.monotonic()
            if known is not None and known.graph.neighborhood == neighborhood and known.serves(snapshot, now):
                return known.graph
            scope = map_.scope(selection)
            snapshot = scope.snapshot
            graph = place_graph(snapshot.whereabouts, scope.living_rows(), snapshot.rows, neighborhood)
            done = time.monotonic()
            self._graphs[key] = _CachedGraph(snapshot, graph, done, done - now)
            if len(self._graphs) > self._settings.max_sessions:  # some are of refused or ended sessions
                with self._lock:
                    self._drop_unused_graphs()
            return graph

    def _drop_unused_graphs(self) -> None:
        """Drop the graphs of maps and sequences that no session uses."""
        used = {(one.map_id, one.map_created_at, tuple(one.options.sequences or ())) for one in self._living.values()}
        for key in list(self._graphs):
            if key not in used:
                self._graphs.pop(key, None)

    def run(self, map_: Map, session: Session) -> Run:
        """The session's run, over the present places of the map; call it in the session's turn.

        Raises:
            SessionExpired: the saved belief cannot be read.
        """
        graph = self.graph(map_, session.selection)
        if session.run is None:
            try:
                stored = self._store.read(session.id)
                state = None if stored is None or stored.state is None else from_bytes(stored.state)
            except (sqlite3.Error, DamagedRecord) as error:
                raise self._damaged(session, error) from error
            session.run = restored_run(session, graph, state)
            session.answer = None if stored is None else stored.answer
        session.run.place_on(graph)
        return session.run

    def _damaged(self, session: Session, error: Exception) -> SessionExpired:
        """End a session whose saved belief cannot be read; the error of its next frame."""
        log.error("session %s cannot be restored: %s", session.id, error)
        with self._lock:
            self._end(session, STATE_LOST)
        return SessionExpired(f"The session {session.id} is over. {STATE_LOST} Begin a new one.")

    def frames_of(self, session: Session) -> int:
        """How many frames a session has processed; 0 if that cannot be read.  The session is not restored for this."""
        if session.run is not None:
            return session.run.frames
        try:
            stored = self._store.read(session.id)
            return 0 if stored is None or stored.state is None else from_bytes(stored.state).frames
        except (sqlite3.Error, DamagedRecord):
            return 0

    def save(self, session: Session) -> bool:
        """Save a session; returns whether it was saved: not if the disk refuses, or if the session has ended.

        Raises:
            SessionMoved: another service has saved a frame of it in the meantime; the session is read again.
        """
        try:
            # The lock is not held: writing to disk takes a while, and other sessions need the lock.
            return self._store.renew(stored_of(session), session.revision)
        except sqlite3.Error as error:
            log.warning("session %s is not saved: %s", session.id, error)
            return False


def alive_rows(map_: Map) -> NDArray[np.bool_]:
    """Which rows of the map hold a place now; bool [rows]."""
    return map_.snapshot().alive


def creation_time(map_: Map) -> str:
    return map_.record.created_at.isoformat()


def asking_now() -> tuple[str, str | None, str | None] | None:
    """The present caller and the id of the request; None if requests cannot be distinguished."""
    asker = ASKER.get()
    return None if asker.request_id is None else (asker.principal, asker.key, asker.request_id)


def session_of(stored: StoredSession) -> Session:
    """A session without its run; raises ValueError, KeyError or TypeError if its record is damaged."""
    content = json.loads(stored.options)
    expires_after = float(content.pop("expires_after"))
    options = NewSession.model_validate(content)
    return Session(
        stored.id, stored.map, stored.map_created_at, options, expires_after, stored.created, stored.used,
        stored.number, stored.moment, stored.request, stored.lost,
    )  # fmt: skip


def restored_run(session: Session, graph: PlaceGraph, state: RunState | None) -> Run:
    """A session's run as it was saved; a new one for None."""
    options = session.options.run_options()
    return Run(options, graph) if state is None else Run.restored(options, graph, state)


def stored_of(session: Session) -> StoredSession:
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
