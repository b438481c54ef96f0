"""One map: its places in a database, and the snapshot in memory that is searched."""

from __future__ import annotations

import gc
import logging
import threading
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING

from core.disk.files import Damage
from core.errors import MapBusy, MapQuarantined, PlacerecError, StorageFailure, StorageFull, UnknownMap
from core.geometry.keypoints import Keypoints, keypoints_of
from core.index import Coder
from core.ledger.maps import frames, places, record, rows
from core.ledger.maps.archiving import Exporter
from core.ledger.maps.checksums import DamagedRow
from core.ledger.maps.connection import MapConnection
from core.ledger.maps.map import LedgerMap
from core.ledger.maps.record import MapState
from core.ledger.maps.review import Review
from core.ledger.maps.writing import Write
from core.maps import moment
from core.maps.forms import Form
from core.maps.records import MapRecord, VerifyReport
from core.maps.selection import Selection
from core.maps.status import (
    ErasureReport,
    IndexStatus,
    KeypointsStatus,
    Progress,
    Recall,
    StorageStatus,
    no_progress,
)
from core.places import Place
from core.store.database import Closed, MapDatabase
from core.store.following import DESCRIPTORS_AT_ONCE, ROWS_PER_SEGMENT, FollowedMap, tier_of
from core.store.recall import measure_recall
from core.store.rows import RowCache
from core.store.scopes import Chooser
from core.store.snapshot import Scope, Snapshot
from core.store.tiers import holds_for, tier_for
from core.store.verification import damage_of_places, inspect

if TYPE_CHECKING:
    from core.index.milvus import Milvus

log = logging.getLogger(__name__)

TIDIED_AT_ONCE = 256
"""Rows that no place names any more that a write deletes behind itself, about."""

MOST_RECENT = 1024
"""Places of a map that are remembered after they were read …"""

LONGEST_METADATA = 1000
"""… unless their metadata has more characters, so that all together take five megabytes at most."""


class RecentPlaces:
    """Places of a map that were read since its last write, by row; a query of the same place need not read them again.

    They are forgotten with every write, so that no place is ever returned as it was before.  Any thread may use this.
    """

    def __init__(self) -> None:
        self._cached: tuple[object, dict[int, Place]] = (object(), {})

    def places(self, state: object, rows: Iterable[int]) -> dict[int, Place]:
        """The places of ``rows`` that were read in this state of the map."""
        of, places = self._cached
        if of != state:
            return {}
        found = ((row, places.get(row)) for row in rows)
        return {row: place for row, place in found if place is not None}

    def keep(self, state: object, places: Mapping[int, Place]) -> None:
        """Remember places that were read after the map was found in this state."""
        small = {row: place for row, place in places.items() if len(str(place.metadata)) <= LONGEST_METADATA}
        of, cached = self._cached
        if of != state or len(cached) + len(small) > MOST_RECENT:
            self._cached = (state, dict(list(small.items())[:MOST_RECENT]))
        else:
            cached.update(small)


