"""The sessions of all maps: they are limited in number and memory, expire without frames, and survive a restart.

A session's record in the ledger is what counts.  A service holds the belief in memory, too, with the revision of the
record that it was saved as: if that is still the record's, the next frame goes on from memory, else the belief is read.
A frame is saved only onto the revision that it was processed from, so that of two frames that two services process at
the same time one comes after the other.

Where services share the ledger, a session expires by the clock of the database, and each looks at the record before
each frame.  Where nobody else writes to it, all living sessions are held in memory, expire by this machine's monotonic
clock, and are found and listed without a look at the disk.
"""

from __future__ import annotations

import logging
import secrets
import threading
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from core.belief import DamagedRecord, PlaceGraph, Run, from_bytes
from core.disk.files import Damage
from core.errors import StorageFailure, StorageFull, UnknownSequence
from core.ledger import Ledger
from core.store import Map
from service.access.audit import ASKER
from service.errors.faults import SessionExpired, TooManySessions, UnknownSession
from service.events.events import Events
from service.events.schemas import NO_ASKER, SessionEvent
from service.fairness import Holding, SharedRoom
from service.learning.run_notes import RunNotes
from service.peers.peers import Peers
from service.sessions.graphs import SessionGraphs
from service.sessions.schemas import NewSession
from service.sessions.session import Session, creation_time
from service.sessions.table import SessionRecord, SessionTable, begun_by, caller_of, is_visited
from service.settings import Settings

EXPIRED = "No frame came for too long."
MAP_GONE = "Its map was deleted; the map of that id is another one now."
STATE_LOST = "Its saved belief was damaged on disk."
DELETED = "It was deleted."
GAVE_WAY = "Its room was needed for others, and it had waited longest for a frame."

REFUSALS = (StorageFull, StorageFailure, Damage)

log = logging.getLogger("placerec.sessions")


class SessionMoved(Exception):
    """Another service that shares the session has processed a frame of it in the meantime."""


