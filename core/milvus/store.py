"""All maps of a PostgreSQL database and a Milvus."""

from __future__ import annotations

import logging
import secrets
import threading
from collections import OrderedDict
from collections.abc import Callable
from contextlib import suppress
from datetime import UTC, datetime
from typing import TYPE_CHECKING

from core.errors import MapExists, StorageFailure, StoreUnavailable, UnknownMap
from core.maps.archives.reading import Archive
from core.maps.pagination import Listing, decode_name, one_more, page_of
from core.maps.records import MapRecord, MapSettings, Precision, VerifyReport
from core.maps.status import Progress, no_progress
from core.milvus import ledger
from core.milvus.collection import Collection, MilvusConnection
from core.milvus.database import Database
from core.milvus.importing import Importing
from core.milvus.map import MilvusMap
from core.milvus.pictures.bucket import Bucket
from core.milvus.sweep import sweep, sweep_objects
from core.milvus.verification import inspect
from core.places import check_map_id
from core.storage.archives.unpacking import check_sizes, layout_of

if TYPE_CHECKING:
    from core.milvus.pictures.objects import Objects

MOST_MAPS = 1000
"""The largest number of maps with a cached object; a second call for a map returns the same one."""

IMPORTED = ".import-"
"""How the names begin under which imports keep their maps; no map id begins like this."""

ABANDONED_SECONDS = 3600
"""An unlisted map without a write for this time is abandoned."""

SWEEP_SECONDS, AGAIN_SECONDS = 3600.0, 30.0
"""Between two sweeps, and after one that the servers refused."""

log = logging.getLogger(__name__)


