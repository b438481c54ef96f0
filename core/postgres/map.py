"""One map in PostgreSQL, less what searches it."""

from __future__ import annotations

import logging
import math
import threading
import time
from abc import abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager

from core.errors import MapBusy, StorageFailure
from core.ledger.maps import frames, record
from core.ledger.maps.connection import MapConnection
from core.ledger.maps.map import LedgerMap
from core.ledger.maps.record import MapState
from core.ledger.postgres import LONG_SECONDS, PostgresConnection, PostgresLedger, postgres_errors
from core.maps import moment
from core.maps.records import MapRecord
from core.maps.selection import Selection
from core.maps.status import ErasureReport, IndexStatus, KeypointsStatus, Progress, StorageStatus, no_progress
from core.maps.store import Scope, Snapshot
from core.postgres import rows
from core.postgres.exporter import PostgresExporter
from core.postgres.review import PostgresReview
from core.postgres.tables import ERASED_TABLES
from core.postgres.writing import PostgresWrite

log = logging.getLogger(__name__)


class PostgresMap(LedgerMap):
    """The places of one environment (:class:`core.maps.store.Map`).  Any thread of any process may call any method.

    One transaction writes to a map at a time.  Any method may raise StorageFailure (PostgreSQL or an engine refuses, or
    cannot be reached) and UnknownMap; methods that write may also raise StorageFull.
    """

    def __init__(self, database: PostgresLedger, state: MapState) -> None:
        """The map that was found in this state."""
        self.database, self._state = database, state
        self._noted = (-math.inf, state)  # the last state that was read, and when it was asked for
        self._room: tuple[int, StorageStatus] | None = None
        self._paused = threading.local()
        super().__init__()
        self.review = PostgresReview(state.number, self._reading, database)
        self.exporter = PostgresExporter(self.viewing, lambda: self.state, self.review)

    @property
    def record(self) -> MapRecord:
        """The map's record as it was when this object last read or wrote the map."""
        return self._state.record

    @property
    def is_open(self) -> bool:
        """True: nothing has to be read before the map can be used."""
        return True

    @property
    def state(self) -> object:
        state = self.latest()
        return state.number, state.revision

    def open(self) -> None:
        """Raise if the map is gone."""
        with self._reading():
            pass

    @property
    def number(self) -> int:
        """Of the map; never used for another one, also of the same id."""
        return self._state.number

    def note(self, state: MapState, asked: float = -math.inf) -> None:
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
        with self.database.reading() as whole:
            connection = MapConnection(whole, self.number)
            state = record.state_of(connection, self.record.id)
            self.note(state)
            yield connection, state

    @contextmanager
    def _reading(self) -> Iterator[MapConnection]:
        with self.viewing() as (connection, _):
            yield connection

    @contextmanager
    def _glancing(self) -> Iterator[MapConnection]:
        with self.database.glancing() as whole:
            yield MapConnection(whole, self.number)

    def count_places(self) -> int:
        return self.latest().places

    def latest(self) -> MapState:
        """The state of the map at this moment, by one statement, or as it was read since the work began."""
        noted, began, now = self._noted, moment.began(), time.monotonic()
        if began is not None and noted[0] >= began:
            return noted[1]
        with self._glancing() as connection:
            state = record.state_of(connection, self.record.id)
        self.note(state, now)
        return state

    def erase(self, progress: Progress = no_progress) -> ErasureReport:
        """Delete the rows that dead places have left (:meth:`core.maps.store.Map.erase`), and vacuum their tables.

        A query may need them for a minute after the place died, so this takes as long.
        """
        before, end = self.storage_status().database, time.monotonic() + rows.LEFT_SECONDS + 60
        total = self._uncleared()
        while left := self._uncleared():
            progress(total - min(left, total), total)
            if time.monotonic() > end:
                raise MapBusy("What was deleted is still being read: erase it later.")
            with self.database.transaction("delete what no place names any more") as whole:
                self._tidy(MapConnection(whole, self.number))
            if self._uncleared():
                threading.Event().wait(1)
        with self.database.connection("vacuum", LONG_SECONDS) as connection:
            for table in ERASED_TABLES:
                connection.execute(f"VACUUM {table}")
        self._room = None
        return ErasureReport(rows=total, bytes=max(0, before - self.storage_status().database))

    def _uncleared(self) -> int:
        with self._reading() as connection:
            return rows.uncleared(connection)

    def storage_status(self) -> StorageStatus:
        """How much room the map takes in PostgreSQL."""
        with self.viewing() as (connection, state):
            if self._room is None or self._room[0] != state.revision:
                descriptors = rows.room(connection)
                places, keypoints, pictures = frames.room(connection)
                whole = descriptors + pictures + keypoints
                status = StorageStatus(
                    precision=state.record.precision,
                    bytes_per_place=round(whole / state.places) if state.places else 0,
                    descriptors=descriptors,
                    index=0,
                    database=pictures + keypoints,
                    keypoints=KeypointsStatus(places=places, bytes=keypoints),
                )
                self._room = state.revision, status
            return self._room[1]

    # An engine

    @property
    @abstractmethod
    def held(self) -> bool:
        """Whether a search of the map needs neither the disk nor another process."""

    @abstractmethod
    def snapshot(self) -> Snapshot:
        """All places at this moment."""

    @abstractmethod
    def scope(self, selection: Selection | None = None) -> Scope:
        """The places that a query may find at this moment; None: all."""

    @abstractmethod
    def index_status(self) -> IndexStatus:
        """How the map is searched."""

    @abstractmethod
    def rebuild_index(self, progress: Progress = no_progress) -> IndexStatus:
        """Build the index again from the descriptors."""

    # Writing

    @contextmanager
    def paused_writes(self) -> Iterator[None]:
        """Nobody but this thread writes to the map during the block; if that cannot be any more, this thread neither.

        Raises:
            StoreUnavailable, StorageFailure.
        """
        if getattr(self._paused, "connection", None) is not None:
            yield
            return
        with self.database.locked("pause the writes to a map", rows.WRITING, self.number) as connection:
            self._paused.connection = connection
            try:
                yield
            finally:
                self._paused.connection = None

    @contextmanager
    def _transaction(self) -> Iterator[PostgresConnection]:
        """A transaction in which this thread may write to the map."""
        paused: PostgresConnection | None = getattr(self._paused, "connection", None)
        if paused is not None:
            with postgres_errors("write to a map"), paused.driver.transaction():
                yield paused
            return
        with self.database.transaction("write to a map") as connection:
            rows.expect_unpaused(connection, self.number)
            yield connection

    @abstractmethod
    def _write(self, connection: MapConnection, state: MapState) -> PostgresWrite:
        """A write of the engine that searches the map."""

    @contextmanager
    def _writing(self) -> Iterator[PostgresWrite]:
        with self.writing() as write:
            yield write

    @contextmanager
    def writing(self) -> Iterator[PostgresWrite]:
        """Collect the changes of one write, which are stored whole at the end of the block, or not at all."""
        with self._transaction() as whole:
            connection = MapConnection(whole, self.number)
            write = self._write(connection, self._locked_state(connection))
            yield write
            write.finish()
        self.note(write.state)
        try:
            with self.database.transaction("delete what no place names any more") as whole:
                self._tidy(MapConnection(whole, self.number))
        except StorageFailure as error:
            log.warning("Map %s: %s", self.record.id, error)

    def _locked_state(self, connection: MapConnection) -> MapState:
        """The state of the map, to which nobody else writes until the transaction ends."""
        return record.state_of(connection, self.record.id, locked=True)

    def _tidy(self, connection: MapConnection) -> None:
        """Delete what no place names any more; what cannot be deleted now is deleted after another write."""
        rows.clear_rows(connection)
