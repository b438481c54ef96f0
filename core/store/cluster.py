"""All maps of a PostgreSQL database, which any number of processes may use at the same time."""

from __future__ import annotations

import logging
import secrets
import threading
from collections import OrderedDict
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING

from core.errors import MapExists, StorageFailure, UnknownMap
from core.ledger import Lock
from core.ledger.maps import record
from core.ledger.maps.connection import MapConnection
from core.ledger.maps.schema import ERASED_TABLES, TABLES
from core.ledger.postgres import LONG_SECONDS, PostgresConnection, PostgresLedger, postgres_errors
from core.maps.pagination import Listing, decode_name, one_more, page_of
from core.maps.records import MapRecord, VerifyReport
from core.maps.status import Progress, no_progress
from core.store.following import ROWS_PER_SEGMENT
from core.store.map import Map
from core.store.rows import BYTES, RowCache
from core.store.store import Store

MOST_CONNECTIONS = 16

MOST_MAPS = 1000
"""The largest number of maps with a cached object; a second call for a map returns the same one."""

IMPORTED = ".import-"
"""How the names begin under which imports keep their maps; no map id begins like this."""

ABANDONED_SECONDS = 3600
"""An unlisted map without a write for this time is abandoned."""

SWEEP_SECONDS, AGAIN_SECONDS = 3600.0, 30.0
"""Between two sweeps, and after one that the server refused."""

WAIT_SECONDS = 10
"""A write that waits for others to the same map is refused after this time."""

WRITING = 7061
"""The kind of the locks of the database by which writes to a map are paused; their number is that of the map."""

if TYPE_CHECKING:
    from core.index.milvus import Milvus

log = logging.getLogger(__name__)


class MapRows:
    """The rows of one map in PostgreSQL (:class:`core.store.database.MapDatabase`)."""

    name, shared = "PostgreSQL", True

    def __init__(self, database: PostgresLedger, number: int) -> None:
        self._database, self._number = database, number
        self._paused = threading.local()

    @contextmanager
    def reading(self) -> Iterator[MapConnection]:
        """A transaction that sees the moment of its first statement, and writes nothing."""
        with self._database.reading() as connection:
            yield MapConnection(connection, self._number)

    @contextmanager
    def glancing(self) -> Iterator[MapConnection]:
        """A connection for single statements, each of which sees its own moment."""
        with self._database.glancing() as connection:
            yield MapConnection(connection, self._number)

    @contextmanager
    def fresh(self) -> Iterator[MapConnection]:
        """A connection outside the pool."""
        with self._database.alone("read") as connection:
            yield MapConnection(PostgresConnection(connection), self._number)

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Nobody but this thread writes places during the block; if that cannot be any more, this thread neither."""
        if getattr(self._paused, "connection", None) is not None:
            yield
            return
        with self._database.locked("pause the writes to a map", WRITING, self._number) as connection:
            self._paused.connection = connection
            try:
                yield
            finally:
                self._paused.connection = None

    @contextmanager
    def writing(self, alone: bool = True) -> Iterator[MapConnection]:
        """A transaction that is committed at the end of the block, and undone if it raises."""
        paused: PostgresConnection | None = getattr(self._paused, "connection", None)
        if paused is not None:
            with postgres_errors("write to a map"), paused.driver.transaction():
                yield MapConnection(paused, self._number)
            return
        with self._database.transaction("write to a map") as connection:
            if alone:  # wait until nobody pauses writes, and keep others from pausing them until the transaction ends
                connection.driver.execute(f"SET LOCAL lock_timeout TO '{WAIT_SECONDS}s'")
                lock = "SELECT pg_advisory_xact_lock_shared(%s::int, %s::int)"
                connection.driver.execute(lock, (WRITING, self._number % 2**31))
            yield MapConnection(connection, self._number)

    def room(self) -> None:
        """None: PostgreSQL knows."""
        return

    def give_back(self) -> None:
        """Do nothing: PostgreSQL's disk is its own."""

    def erase(self) -> int:
        """Have PostgreSQL use the room of deleted rows again; 0, for its files stay as large."""
        with self._database.connection("vacuum", LONG_SECONDS) as connection:
            for table in ERASED_TABLES:
                connection.execute(f"VACUUM {table}")
        return 0

    def check(self, *tables: str) -> list[str]:
        """Nothing: PostgreSQL checks its pages itself, where its cluster was made so (``initdb --data-checksums``)."""
        return []