class Sessions:
    """All sessions of the services that share a ledger.  Any thread may use it; all methods but ``count`` may block.

    Every method but ``count`` and ``save`` may raise StorageFull, StorageFailure and Damage: the ledger cannot be read
    or written.  A frame that cannot be saved is answered all the same, and says so; the next one at this service goes
    on from it.

    Args:
        events: receives the begin and the end of sessions.
        ledger: has the sessions.
        peers: the services that share it.

    on_run: called with the notes of a run, or of a part of it, and its session, once they are complete.
    """

    def __init__(self, settings: Settings, events: Events, ledger: Ledger, peers: Peers) -> None:
        self.on_run: Callable[[Session, RunNotes], None] = lambda _session, _notes: None
        self._settings, self._events, self._alone = settings, events, peers.alone
        self._ledger, self._table, self._graphs = ledger, SessionTable(ledger), SessionGraphs()
        self._lock = threading.RLock()
        self._held: dict[str, Session] = {}
        self._counted = 0  # sessions of all services
        if self._alone:
            self._restore()
        peers.every(self.tidy)

    def close(self) -> None:
        """Close the file, which has every answered frame; a ledger that services share is closed by its owner."""
        if self._alone:
            self._ledger.close()

    def _restore(self) -> None:
        """Hold the sessions of before a restart."""
        for record in self._table.living():
            if (session := self._session_of(record)) is not None:
                session.restored = True
                self._held[session.id] = session
        if self._held:
            log.info("sessions are restored", extra={"sessions": len(self._held)})

    def _session_of(self, record: SessionRecord) -> Session | None:
        """The session of a record; None if that is damaged, and the session is over."""
        try:
            return Session.of(record)
        except ValueError as error:
            log.error("session %s cannot be restored: %s", record.id, error)
            self._table.end(record.id, STATE_LOST)
            return None

    # Creating, finding and ending sessions

    def create(self, map_: Map, options: NewSession) -> Session:
        """Create a session.

        The same request again, because its answer was lost, gets the session that it has begun, if no frame has come.

        Raises:
            TooManySessions: there are too many sessions, or they would need too much memory, and no other caller has
                more of them.
            UnknownSequence: the map has no sequence of one of the names.
        """
        if absent := map_.unknown_sequences(options.sequences or []):
            raise UnknownSequence(f"The map has no sequence {min(absent)!r}.")
        longest = self._settings.session_expiry
        expires_after = min(options.expires_after or longest, longest)
        session = Session(f"s-{secrets.token_hex(8)}", map_.record.id, creation_time(map_), options, expires_after)
        self._end_expired()
        asker = ASKER.get()
        session.begun_by = begun_by(asker)
        if asker.request_id is not None and (begun := self._begun_before(map_, session)) is not None:
            return begun
        session.run = Run(options.run_options(), self._graphs.graph(map_, session.selection))
        self._hold(session)
        try:
            added, given_way = self._table.add(session.record(), self._settings.max_sessions, GAVE_WAY)
        except BaseException:
            self._let_go(session.id)
            raise
        session.created = session.used = added
        for record in given_way:
            self._let_go(record.id)
            if (ended := self._session_of(record)) is not None:
                self._tell(ended, "ended", GAVE_WAY)
        self._tell(session, "begun")
        return session

    def _hold(self, session: Session) -> None:
        """Hold a new session in memory.

        Sessions of a caller that needs more memory end to make room for it.

        Raises:
            TooManySessions: it would need too much memory.
        """
        while True:
            with self._lock:
                sizes = sizes_of([*self._held.values(), session])
                if (held := sum(sizes.values())) <= self._settings.max_session_memory:
                    self._held[session.id] = session
                    return
                if (given_way := _greediest(session, sizes)) is None:
                    self._graphs.drop_unused(self._held.values())
                    raise TooManySessions(
                        f"The sessions would hold {held >> 20} MiB, more than they are allowed to; delete one that is"
                        " over."
                    )
            self._end(given_way, GAVE_WAY)

    def _let_go(self, session_id: str) -> bool:
        """Hold a session no longer; whether it was held."""
        with self._lock:
            held = self._held.pop(session_id, None)
            self._graphs.drop_unused(self._held.values())
        if held is not None and held.notes is not None:
            notes, held.notes = held.notes, None
            if self._is_of_one_key(held):
                self.on_run(held, notes)
        return held is not None

    def _is_of_one_key(self, session: Session) -> bool:
        """Whether no other key has sent a frame into a session that is over, to any service."""
        if session.visited or self._alone:
            return not session.visited
        try:
            head = self._table.head(session.id)
        except REFUSALS as error:
            log.warning("session %s teaches its map nothing: %s", session.id, error)
            return False
        return head is None or not is_visited(head.begun_by)

    def _begun_before(self, map_: Map, session: Session) -> Session | None:
        """The session without a frame that this request has begun a moment ago; None if it comes for the first time."""
        found = self._table.begun(session.record())
        if found is None:
            return None
        begun = self.find(map_, found)
        return None if begun.answer is not None or begun.waiting or begun.streaming else begun

    def find(self, map_: Map, session_id: str) -> Session:
        """A session of a map that has not ended.

        Raises:
            UnknownSession: the map has no such session.
            SessionExpired: the session has ended.
        """
        self._end_expired()
        session = self._held.get(session_id)
        if session is None or not self._alone:
            session = self._look(map_, session_id)
        if session.map_id != map_.record.id:
            raise _unknown(session_id)
        if not session.is_about(map_):
            self._end(session, MAP_GONE)
            raise _ended(session_id, MAP_GONE)
        if session.over:
            raise _ended(session_id, EXPIRED)
        return session

    def _look(self, map_: Map, session_id: str) -> Session:
        """A session that has not ended, with what its record says of it now.

        Raises:
            UnknownSession, SessionExpired.
        """
        head = self._table.head(session_id)
        if head is None or head.ended is not None:
            self._let_go(session_id)
        if head is None or head.map != map_.record.id:
            raise _unknown(session_id)
        if head.ended == DELETED:
            raise _unknown(session_id)
        if head.ended is not None:
            raise _ended(session_id, head.ended)
        session = self._held.get(session_id) or self._session_of(head)
        if session is None:
            raise _ended(session_id, STATE_LOST)
        with self._lock:
            session = self._held.setdefault(session_id, session)
        session.see(head)
        return session

    def of_map(self, map_: Map) -> list[Session]:
        """The sessions of a map that have not ended, in the order of their ids."""
        if not self._alone:
            found = self._table.living_of(map_.record.id, creation_time(map_))
            return [session for record in found if (session := self._session_of(record)) is not None]
        self._end_expired()
        with self._lock:
            held = list(self._held.values())
        return sorted((one for one in held if one.is_about(map_)), key=lambda one: one.id)

    def all(self) -> list[Session]:
        """The sessions of all maps that have not ended, in the order of their ids."""
        if not self._alone:
            found = (self._session_of(record) for record in self._table.living())
            return [session for session in found if session is not None and not session.over]
        self._end_expired()
        with self._lock:
            return sorted(self._held.values(), key=lambda one: one.id)

    def count(self) -> int:
        """The number of sessions of all maps that have not ended; those of other services a few seconds ago."""
        return len(self._held) if self._alone else self._counted

    def delete(self, session: Session) -> None:
        """Delete a session; later it counts as unknown."""
        if session.visited and not self._alone:
            self._table.end(session.id, DELETED)  # for the services that have notes of it
        else:
            self._table.forget(session.id)
        self._let_go(session.id)
        self._tell(session, "ended", DELETED)

    def erase(self, session: Session) -> None:
        """Delete a session, and have its map learn nothing from the notes that this service has of it."""
        session.notes = None
        self.delete(session)

    def forget_notes(self, map_: Map, going: Callable[[RunNotes], bool]) -> None:
        """Drop notes of the runs through a map that go on at this service; these runs teach nothing from now on."""
        with self._lock:
            held = [one for one in self._held.values() if one.is_about(map_)]
        for session in held:
            if (notes := session.notes) is not None and going(notes):
                session.notes = None

    def forget(self, session_id: str) -> None:
        """Delete what is remembered of a session that has ended, once this service has let go of it."""
        self._let_go(session_id)  # before: what is remembered says whether the run may teach
        self._table.forget(session_id)

    def tidy(self) -> None:
        """End the sessions of all services that have expired, and let go of those that this one holds in vain."""
        for record in self._table.end_expired(EXPIRED):
            if (session := self._session_of(record)) is not None:
                self._tell(session, "ended", EXPIRED)
        for session in [*self._expired(), *self._ended_elsewhere()]:
            if not session.streaming:
                self._let_go(session.id)
        self._counted = self._table.count()

    def _ended_elsewhere(self) -> list[Session]:
        """The sessions of which this service has notes, and that another service has ended."""
        with self._lock:
            noted = [one for one in self._held.values() if one.notes is not None]
        if not noted or self._alone:
            return []
        living = {record.id for record in self._table.living()}
        return [one for one in noted if one.id not in living]

    def _end_expired(self) -> None:
        """End the sessions that have expired; where services share them, :meth:`tidy` does that."""
        if self._alone:
            for session in self._expired():
                self._end(session, EXPIRED)

    def _expired(self) -> list[Session]:
        with self._lock:
            return [one for one in self._held.values() if one.over]

    def _end(self, session: Session, reason: str) -> None:
        if not self._let_go(session.id):  # another thread ends it
            return
        try:
            self._table.end(session.id, reason)
        except REFUSALS as error:
            log.warning("the end of session %s is not saved: %s", session.id, error)
        self._tell(session, "ended", reason)

    def _tell(self, session: Session, change: Literal["begun", "ended"], reason: str | None = None) -> None:
        """Tell the listeners of a session's map, if it has any; a session that ends by itself was ended by nobody."""
        if not self._events.heard(session.map_id):
            return
        by = NO_ASKER if reason in (EXPIRED, MAP_GONE, STATE_LOST, GAVE_WAY) else None
        camera = session.options.camera
        event = SessionEvent.now(
            session.map_id, by, session=session.id, change=change, reason=reason, camera=camera, frame=session.number
        )
        self._events.publish(event)

    # Runs

    def run(self, map_: Map, session: Session) -> Run:
        """The session's run, over the present places of the map; call it in the session's turn.

        Raises:
            SessionExpired: the saved belief cannot be read, or the session has ended.
        """
        graph = self._graphs.graph(map_, session.selection)
        if session.run is None or session.revision != session.recorded:
            try:
                session.run = self._read(session, graph)
            except (Damage, DamagedRecord) as error:
                log.error("session %s cannot be restored: %s", session.id, error)
                self._end(session, STATE_LOST)
                raise _ended(session.id, STATE_LOST) from error
        session.run.place_on(graph)
        return session.run

    def _read(self, session: Session, graph: PlaceGraph) -> Run:
        """A session's run as it was saved."""
        record = self._table.read(session.id)
        if record is None:
            raise _ended(session.id, "It ended meanwhile.")
        options = session.options.run_options()
        run = Run(options, graph) if record.state is None else Run.restored(options, graph, from_bytes(record.state))
        session.read_fields(record)
        return run

    def save(self, session: Session) -> bool:
        """Save a session after a frame; returns whether it was saved: not if the disk or server refuses, or if the
        session has ended.

        Raises:
            SessionMoved: another service has saved a frame of it in the meantime; the session is read again.
        """
        try:
            # No lock is held: writing to disk takes a while, and other sessions need the lock.
            if self._table.renew(session.record()):
                session.revision += 1
                session.recorded = session.revision
                return True
            head = self._table.head(session.id)
        except REFUSALS as error:
            log.warning("session %s is not saved: %s", session.id, error)
            return False
        session.run = None  # what was saved by another service counts
        if head is None or head.ended is not None:
            return False
        raise SessionMoved


