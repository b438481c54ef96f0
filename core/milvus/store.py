"""All maps of a PostgreSQL database and a Milvus."""

from __future__ import annotations

import logging
import threading
from datetime import UTC, datetime

from core.errors import StorageFailure
from core.maps.records import MapRecord, MapSettings
from core.milvus import ledger
from core.milvus.collection import Collection, Connection
from core.milvus.database import Database
from core.milvus.map import MilvusMap
from core.places import check_map_id
from core.storage.pagination import Listing, decode_name, one_more, page_of

log = logging.getLogger(__name__)


class MilvusStore:
    """Maps by id.  Any thread may call any method, and any number of processes may use the same maps."""

    def __init__(
        self, milvus: str, postgres: str, token: str = "", database: str = "", certificate: str | None = None
    ) -> None:
        """Connect to both; PostgreSQL's tables are made if they are missing.

        Args:
            milvus: the address, such as ``http://localhost:19530``; ``https`` for TLS.
            postgres: the address, such as ``postgresql://placerec@localhost/placerec``.
            token, database: of Milvus, ``user:password`` and the name of the database there.
            certificate: path of the file of the authority that Milvus's certificate is checked by.

        Raises:
            StorageFailure: one of them cannot be reached, or refuses.
        """
        self._collections: dict[str, Collection] = {}
        self._making = threading.Lock()
        self._closed = False
        self._database = Database(postgres)
        try:
            self._milvus = Connection(milvus, token, database, certificate)
        except BaseException:
            self._database.close()
            raise

    def create(
        self,
        map_id: str,
        encoder_identity: str,
        dimension: int,
        settings: MapSettings | None = None,
        local_shape: tuple[int, int] = (0, 0),
    ) -> MilvusMap:
        """Make an empty map for the descriptors of one encoder; it is durable when this returns.

        Args:
            dimension, local_shape: of the encoder's descriptors, D and (C, L).

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
            precision="half",
            revision=1,
            created_at=now,
            updated_at=now,
            **(settings or MapSettings()).model_dump(),
        )
        with self._database.transaction(f"create map {map_id!r}") as connection:
            ledger.create(connection, record)
        return self.get(map_id)

    def get(self, map_id: str) -> MilvusMap:
        """A map, ready for use.

        Raises:
            UnknownMap, StorageFailure.
        """
        self._expect_open()
        with self._database.reading() as connection:
            state = ledger.state_of(connection, map_id)
        return MilvusMap(self._database, self._collection(state.record), state)

    def _collection(self, record: MapRecord) -> Collection:
        with self._making:
            if record.encoder not in self._collections:
                self._collections[record.encoder] = Collection(self._milvus, record.encoder, record.dimension)
            return self._collections[record.encoder]

    def records(self, cursor: str | None, limit: int) -> tuple[list[MapRecord], str | None]:
        """A page of the maps' records by id, and the cursor of the next page.

        Raises:
            InvalidCursor.
        """
        wanted = one_more(limit)
        listing: Listing = ["maps"]
        after = decode_name(listing, cursor)
        self._expect_open()
        with self._database.reading() as connection:
            found = ledger.records_after(connection, after, wanted)
        return page_of(listing, found, limit, lambda record: record.id)

    def delete(self, map_id: str) -> None:
        """Delete a map; the deletion is durable when this returns.

        Raises:
            UnknownMap, StorageFull, StorageFailure.
        """
        collection = self.get(map_id).collection
        with self._database.transaction(f"delete map {map_id!r}") as connection:
            keys = ledger.delete(connection, map_id)
        # The number of a deleted map is never used again, so what stays in Milvus is never found.
        try:
            for start in range(0, len(keys), ledger.LEAVINGS_AT_ONCE):
                collection.delete(keys[start : start + ledger.LEAVINGS_AT_ONCE])
        except StorageFailure as error:
            log.warning("Map %s is deleted; its descriptors stay in Milvus: %s", map_id, error)

    def close(self) -> None:
        """Close the connections, and refuse further reads and writes."""
        self._closed = True
        self._milvus.close()
        self._database.close()

    def _expect_open(self) -> None:
        if self._closed:
            raise StorageFailure("The store is closed.")
