"""All maps of a PostgreSQL database, searched by FAISS in the memory of each service."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager

from core.index import Coder
from core.ledger.maps.connection import MapConnection
from core.ledger.maps.places import StoredPlace
from core.ledger.maps.record import MapState
from core.maps.records import VerifyReport
from core.maps.status import Progress, no_progress
from core.postgres import rows
from core.postgres.forms import Form
from core.postgres.search.cache import BYTES, RowCache
from core.postgres.search.map import CodedMap
from core.postgres.store import PostgresStore
from core.postgres.verification import inspect


class CodedStore(PostgresStore[CodedMap]):
    """Maps by id (:class:`core.maps.store.Store`), in PostgreSQL alone.

    Args:
        cache_bytes: most bytes of rows that are kept in memory.
        Others: as of :class:`core.postgres.store.PostgresStore`.
    """

    def __init__(self, address: str, cache_bytes: int = BYTES) -> None:
        super().__init__(address)
        self.cache = RowCache(cache_bytes)

    def _map_of(self, state: MapState) -> CodedMap:
        return CodedMap(self.database, state, self.cache)

    @contextmanager
    def _deleting(self, map_: CodedMap) -> Iterator[None]:
        yield

    def verify(self, map_id: str, progress: Progress = no_progress) -> VerifyReport:
        """Read all places of a map, and compare their codes with their descriptors.

        Raises:
            UnknownMap, StorageFailure.
        """
        map_ = self.get(map_id)
        form, coder = Form(map_.record), Coder.of(map_.record.dimension)

        def searched(stored: Sequence[StoredPlace], descriptors: Mapping[int, bytes]) -> dict[int, str]:
            with self.database.reading() as connection:
                codes = rows.codes_at(MapConnection(connection, map_.number), [one.row for one in stored])
            wrong = {}
            for one in stored:
                code, descriptor = codes.get(one.row), descriptors.get(one.row)
                if code is None or descriptor is None:
                    continue
                if coder.encode(form.descriptors([descriptor]))[0].tobytes() != code:
                    wrong[one.row] = f"PostgreSQL: the code of place {one.place.id!r} is damaged; rebuild the index"
            return wrong

        return inspect(map_, progress, searched)