class MilvusStore:
    """Maps by id (:class:`core.maps.store.Store`).

    Any thread may call any method, and any number of processes may use the same maps.
    """

    def __init__(
        self,
        milvus: str,
        postgres: str,
        token: str = "",
        database: str = "",
        certificate: str | None = None,
        bucket: Bucket | None = None,
    ) -> None:
        """Remember where both are; they are connected to when they are first used.

        PostgreSQL's tables are made if they are missing.

        Args:
            milvus: the address, such as ``http://localhost:19530``; ``https`` for TLS.
            postgres: the address, such as ``postgresql://placerec@localhost/placerec``.
            token, database: of Milvus, ``user:password`` and the name of the database there.
            certificate: path of the file of the authority that Milvus's certificate is checked by.
            bucket: where new pictures are put; None: in PostgreSQL.
        """
        self._collections: dict[str, Collection] = {}
        self._maps: OrderedDict[int, MilvusMap] = OrderedDict()
        self._making = threading.Lock()  # of both
        self._closed = threading.Event()
        self._sweeper: threading.Thread | None = None
        self._database = Database(postgres)
        self._milvus = MilvusConnection(milvus, token, database, certificate)
        self._objects = None if bucket is None else _objects_of(bucket)

    def create(
        self,
        map_id: str,
        encoder_identity: str,
        dimension: int,
        settings: MapSettings | None = None,
        local_shape: tuple[int, int] = (0, 0),
        unlisted: bool = False,
        precision: Precision = "half",
    ) -> MilvusMap:
        """Make an empty map for the descriptors of one encoder; it is durable when this returns.

        Args:
            dimension, local_shape: of the encoder's descriptors, D and (C, L).
            unlisted: only :meth:`unlisted` finds the map until it is published.
            precision: how its descriptors are stored in PostgreSQL, and so what Milvus compares.

        Raises:
            InvalidIdentifier: the id is malformed.
            MapExists: the id is taken.
            StorageFull, StorageFailure.
        """
        check_map_id(map_id)
        self._expect_open()
        now = datetime.now(UTC)
        record = MapRecord(
            id=map_id,
            encoder=encoder_identity,
            dimension=dimension,
            local_cells=local_shape[0],
            local_values=local_shape[1],
            precision=precision,
            revision=1,
            created_at=now,
            updated_at=now,
            **(settings or MapSettings()).model_dump(),
        )
        with self._database.transaction(f"create map {map_id!r}") as connection:
            number = ledger.create(connection, record, listed=not unlisted)
        return self._map(map_id, number)

    def import_map(
        self,
        archive: Archive,
        map_id: str,
        advance: Callable[[int, int], None],
        check_picture: Callable[[bytes], None],
        most_picture_bytes: int,
        before_listing: Callable[[], None],
    ) -> None:
        """Make a map of an export file (:meth:`core.maps.store.Store.import_map`)."""
        check_map_id(map_id)
        self._expect_open()
        check_sizes(archive.manifest)
        record = MapRecord.model_validate({**archive.manifest.map.model_dump(), "id": map_id})
        with self._database.transaction(f"import map {map_id!r}") as connection:
            if ledger.is_taken(connection, map_id):
                raise MapExists(f"There is already a map {map_id!r}.")
            number = ledger.create(connection, record, f"{IMPORTED}{secrets.token_hex(8)}", listed=False)
        try:
            made = self._map(map_id, number)
            importing = Importing(archive, layout_of(archive.manifest), advance, check_picture, most_picture_bytes)
            importing.into(made, self._database)
            before_listing()
            with self._database.transaction(f"import map {map_id!r}") as connection:
                ledger.publish(connection, number, map_id)
        except BaseException:
            with suppress(StorageFailure, UnknownMap):  # the next sweep removes it
                self._remove(map_id, number)
            raise

    def get(self, map_id: str) -> MilvusMap:
        """A map, ready for use; the same object as long as the map is the same.

        Raises:
            UnknownMap, StorageFailure.
        """
        return self._map(map_id, None)

    def find(self, map_id: str) -> MilvusMap:
        """The same as :meth:`get`."""
        return self.get(map_id)

    def opened(self, map_id: str) -> MilvusMap | None:
        """None: only PostgreSQL knows whether a map is still there."""
        return None

    def _map(self, map_id: str, number: int | None) -> MilvusMap:
        self._expect_open()
        with self._database.reading() as connection:
            state = ledger.state_of(connection, map_id, number)
        with self._making:
            found = self._maps.get(state.number)
            if found is None:
                found = MilvusMap(self._database, self._collection(state.record), state, self._objects)
                self._maps[state.number] = found
                while len(self._maps) > MOST_MAPS:
                    self._maps.popitem(last=False)
            self._maps.move_to_end(state.number)
        found.note(state)
        return found

    def unlisted(self) -> dict[str, MilvusMap]:
        self._expect_open()
        with self._database.reading() as connection:
            found = ledger.unlisted(connection)
        maps = {}
        for name, number in found.items():
            if not name.startswith(IMPORTED):
                with suppress(UnknownMap):  # it is gone, or published
                    maps[name] = self._map(name, number)
        return maps

    def abandoned(self) -> list[str]:
        """None: another service may build them; a sweep removes those that nobody has written to for a while."""
        return []

    def publish(self, map_id: str) -> MilvusMap:
        with self._database.transaction(f"publish map {map_id!r}") as connection:
            number = ledger.unlisted(connection).get(map_id)
            if number is None:
                raise UnknownMap(f"No map {map_id[:80]!r} is being made.")
            ledger.publish(connection, number, map_id)
        return self._map(map_id, number)

    def abandon(self, map_id: str) -> None:
        self._expect_open()
        with self._database.reading() as connection:
            number = ledger.unlisted(connection).get(map_id)
        if number is not None:
            with suppress(UnknownMap):
                self._remove(map_id, number)

    def quarantined(self) -> dict[str, str]:
        """No map is ever put out of service alone."""
        return {}

    def verify(self, map_id: str, progress: Progress = no_progress) -> VerifyReport:
        """Read all places of a map, and compare their descriptors with those that Milvus searches.

        Raises:
            UnknownMap, StorageFailure.
        """
        return inspect(self.get(map_id), progress)

    def check_writable(self) -> None:
        """Raise unless both servers answer, and PostgreSQL takes writes.

        Raises:
            StoreUnavailable, StoreOfAnotherVersion, StorageFailure.
        """
        self._expect_open()
        self._database.check()
        self._milvus.check()
        with self._database.reading() as connection:
            used = ledger.used_collections(connection)
        there = []
        for collection in list(self._collections.values()):
            collection.check()
            there.append(collection.id)
        if used and there and not set(used) & set(there):
            some = ", ".join(sorted(map_id for maps in used.values() for map_id in maps)[:3])
            raise StoreUnavailable(
                f"Milvus has no map's descriptors, not those of {some} either. Connect to the Milvus and the database"
                " of it that have, or rebuild the maps' indexes if they have lost them."
            )

    def check_pictures(self) -> None:
        self._expect_open()
        if self._objects is not None:
            self._objects.check()

    def sweep_objects(self) -> int:
        """Delete pictures that nothing names any more from the object store; returns how many that were.

        Raises:
            StoreUnavailable, StorageFailure.
        """
        self._expect_open()
        return 0 if self._objects is None else sweep_objects(self._database, self._objects)

    def sweep(self) -> int:
        """Delete the orphans of writes that did not end; returns the number of descriptors.

        Raises:
            StoreUnavailable, StorageFailure.
        """
        self._expect_open()
        with self._database.reading() as connection:
            forgotten = ledger.unlisted(connection, ABANDONED_SECONDS)
            encoders, used = ledger.encoders(connection), ledger.used_collections(connection)
        for name, number in forgotten.items():
            with suppress(UnknownMap):  # it was published, or removed
                log.warning("The unfinished map %s is removed: nobody has written to it for a while", name)
                self._remove(name, number)
        # A collection without a map of this database may be another database's.
        ours = [self._collection_of(*encoder) for encoder in encoders]
        return sweep(self._database, [collection for collection in ours if collection.id in used])

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

    def _collection(self, record: MapRecord) -> Collection:
        if record.encoder not in self._collections:
            self._collections[record.encoder] = Collection(self._milvus, record.encoder, record.dimension)
        return self._collections[record.encoder]

    def _collection_of(self, encoder: str, dimension: int) -> Collection:
        with self._making:
            if encoder not in self._collections:
                self._collections[encoder] = Collection(self._milvus, encoder, dimension)
            return self._collections[encoder]

    def records(self, cursor: str | None, limit: int) -> tuple[list[MapRecord], str | None]:
        wanted = one_more(limit)
        listing: Listing = ["maps"]
        after = decode_name(listing, cursor).partition("\0")[0]  # which no name has
        self._expect_open()
        with self._database.reading() as connection:
            found = ledger.records_after(connection, after, wanted)
        return page_of(listing, found, limit, lambda record: record.id)

    def delete(self, map_id: str) -> None:
        self._remove(map_id, None)

    def _remove(self, map_id: str, number: int | None) -> None:
        found = self._map(map_id, number)
        collection = found.collection
        with self._database.transaction(f"delete map {map_id!r}") as connection:
            keys = ledger.delete(connection, map_id, found.number)
        with self._making:
            self._maps.pop(found.number, None)
        # The number of a deleted map is never used again, so what stays in Milvus is never found.
        try:
            for start in range(0, len(keys), ledger.ORPHANS_AT_ONCE):
                collection.delete(keys[start : start + ledger.ORPHANS_AT_ONCE])
        except StorageFailure as error:
            log.warning("Map %s is deleted; its descriptors stay in Milvus: %s", map_id, error)

    def close(self) -> None:
        """Close the connections, and refuse further reads and writes."""
        self._closed.set()
        self._milvus.close()
        if self._objects is not None:
            self._objects.close()
        self._database.close()

    def _expect_open(self) -> None:
        if self._closed.is_set():
            raise StorageFailure("The store is closed.")


def _objects_of(bucket: Bucket) -> Objects:
    from core.milvus.pictures.objects import Objects  # it imports the client of S3

    return Objects(bucket)