class Map(LedgerMap):
    """The places of one environment.  Any thread may call any method.

    A write that has returned is durable and seen by every later read and search; one that raises has changed nothing.
    Any method may raise MapQuarantined (the map is found to be damaged), StorageFailure (the disk or the server
    refuses) and UnknownMap (the map was deleted meanwhile); methods that write may also raise StorageFull.

    Args:
        database: of the map.
        state: in which it was found.
        cache: of rows of all maps.
        milvus: has the codes of large maps; None: memory has those of all.
        rows_per_segment: of its snapshots.
    """

    def __init__(
        self,
        database: MapDatabase,
        state: MapState,
        cache: RowCache,
        milvus: Milvus | None = None,
        rows_per_segment: int = ROWS_PER_SEGMENT,
    ) -> None:
        self.database, self._state, self._cache = database, state, cache
        self._posed = state.posed  # a place that may have a pose, by which others learn of what kind theirs must be
        self._noted = (-1.0, state)  # the last state that was read, and when it was asked for
        self._followed = FollowedMap(database, self._glancing, cache, milvus, rows_per_segment)
        self._room: tuple[object, StorageStatus] | None = None
        self._recent_places = RecentPlaces()
        self._damage: str | None = None
        self._end: PlacerecError | None = None
        super().__init__()
        self.review = Review(self._reading, lambda: self._transaction(alone=False))
        self.exporter = Exporter(self.viewing, lambda: self.state, self.review, self.expect_there)

    # Opening and closing

    @property
    def record(self) -> MapRecord:
        """The map's record as it was when this object last read or wrote the map."""
        return self._state.record

    @property
    def number(self) -> int:
        """The number of the map, which no other map of the database ever has, also of the same id."""
        return self._state.number

    @property
    def damage(self) -> str | None:
        """Why the map is quarantined; None while it is in service."""
        return self._damage

    def expect_there(self) -> None:
        """Raise if the map is known to be damaged, or was closed or deleted by this service."""
        if self._end is not None:
            raise type(self._end)(*self._end.args)
        if self._damage is not None:
            raise MapQuarantined(f"Map {self.record.id!r} is damaged and out of service: {self._damage}.")

    @property
    def is_open(self) -> bool:
        """Whether the map is ready for use; this does not wait."""
        return self._damage is None and self._followed.held is not None

    @property
    def held(self) -> bool:
        """Whether a search of the map needs neither the disk nor another process; this does not wait."""
        held = self._followed.held
        return held is not None and held.snapshot.holds and not self.database.shared

    @property
    def state(self) -> object:
        """A value that is the same until the map is written to."""
        state = self.latest()
        return state.number, state.revision, state.stamp

    def open(self) -> None:
        """Have the map ready for use."""
        self.snapshot()

    def rest(self) -> None:
        """Let go of what is in memory; the next use reads it again."""
        self._followed.forget()

    def end(self, deleted: bool = False) -> None:
        """Refuse further use; the database is the caller's to close."""
        name = self.record.id
        self._end = UnknownMap(f"There is no map {name!r}.") if deleted else StorageFailure(f"Map {name!r} is closed.")
        self._followed.forget()

    @contextmanager
    def _guarded(self) -> Iterator[None]:
        """Name the end of the map, and quarantine it if it is damaged."""
        self.expect_there()
        try:
            yield
        except Closed:
            self.expect_there()
            raise StorageFailure(f"Map {self.record.id!r} is closed.") from None
        except Damage as damage:
            if self._end is not None:
                raise type(self._end)(*self._end.args) from damage  # its files may be gone
            if self.database.shared:
                raise StorageFailure(f"Map {self.record.id!r} is damaged: {damage}.") from damage
            log.error("Map %s is quarantined: %s", self.record.id, damage)
            self._damage = str(damage)
            self._followed.forget()
            raise MapQuarantined(f"Map {self.record.id!r} is damaged and out of service: {damage}.") from damage

    # Reading

    def note(self, state: MapState, asked: float = -1.0) -> None:
        """Remember a state that was read, unless a later one is known.

        Args:
            asked: when it was asked for, by the monotonic clock.
        """
        if state.revision >= self._state.revision:
            self._state = state
            self._noted = (asked, state)

    @contextmanager
    def viewing(self) -> Iterator[tuple[MapConnection, MapState]]:
        """A transaction that reads the map, and the map's state in it."""
        with self._guarded(), self.database.reading() as connection:
            state = record.state_of(connection, self.record.id)
            self.note(state)
            yield connection, state

    @contextmanager
    def _reading(self) -> Iterator[MapConnection]:
        with self.viewing() as (connection, _):
            yield connection

    @contextmanager
    def _glancing(self) -> Iterator[MapConnection]:
        with self._guarded(), self.database.glancing() as connection:
            yield connection

    def latest(self) -> MapState:
        """The state of the map at this moment, or as it was read since the work began."""
        if not self.database.shared:
            self.expect_there()
            return self._state
        noted, began, now = self._noted, moment.began(), time.monotonic()
        if began is not None and noted[0] >= began:
            return noted[1]
        with self._glancing() as connection:
            state = record.state_of(connection, self.record.id)
        self.note(state, now)
        return state

    def count_places(self) -> int:
        """How many places the map has; their looks do not count."""
        return self.latest().places

    def snapshot(self) -> Snapshot:
        """All places at this moment; later writes do not change the snapshot."""
        if (held := self._followed.as_of(self.latest())) is not None:
            return held.snapshot
        self._expect_sound()
        with self.viewing() as (connection, state):
            return self._followed.up_to_date(connection, state).snapshot

    def _expect_sound(self) -> None:
        """Check the places of a small map in a file, and what they are found by, before it is read.

        An SQLite file has no checksums of its own.  Of a larger map, rows are checked when they are read.
        """
        if self.database.shared or self._followed.held is not None:
            return
        with self.viewing() as (connection, state):
            if not holds_for(state.record.index, state.searched, True):
                return
            if problem := next(damage_of_places(self.database, connection), None):
                raise DamagedRow(problem)
            stale = places.stale_tokens(connection)
        if stale:  # it can be made again from the places, which are sound
            log.warning("The index of the metadata of map %s is rebuilt: %s.", self.record.id, stale[0])
            with self._transaction() as connection:
                places.rebuild_tokens(connection)

    def scope(self, selection: Selection | None = None) -> Scope:
        """The places that a query may find at this moment; None: all."""
        if not selection:
            return Scope(self.snapshot())
        self._expect_sound()
        with self.viewing() as (connection, state):
            return Chooser(self._followed.up_to_date(connection, state).snapshot, connection).scope(selection)

    def places_at(self, rows: Sequence[int]) -> list[Place | None]:
        """The places of rows that a search returned; None where a place was deleted or got another frame since.

        Of the row of a look it is its place, with the camera and the picture of the look, which it names.
        """
        state, wanted = self.state, [int(row) for row in rows]
        found = self._recent_places.places(state, wanted)
        if missing := [row for row in wanted if row not in found]:
            with self._glancing() as connection:
                read = {row: stored.shown() for row, stored in places.at_rows(connection, missing).items()}
            self._recent_places.keep(state, read)
            found.update(read)
        return [found.get(row) for row in wanted]

    def keypoints_at(self, rows: Sequence[int]) -> list[Keypoints | None]:
        """The keypoints of the places of rows that a search returned.

        Returns:
            In the order of ``rows``; None where a place was deleted or got another frame since, where none are stored,
            and where the stored ones are damaged, which is logged.
        """
        if (held := self._followed.held) is None:
            return super().keypoints_at(rows)

        def read(missing: list[int]) -> dict[int, bytes]:
            with self._glancing() as connection:
                return {row: one.record() for row, one in frames.keypoints_at(connection, missing).items()}

        wanted = [int(row) for row in rows]
        found = self._cache.read((held.source.generation, "keypoints"), wanted, read)
        return [keypoints_of(found[row]) if row in found else None for row in wanted]

    # How it is stored

    def index_status(self) -> IndexStatus:
        """How the map is searched; this does not read it."""
        state, held = self._state, self._followed.held
        setting, count = state.record.index, state.searched
        tier = tier_for(setting, count, "exact") if held is None else tier_of(held.snapshot)
        recall = None if state.recall is None or tier == "exact" else Recall.model_validate_json(state.recall)
        return IndexStatus(
            setting=setting,
            tier=tier,
            wanted=tier_for(setting, count, tier),
            state="unopened" if held is None else "ready",
            rows_indexed=0 if held is None else held.snapshot.coded,
            recall=recall,
            bytes_in_memory=0 if held is None else held.snapshot.memory,
        )

    def rebuild_index(self, progress: Progress = no_progress) -> IndexStatus:
        """Compute the codes of all rows again, store them, and measure their recall; searches go on meanwhile.

        Args:
            progress: called with the number of rows done and of all; its exceptions end the work, and the part done
                until then stays.
        """
        form, coder, total = Form.of(self.record), Coder.of(self.record.dimension), self.snapshot().rows
        for first in range(0, total, DESCRIPTORS_AT_ONCE):
            some = range(first, min(total, first + DESCRIPTORS_AT_ONCE))
            with self._writing() as write:
                if stored := rows.at(write.connection, "descriptors", some):
                    codes = coder.encode(form.descriptors(list(stored.values())))
                    rows.replace(write.connection, "codes", dict(zip(stored, map(bytes, codes), strict=True)))
            progress(some.stop, total)
        self._followed.forget()
        if (snapshot := self.snapshot()).table is not None:
            recall = measure_recall(snapshot, lambda _done, _all: progress(total, total))
            with self._writing() as write:
                write.note_recall(None if recall is None else recall.model_dump_json())
        return self.index_status()

    def erase(self, progress: Progress = no_progress) -> ErasureReport:
        """Overwrite or remove what places that were deleted, and former frames, have left where the map is stored.

        Afterwards the file of the map has no byte of their pictures, descriptors or keypoints.  In PostgreSQL the rows
        are gone, and it is its to use their room again.  A query of another service may need them for a minute after a
        place died, so that this takes as long.

        Args:
            progress: called with the number of rows done and of all; its exceptions end the work, which can be done
                again.

        Raises:
            MapBusy: what was deleted is still being read; try again.
        """
        end, total = time.monotonic() + rows.LEFT_SECONDS + 60, self._left()[1]
        while left := self._left()[0]:
            progress(total - min(left, total), total)
            if time.monotonic() > end:
                raise MapBusy("What was deleted is still being read: erase it later.")
            if not self._tidy(at_once=self._is_unread()):
                gc.collect()  # a snapshot in a circle of objects, as a traceback makes it, is in use by nobody
                threading.Event().wait(0.05 if not self.database.shared else 1)
        with self._guarded():
            freed = self.database.erase()
        with self._transaction() as connection:
            dead = rows.dead_since(connection, -1)
            rows.note_erased(connection)
        self._followed.erase(self.record, dead)
        self._room = None
        return ErasureReport(rows=total, bytes=freed)

    def _left(self) -> tuple[int, int]:
        with self._reading() as connection:
            return rows.left(connection)

    def storage_status(self) -> StorageStatus:
        """How much room the map takes."""
        with self.viewing() as (connection, state):
            key = (state.number, state.revision, state.stamp)
            if self._room is None or self._room[0] != key:
                count, keypoints, pictures = frames.room(connection)
                descriptors = state.searched * Form.of(state.record).frame.itemsize
                coded = tier_for(state.record.index, state.searched, "exact") == "compact"
                codes = state.searched * Coder.of(state.record.dimension).bytes_per_place if coded else 0
                known = descriptors + codes + keypoints + pictures
                whole = self.database.room() or known
                status = StorageStatus(
                    precision=state.record.precision,
                    bytes_per_place=round(whole / state.places) if state.places else 0,
                    descriptors=descriptors,
                    index=codes,
                    database=max(whole, known) - descriptors - codes,
                    keypoints=KeypointsStatus(places=count, bytes=keypoints),
                )
                self._room = key, status
            return self._room[1]

    def verify(self, progress: Progress = no_progress) -> VerifyReport:
        """Read all of the map again and check it; writes and searches go on meanwhile.

        A damaged map is reported but not quarantined, because what is searched passed its checks when it was read.
        """
        with self._guarded():
            return inspect(self.database, self.record.id, self._followed.held, progress)

    # Writing

    @contextmanager
    def paused_writes(self) -> Iterator[None]:
        """Nobody but this thread writes to the map during the block."""
        with self._guarded(), self.database.paused():
            yield

    @contextmanager
    def _transaction(self, alone: bool = True) -> Iterator[MapConnection]:
        with self._guarded(), self.database.writing(alone) as connection:
            yield connection

    @contextmanager
    def _writing(self) -> Iterator[Write]:
        """One write, which is stored whole at the end of the block, or not at all."""
        try:
            with self._transaction() as connection:
                state = record.state_of(connection, self.record.id, locked=True)
                write = Write(connection, replace(state, posed=self._posed))
                yield write
                write.finish()
        except StorageFull:
            self._try_to_tidy(True)  # which makes room for another try
            raise
        self._posed = write.state.posed
        self.note(write.state)
        self._try_to_tidy(write.leaves)

    writing = _writing

    def _try_to_tidy(self, fresh: bool) -> None:
        """Delete some of what no place names any more; what cannot be deleted now is deleted after another write.

        Args:
            fresh: also what died a moment ago, if it is known that nobody needs it.
        """
        try:
            known, done = fresh and self._is_unread(), 0
            while done < TIDIED_AT_ONCE and (cleared := self._tidy(known)):
                done += cleared
            if done:
                self.database.give_back()
        except PlacerecError as error:
            log.warning("Map %s: %s", self.record.id, error)

    def _is_unread(self) -> bool:
        """Whether it is known that nobody searches the map as it was before its last write."""
        if self.database.shared:
            return False
        if self.is_open:
            self.snapshot()  # older ones, which may need what was deleted, are then known
        return not self._followed.has_older_readers

    def _tidy(self, at_once: bool) -> int:
        with self._transaction() as connection:
            return rows.clear(connection, at_once)
