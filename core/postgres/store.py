"""All maps of a PostgreSQL database, less what an engine adds."""

from __future__ import annotations

import logging
import secrets
import threading
from abc import ABC, abstractmethod
from collections import OrderedDict
from collections.abc import Callable
from contextlib import AbstractContextManager, suppress
from typing import TYPE_CHECKING, Generic, TypeVar

from core.errors import MapExists, StorageFailure, UnknownMap
from core.ledger import Lock
from core.ledger.maps import record
from core.ledger.maps.connection import MapConnection
from core.ledger.maps.record import MapState
from core.ledger.postgres import LONG_SECONDS, PostgresLedger
from core.maps.archives.reading import Archive
from core.maps.enrolling import CheckDescriptors, any_descriptors
from core.maps.pagination import Listing, decode_name, one_more, page_of
from core.maps.records import MapRecord, MapSettings, Precision, VerifyReport
from core.maps.status import Progress, no_progress
from core.places import check_map_id
from core.postgres.map import PostgresMap
from core.postgres.pictures.bucket import Bucket
from core.postgres.sweep import sweep_objects
from core.postgres.tables import TABLES
from core.storage.archives.importing import Importing
from core.storage.archives.unpacking import check_sizes, layout_of

if TYPE_CHECKING:
    from core.postgres.pictures.objects import Objects

MOST_CONNECTIONS = 16

MOST_MAPS = 1000
"""The largest number of maps with a cached object; a second call for a map returns the same one."""

IMPORTED = ".import-"
"""How the names begin under which imports keep their maps; no map id begins like this."""

ABANDONED_SECONDS = 3600
"""An unlisted map without a write for this time is abandoned."""

SWEEP_SECONDS, AGAIN_SECONDS = 3600.0, 30.0
"""Between two sweeps, and after one that the servers refused."""

MapT = TypeVar("MapT", bound=PostgresMap)
"""The map of an engine."""

log = logging.getLogger(__name__)