def alive_rows(map_: Map) -> NDArray[np.bool_]:
    """Which rows of the map hold a place now; bool [rows]."""
    return map_.snapshot().alive


def _unknown(session_id: str) -> UnknownSession:
    return UnknownSession(f"The map has no session {session_id[:80]!r}.")


def _ended(session_id: str, reason: str) -> SessionExpired:
    return SessionExpired(f"The session {session_id[:80]} is over. {reason} Begin a new one.")


def sizes_of(sessions: Sequence[Session]) -> dict[Session, int]:
    """The bytes that each session holds; those of a graph are divided among the sessions over it."""
    runs = {one: one.run for one in sessions if one.run is not None}
    users = Counter(id(run.graph) for run in runs.values())
    return {one: run.bytes + run.graph.bytes // users[id(run.graph)] for one, run in runs.items()}


def _greediest(session: Session, sizes: Mapping[Session, int]) -> Session | None:
    """The session that gives way to a new one, the longest without a frame of the caller and map that hold most."""
    chosen: list[Session] = []
    others = sorted((one for one in sizes if one is not session), key=lambda one: one.idle)
    room = SharedRoom(sum(sizes[one] for one in others))
    for one in others:
        room.take(Holding(partial(_choose, chosen, one), one.map_id, caller_of(one.begun_by)), sizes[one])
    room.take(Holding(lambda: False, session.map_id, caller_of(session.begun_by)), sizes[session])
    return chosen[0] if chosen else None


def _choose(chosen: list[Session], session: Session) -> bool:
    chosen.append(session)
    return True
