"""All maps of a PostgreSQL database, searched by a Milvus."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager

import numpy as np

from core.errors import StorageFailure, StoreUnavailable
from core.ledger.maps import record
from core.ledger.maps.places import StoredPlace
from core.ledger.maps.record import MapState
from core.maps.records import MapRecord, VerifyReport
from core.maps.status import Progress, no_progress
from core.milvus.collection import Collection, MilvusConnection
from core.milvus.map import MilvusMap
from core.milvus.sweep import sweep
from core.postgres import rows
from core.postgres.forms import Form
from core.postgres.store import PostgresStore
from core.postgres.verification import inspect

log = logging.getLogger(__name__)


class MilvusStore(PostgresStore[MilvusMap]):
    """Maps by id (:class:`core.maps.store.Store`), in PostgreSQL and Milvus."""

    def __init__(
        self, milvus: str, postgres: str, token: str = "", database: str = "", certificate: str | None = None
    ) -> None:
        """Remember where both are; they are connected to when they are first used.

        Args:
            milvus: the address, such as ``http://localhost:19530``; ``https`` for TLS.
            postgres: as of :class:`core.postgres.store.PostgresStore`.
            token, database: of Milvus, ``user:password`` and the name of the database there.
            certificate: path of the file of the authority that Milvus's certificate is checked by.
        """
        super().__init__(postgres)
        self._collections: dict[str, Collection] = {}
        self._milvus = MilvusConnection(milvus, token, database, certificate)

    def _map_of(self, state: MapState) -> MilvusMap:
        return MilvusMap(self.database, state, self._collection(state.record))

    def _collection(self, made: MapRecord) -> Collection:
        """The collection of a map's encoder; ``_making`` is held."""
        return self._collection_of(made.encoder, made.dimension)

    def _collection_of(self, encoder: str, dimension: int) -> Collection:
        if encoder not in self._collections:
            self._collections[encoder] = Collection(self._milvus, encoder, dimension)
        return self._collections[encoder]

    @contextmanager
    def _deleting(self, map_: MilvusMap) -> Iterator[None]:
        with map_.viewing() as (connection, _):
            keys = rows.all_keys(connection)
        yield
        # The number of a deleted map is never used again, so what stays in Milvus is never found.
        try:
            for start in range(0, len(keys), rows.ORPHANS_AT_ONCE):
                map_.collection.delete(keys[start : start + rows.ORPHANS_AT_ONCE])
        except StorageFailure as error:
            log.warning("Map %s is deleted; its descriptors stay in Milvus: %s", map_.record.id, error)

    def verify(self, map_id: str, progress: Progress = no_progress) -> VerifyReport:
        """Read all places of a map, and compare their descriptors with those that Milvus searches.

        Raises:
            UnknownMap, StorageFailure.
        """
        map_ = self.get(map_id)
        collection = map_.collection

        def searched(stored: Sequence[StoredPlace], descriptors: Mapping[int, bytes]) -> dict[int, str]:
            there, form = collection.descriptors_of([one.key or 0 for one in stored]), Form(map_.record)
            wrong = {}
            for one in stored:
                if (found := there.get(one.key or 0)) is None:
                    wrong[one.row] = f"Milvus: place {one.place.id!r} is missing; rebuild the index"
                elif one.row in descriptors and not np.array_equal(found, form.descriptors([descriptors[one.row]])[0]):
                    ours = f"the descriptor of place {one.place.id!r} is not the one in PostgreSQL"
                    wrong[one.row] = f"Milvus: {ours}; rebuild the index"
            return wrong

        return inspect(map_, progress, searched)

    def check_writable(self) -> None:
        """Raise unless both servers answer, and PostgreSQL takes writes.

        Raises:
            StoreUnavailable, StoreOfAnotherVersion, StorageFailure.
        """
        super().check_writable()
        self._milvus.check()
        with self.database.reading() as connection:
            used = record.used_collections(connection)
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

    def sweep(self) -> int:
        """Delete the entities of writes that did not end, and unfinished maps; returns the number of entities.

        Raises:
            StoreUnavailable, StorageFailure.
        """
        super().sweep()
        with self.database.reading() as connection:
            encoders, used = record.encoders(connection), record.used_collections(connection)
        # A collection without a map of this database may be another database's.
        with self._making:
            ours = [self._collection_of(*encoder) for encoder in encoders]
        return sweep(self.database, [collection for collection in ours if collection.id in used])

    def close(self) -> None:
        """Close the connections, and refuse further reads and writes."""
        self._milvus.close()
        super().close()
