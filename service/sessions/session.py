"""One session as a service holds it in memory, and its record."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass, field

from core.belief import Contradiction, Run, to_bytes
from core.clocks import Stamp
from core.maps.selection import Conditions, Selection
from core.store import Map
from service.access.audit import Asker
from service.access.roles import Principal, covers
from service.errors.faults import QueueFull, SessionOfAnother
from service.learning.run_notes import RunNotes
from service.sessions.schemas import NewSession
from service.sessions.table import SessionRecord, is_begun_by, is_visited, key_of, visited

WAITING = 8
"""The most frames of one session that may wait for their turn."""

CLOCKS_DIFFER = 1.0
"""Two clocks that differ by fewer seconds count as equal, so that the reported expiry of a session does not jitter."""


@dataclass(eq=False)
class Session:
    """One robot's run in one map.

    expires_after: seconds without a frame after which the session expires.
    created, used: when the session was created and when its last frame came, seconds since 1970 UTC.
    number: the robot's number of the last frame.
    moment: when the last frame was taken, seconds since 1970 UTC.
    request: the id that the client gave the request of the last frame.
    lost: how many frames were lost by a restart; None if that is not known.
    frames: how many frames the session has processed.
    answer: the last answer, JSON.
    run: the belief; None until it is read.
    revision: of the record that the belief was saved as.
    recorded: the revision of the record, as it was last seen.
    restored: whether the session was restored after a restart.
    streaming: whether a WebSocket streams into the session.
    notes: what the map learns from, of the frames that this service has processed; None: it learns nothing.
    notable: whether it is still to be decided whether this service takes notes.
    begun_by: the caller and the request that began it, as its record has them.
    probe: finds out within some seconds whether the client of that WebSocket is there, and else ends it.
    waiting: how many frames are being processed or wait for that.
    idle_since: when the last frame came, by the monotonic clock: the session expires by this clock, because the other
        one may be set.
    """

    id: str
    map_id: str
    map_created_at: str
    options: NewSession
    expires_after: float
    created: float = field(default_factory=time.time)
    used: float = field(default_factory=time.time)
    number: int | None = None
    moment: float | None = None
    request: str | None = None
    lost: int | None = None
    frames: int = 0
    answer: str | None = None
    run: Run | None = None
    revision: int = 0
    recorded: int = 0
    restored: bool = False
    streaming: bool = False
    notes: RunNotes | None = None
    notable: bool = True
    begun_by: str | None = None
    probe: Callable[[float], Awaitable[bool]] | None = None
    waiting: int = 0
    idle_since: float = field(default_factory=time.monotonic)
    _lock: asyncio.Lock = field(default_factory=asyncio.Lock)

    @classmethod
    def of(cls, record: SessionRecord) -> Session:
        """A session whose belief is not read yet.

        Raises:
            ValueError: the record is damaged.
        """
        options = NewSession.model_validate_json(record.options)
        session = cls(record.id, record.map, record.map_created_at, options, record.expires_after, record.created)
        session.begun_by = record.begun_by
        session.read_fields(record)
        session.idle_since = time.monotonic() - max(0.0, record.idle)
        return session

    def read_fields(self, record: SessionRecord) -> None:
        """Take over what frames change, but for the belief."""
        self.used, self.revision, self.recorded = record.used, record.revision, record.revision
        self.number, self.moment, self.request = record.number, record.moment, record.request
        self.lost, self.frames, self.answer = record.lost, record.frames, record.answer
        self._see_visitors(record)

    def _see_visitors(self, record: SessionRecord) -> None:
        if not self.visited:  # which may not be saved yet
            self.begun_by = record.begun_by

    @property
    def visited(self) -> bool:
        """Whether another key than the one that began the session has sent a frame into it, to any service."""
        return is_visited(self.begun_by)

    def receive(self, asker: Asker) -> None:
        """Note who sends a frame."""
        if not self.visited and not is_begun_by(self.begun_by, asker):
            self.begun_by = visited(self.begun_by)

    def record(self) -> SessionRecord:
        """The session as it is saved."""
        return SessionRecord(
            self.id,
            self.map_id,
            self.map_created_at,
            self.options.model_dump_json(exclude={"expires_after"}),
            self.expires_after,
            number=self.number,
            moment=self.moment,
            request=self.request,
            lost=self.lost,
            frames=self.frames,
            revision=self.revision,
            begun_by=self.begun_by,
            state=None if self.run is None else to_bytes(self.run.state()),
            answer=self.answer,
        )

    def see(self, head: SessionRecord) -> None:
        """Note the revision of the record, and when the last frame came."""
        self.used, self.recorded = head.used, max(self.recorded, head.revision)
        self._see_visitors(head)
        self.idle_since = max(self.idle_since, time.monotonic() - max(0.0, head.idle))

    @property
    def key(self) -> str | None:
        """The name of the key that began the session; None without one."""
        return key_of(self.begun_by)

    @property
    def contradiction(self) -> Contradiction | None:
        """What frames say is wrong with odometry; None while nothing is, and while the belief is not read."""
        return None if self.run is None else self.run.contradiction

    @property
    def stamp(self) -> Stamp:
        """The time and the number of the last frame that had each."""
        return Stamp(self.moment, self.number)

    @property
    def idle(self) -> float:
        """Seconds since the last frame."""
        return time.monotonic() - self.idle_since

    @property
    def last_frame_came(self) -> float | None:
        """When the last frame came, seconds since 1970 UTC, by the clock as it is set now; None before the first."""
        return self.expires - self.expires_after if self.frames else None

    @property
    def over(self) -> bool:
        """Whether the session has expired; not while a frame is being processed."""
        return self.idle >= self.expires_after and not self.waiting

    @property
    def expires(self) -> float:
        """When the session expires unless a frame comes, seconds since 1970 UTC, by the clock as it is set now."""
        used = time.time() - self.idle
        return self.expires_after + (self.used if abs(used - self.used) < CLOCKS_DIFFER else used)

    def touch(self) -> None:
        """Note that a frame has come now."""
        self.used, self.idle_since = time.time(), time.monotonic()

    def require(self, principal: Principal, ending: bool = False) -> None:
        """Refuse callers with another key than the one that began the session.

        A key that takes the place of a revoked one under the same name counts as the same.  A session that was begun
        while there were no keys is anybody's.

        Args:
            ending: whether the session is to end, which keys of the role ``admin`` may have as well.

        Raises:
            SessionOfAnother: the session is not the caller's.
        """
        if self.key is None or principal.key_id is None or principal.name == self.key:
            return
        if not (ending and covers(principal.role, "admin")):
            raise SessionOfAnother(f"The session {self.id} was begun with another key; begin one of your own.")

    @property
    def selection(self) -> Selection | None:
        """The filter for the session's sequences; None: all places of the map."""
        names = self.options.sequences
        return None if names is None else Selection(Conditions(sequences=tuple(names)))

    def is_about(self, map_: Map) -> bool:
        """Whether this is a session of a map, and not of an earlier one of the same id."""
        return (self.map_id, self.map_created_at) == (map_.record.id, creation_time(map_))

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


def creation_time(map_: Map) -> str:
    return map_.record.created_at.isoformat()