class Cluster(Store):
    """All maps of a PostgreSQL database, searched by FAISS in the memory of each service."""

    def __init__(
        self,
        address: str,
        cache_bytes: int = BYTES,
        rows_per_segment: int = ROWS_PER_SEGMENT,
        milvus: Milvus | None = None,
    ) -> None:
        """Remember where PostgreSQL is; it is connected to when it is first used.

        Its tables are made if they are missing.

        Args:
            address: such as ``postgresql://placerec@localhost/placerec``.
            cache_bytes: most bytes of rows that are kept in memory.
            rows_per_segment: of snapshots.
            milvus: has the codes of large maps; None: memory has those of all.
        """
        self._rows_per_segment, self.milvus = rows_per_segment, milvus
        self._maps: OrderedDict[int, Map] = OrderedDict()
        self._making = threading.Lock()
        self._closed = threading.Event()
        self._sweeper: threading.Thread | None = None
        self._cache = RowCache(cache_bytes)
        self.database = PostgresLedger(address, [TABLES], MOST_CONNECTIONS, statement_seconds=0)

    def _make(self, made: MapRecord, unlisted: bool) -> Map:
        self._expect_open()
        with self.database.transaction(f"create map {made.id!r}", Lock.MAPS) as connection:
            number = record.create(connection, made, listed=not unlisted)
        return self._map(made.id, number)

    @contextmanager
    def _building(self, made: MapRecord) -> Iterator[Map]:
        self._expect_open()
        with self.database.transaction(f"import map {made.id!r}") as connection:
            if record.is_taken(connection, made.id):
                raise MapExists(f"There is already a map {made.id!r}.")
            number = record.create(connection, made, f"{IMPORTED}{secrets.token_hex(8)}", listed=False)
        try:
            yield self._map(made.id, number)
            with self.database.transaction(f"import map {made.id!r}", Lock.MAPS) as connection:
                record.publish(connection, number, made.id)
        except BaseException:
            with suppress(StorageFailure, UnknownMap):  # the next sweep removes it
                self._remove(made.id, number)
            raise

    def get(self, map_id: str) -> Map:
        """A map, ready for use; the same object as long as the map is the same.

        Raises:
            UnknownMap, StorageFailure.
        """
        return self._map(map_id, None)

    def find(self, map_id: str) -> Map:
        """The same as :meth:`get`."""
        return self.get(map_id)

    def opened(self, map_id: str) -> Map | None:
        """None: only PostgreSQL knows whether a map is still there."""
        return None

    def _map(self, map_id: str, number: int | None) -> Map:
        self._expect_open()
        with self.database.glancing() as whole:
            if number is None:
                state = record.find(whole, map_id)
            else:
                state = record.state_of(MapConnection(whole, number), map_id)
        with self._making:
            found = self._maps.get(state.number)
            if found is None:
                rows = MapRows(self.database, state.number)
                found = self._maps[state.number] = Map(rows, state, self._cache, self.milvus, self._rows_per_segment)
                while len(self._maps) > MOST_MAPS:
                    self._maps.popitem(last=False)
            self._maps.move_to_end(state.number)
        found.note(state)
        return found

    def unlisted(self) -> dict[str, Map]:
        self._expect_open()
        with self.database.reading() as connection:
            found = record.unlisted(connection)
        maps = {}
        for name, number in found.items():
            if not name.startswith(IMPORTED):
                with suppress(UnknownMap):  # it is gone, or published
                    maps[name] = self._map(name, number)
        return maps

    def abandoned(self) -> list[str]:
        """None: another service may build them; a sweep removes those that nobody has written to for a while."""
        return []

    def publish(self, map_id: str) -> Map:
        with self.database.transaction(f"publish map {map_id!r}", Lock.MAPS) as connection:
            number = record.unlisted(connection).get(map_id)
            if number is None:
                raise UnknownMap(f"No map {map_id[:80]!r} is being made.")
            record.publish(connection, number, map_id)
        return self._map(map_id, number)

    def abandon(self, map_id: str) -> None:
        self._expect_open()
        with self.database.reading() as connection:
            number = record.unlisted(connection).get(map_id)
        if number is not None:
            with suppress(UnknownMap):
                self._remove(map_id, number)

    def quarantined(self) -> dict[str, str]:
        """No map is ever put out of service alone."""
        return {}

    def verify(self, map_id: str, progress: Progress = no_progress) -> VerifyReport:
        return self.get(map_id).verify(progress)

    def check_writable(self) -> None:
        """Raise unless PostgreSQL answers and takes writes.

        Raises:
            StoreUnavailable, StoreOfAnotherVersion, StorageFailure.
        """
        self._expect_open()
        self.database.check()
        if self.milvus is not None:
            self.milvus.check()

    @property
    def open_maps(self) -> int:
        return sum(one.is_open for one in list(self._maps.values()))

    def sweep(self) -> None:
        """Remove the unlisted maps that nobody has written to for a while.

        Raises:
            StoreUnavailable, StorageFailure.
        """
        self._expect_open()
        with self.database.reading() as connection:
            forgotten = record.unlisted(connection, ABANDONED_SECONDS)
        for name, number in forgotten.items():
            with suppress(UnknownMap):  # it was published, or removed
                log.warning("The unfinished map %s is removed: nobody has written to it for a while", name)
                self._remove(name, number)

    def start_sweeping(self) -> None:
        """Sweep now and from time to time, in a thread of its own, until the store is closed."""

        def run() -> None:
            wait = 0.0
            while not self._closed.wait(wait):
                wait = SWEEP_SECONDS
                try:
                    self.sweep()
                except StorageFailure as error:
                    log.debug("unfinished maps stay for now: %s", error)
                    wait = AGAIN_SECONDS
                except Exception:  # a defect, which must not end the thread
                    log.exception("unfinished maps stay for now")

        self._sweeper = threading.Thread(target=run, name="sweep", daemon=True)
        self._sweeper.start()

    def records(self, cursor: str | None, limit: int) -> tuple[list[MapRecord], str | None]:
        wanted = one_more(limit)
        listing: Listing = ["maps"]
        after = decode_name(listing, cursor)
        self._expect_open()
        with self.database.reading() as connection:
            found = record.records_after(connection, after, wanted)
        return page_of(listing, found, limit, lambda record: record.id)

    def delete(self, map_id: str) -> None:
        self._remove(map_id, None)

    def _remove(self, map_id: str, number: int | None) -> None:
        found = self._map(map_id, number)
        with self.database.transaction(f"delete map {map_id!r}", seconds=LONG_SECONDS) as whole:
            connection = MapConnection(whole, found.number)
            record.state_of(connection, map_id, locked=True)
            record.delete_map(connection)
        with self._making:
            self._maps.pop(found.number, None)
        self._drop_codes(found.record)

    def close(self) -> None:
        """Close the connections, and refuse further reads and writes."""
        self._closed.set()
        for found in list(self._maps.values()):
            found.end()
        self.database.close()

    def _expect_open(self) -> None:
        if self._closed.is_set():
            raise StorageFailure("The store is closed.")
