"""One map in PostgreSQL, searched by Milvus."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from core.ledger.maps import places
from core.ledger.maps.connection import MapConnection
from core.ledger.maps.record import MapState
from core.ledger.postgres import PostgresLedger
from core.maps.selection import Selection
from core.maps.status import IndexStatus, Progress, Tier, no_progress
from core.milvus.collection import Collection
from core.milvus.snapshot import MilvusScope, MilvusSnapshot, scope_of
from core.milvus.writing import MilvusWrite
from core.postgres import rows
from core.postgres.map import PostgresMap

REBUILT_AT_ONCE = 256
"""Places whose entities are made again in one transaction."""


class MilvusMap(PostgresMap):
    """The places of one environment (:class:`core.maps.store.Map`), with an entity in Milvus for each."""

    def __init__(self, database: PostgresLedger, state: MapState, collection: Collection) -> None:
        super().__init__(database, state)
        self.collection = collection
        self._last: MilvusSnapshot | None = None

    @property
    def held(self) -> bool:
        """False: everything comes from other processes."""
        return False

    def snapshot(self) -> MilvusSnapshot:
        """All places at this moment; the same object until the map is written to, or has not been for a while."""
        with self.viewing() as (connection, state):
            self._last = self._snapshot(connection, state)
            return self._last

    def _snapshot(self, connection: MapConnection, state: MapState) -> MilvusSnapshot:
        last = self._last
        if last is not None and last.state == state:
            return last
        return MilvusSnapshot(self.database, self.collection, state, tuple(rows.dead_keys(connection)))

    def scope(self, selection: Selection | None = None) -> MilvusScope:
        with self.viewing() as (connection, state):
            return scope_of(connection, self._snapshot(connection, state), selection)

    def index_status(self) -> IndexStatus:
        """How the map is searched: by Milvus, which compares every place if its collection has no other index."""
        tier: Tier = "exact" if self.collection.index_type == "FLAT" else "compact"
        return IndexStatus(
            setting=self.record.index,
            tier=tier,
            wanted=tier,
            state="ready",
            progress=1,
            rows_indexed=0,
            recall=None,
            bytes_in_memory=0,
        )

    def rebuild_index(self, progress: Progress = no_progress) -> IndexStatus:
        """Give Milvus all descriptors again, some at a time; searches use those that it has meanwhile.

        Args:
            progress: called with the number of places done and of all; its exceptions end the work, and the part done
                until then stays.
        """
        done, after, total = 0, -1, self.latest().searched
        while True:
            with self.rebuilding() as write:
                stored = places.listed_with_looks(write.connection, after, REBUILT_AT_ONCE)
                for place in stored:
                    write.renew_entity(place)
                if not stored:
                    write.move()
            if not stored:
                return self.index_status()
            done, after = done + len(stored), stored[-1].number
            progress(min(done, total), total)

    def _write(self, connection: MapConnection, state: MapState) -> MilvusWrite:
        return MilvusWrite(connection, state, self.collection)

    @contextmanager
    def rebuilding(self) -> Iterator[MilvusWrite]:
        """A write whose entities may go to another collection than the one that has the map's so far."""
        with self._transaction() as whole:
            connection = MapConnection(whole, self.number)
            write = MilvusWrite(connection, self._locked_state(connection), self.collection, True)
            yield write
            write.finish()
        self.note(write.state)

    def _tidy(self, connection: MapConnection) -> None:
        super()._tidy(connection)
        if keys := rows.old_keys(connection):
            self.collection.delete(keys)
            rows.clear_keys(connection, keys)