class PostgresStore(ABC, Generic[MapT]):
    """Maps by id (:class:`core.maps.store.Store`).

    Any thread may call any method, and any number of processes may use the same maps.
    """

    def __init__(self, address: str, bucket: Bucket | None = None) -> None:
        """Remember where PostgreSQL is; it is connected to when it is first used.

        Its tables are made if they are missing.

        Args:
            address: such as ``postgresql://placerec@localhost/placerec``.
            bucket: where new pictures are put; None: in PostgreSQL.
        """
        self._maps: OrderedDict[int, MapT] = OrderedDict()
        self._making = threading.Lock()
        self._closed = threading.Event()
        self._sweeper: threading.Thread | None = None
        self.database = PostgresLedger(address, TABLES, MOST_CONNECTIONS, statement_seconds=0)
        self.objects = None if bucket is None else _objects_of(bucket)

    # An engine

    @abstractmethod
    def _map_of(self, state: MapState) -> MapT:
        """The map that was found in this state."""

    @abstractmethod
    def _deleting(self, map_: MapT) -> AbstractContextManager[None]:
        """A block in which a map is deleted, around which an engine deletes its own data of it."""

    @abstractmethod
    def verify(self, map_id: str, progress: Progress = no_progress) -> VerifyReport:
        """Read all places of a map, and compare them with what is searched.

        Raises:
            UnknownMap, StorageFailure.
        """

    # Maps

    def create(
        self,
        map_id: str,
        encoder_identity: str,
        dimension: int,
        settings: MapSettings | None = None,
        local_shape: tuple[int, int] = (0, 0),
        unlisted: bool = False,
        precision: Precision = "half",
    ) -> MapT:
        """Make an empty map for the descriptors of one encoder; it is durable when this returns.

        Args:
            dimension, local_shape: of the encoder's descriptors, D and (C, L).
            unlisted: only :meth:`unlisted` finds the map until it is published.
            precision: how its descriptors are stored, and so what is compared.

        Raises:
            InvalidIdentifier: the id is malformed.
            MapExists: the id is taken.
            StorageFull, StorageFailure.
        """
        check_map_id(map_id)
        self._expect_open()
        made = MapRecord.new(map_id, encoder_identity, dimension, local_shape, precision, settings)
        with self.database.transaction(f"create map {map_id!r}", Lock.MAPS) as connection:
            number = record.create(connection, made, listed=not unlisted)
        return self._map(map_id, number)

    def import_map(
        self,
        archive: Archive,
        map_id: str,
        advance: Callable[[int, int], None],
        check_picture: Callable[[bytes], None],
        most_picture_bytes: int,
        before_listing: Callable[[int], None],
        check_descriptors: CheckDescriptors = any_descriptors,
    ) -> None:
        """Make a map of an export file (:meth:`core.maps.store.Store.import_map`)."""
        check_map_id(map_id)
        self._expect_open()
        check_sizes(archive.manifest)
        made = MapRecord.model_validate({**archive.manifest.map.model_dump(), "id": map_id})
        with self.database.transaction(f"import map {map_id!r}") as connection:
            if record.is_taken(connection, map_id):
                raise MapExists(f"There is already a map {map_id!r}.")
            number = record.create(connection, made, f"{IMPORTED}{secrets.token_hex(8)}", listed=False)
        try:
            made_map = self._map(map_id, number)
            layout = layout_of(archive.manifest)
            importing = Importing(
                archive,
                layout,
                advance,
                check_picture,
                most_picture_bytes,
                made_map.writing,
                made_map.review,
                check_descriptors,
            )
            importing.fill()
            before_listing(importing.places)
            with self.database.transaction(f"import map {map_id!r}", Lock.MAPS) as connection:
                record.publish(connection, number, map_id)
        except BaseException:
            with suppress(StorageFailure, UnknownMap):  # the next sweep removes it
                self._remove(map_id, number)
            raise

    def get(self, map_id: str) -> MapT:
        """A map, ready for use; the same object as long as the map is the same.

        Raises:
            UnknownMap, StorageFailure.
        """
        return self._map(map_id, None)

    def find(self, map_id: str) -> MapT:
        """The same as :meth:`get`."""
        return self.get(map_id)

    @property
    def open_maps(self) -> int:
        """The number of maps of which something is in memory."""
        return len(self._maps)

    def opened(self, map_id: str) -> MapT | None:
        """None: only PostgreSQL knows whether a map is still there."""
        return None

    def _map(self, map_id: str, number: int | None) -> MapT:
        self._expect_open()
        with self.database.glancing() as whole:
            if number is None:
                state = record.find(whole, map_id)
            else:
                state = record.state_of(MapConnection(whole, number), map_id)
        with self._making:
            found = self._maps.get(state.number)
            if found is None:
                found = self._maps[state.number] = self._map_of(state)
                while len(self._maps) > MOST_MAPS:
                    self._maps.popitem(last=False)
            self._maps.move_to_end(state.number)
        found.note(state)
        return found

    def unlisted(self) -> dict[str, MapT]:
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

    def publish(self, map_id: str) -> MapT:
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

    def check_writable(self) -> None:
        """Raise unless PostgreSQL answers and takes writes.

        Raises:
            StoreUnavailable, StoreOfAnotherVersion, StorageFailure.
        """
        self._expect_open()
        self.database.check()

    def check_pictures(self) -> None:
        self._expect_open()
        if self.objects is not None:
            self.objects.check()

    def sweep_objects(self) -> int:
        """Delete pictures that nothing names any more from the object store; returns how many that were.

        Raises:
            StoreUnavailable, StorageFailure.
        """
        self._expect_open()
        return 0 if self.objects is None else sweep_objects(self.database, self.objects)

    def sweep(self) -> int:
        """Delete what was left by writes that did not end; returns the number of descriptors.

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
        return 0

    def start_sweeping(self) -> None:
        """Sweep now and from time to time, in a thread of its own, until the store is closed."""

        def swept(sweep: Callable[[], int]) -> float:
            try:
                sweep()
            except StorageFailure as error:
                log.debug("orphans stay for now: %s", error)
                return AGAIN_SECONDS
            except Exception:  # a defect, which must not end the thread
                log.exception("orphans stay for now")
            return SWEEP_SECONDS

        def run() -> None:
            wait = 0.0
            while not self._closed.wait(wait):
                wait = min(swept(self.sweep), swept(self.sweep_objects))

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
        with self._deleting(found), self.database.transaction(f"delete map {map_id!r}", seconds=LONG_SECONDS) as whole:
            connection = MapConnection(whole, found.number)
            record.state_of(connection, map_id, locked=True)
            record.delete_map(connection)
        with self._making:
            self._maps.pop(found.number, None)

    def close(self) -> None:
        """Close the connections, and refuse further reads and writes."""
        self._closed.set()
        if self.objects is not None:
            self.objects.close()
        self.database.close()

    def _expect_open(self) -> None:
        if self._closed.is_set():
            raise StorageFailure("The store is closed.")


def _objects_of(bucket: Bucket) -> Objects:
    from core.postgres.pictures.objects import Objects  # it imports the client of S3

    return Objects(bucket)
