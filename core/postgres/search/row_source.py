"""Descriptors, cells and keypoints by row, from the cache or from PostgreSQL."""

from __future__ import annotations

import secrets
from collections.abc import Callable, Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from core.errors import UnknownPlace
from core.ledger.maps.connection import MapConnection
from core.ledger.postgres import PostgresLedger
from core.maps.records import MapRecord
from core.postgres import rows as stored_rows
from core.postgres.forms import Form
from core.postgres.search.cache import RowCache

Kind = Literal["descriptor", "local"]

_READ: dict[Kind, Callable[[MapConnection, Sequence[int]], dict[int, bytes]]] = {
    "descriptor": stored_rows.descriptors_at,
    "local": stored_rows.locals_at,
}


class PostgresRows:
    """Reads rows of one map (:class:`core.storage.search.snapshot.RowSource`).  Any thread may use it.

    A row belongs to the same frame for ever, so what was read stays right; unless the database is restored to an
    earlier moment, and then another object of this class takes its place, which shares nothing with it in the cache.

    part_rows: rows that are compared by one thread.

    Args:
        map_number, record: of the map.
        cache: of all maps.
    """

    part_rows = 128

    def __init__(self, database: PostgresLedger, map_number: int, record: MapRecord, cache: RowCache) -> None:
        self._database, self._map, self._cache = database, map_number, cache
        self._form, self._shape = Form(record), record.local_shape
        self.generation = secrets.token_hex(8)

    def descriptors(self, rows: NDArray[np.int64], _checksums: NDArray[np.uint32]) -> NDArray[np.float32]:
        """The descriptors of rows: float32 [k, D]."""
        return self._form.descriptors(self._stored("descriptor", rows))

    def inner_products(
        self, queries: NDArray[np.float32], rows: NDArray[np.int64], _checksums: NDArray[np.uint32]
    ) -> NDArray[np.float32]:
        """Inner products of queries, float32 [B, D], with the descriptors of rows: float32 [B, k]."""
        return self._form.inner_products(queries, self._stored("descriptor", rows))

    def locals(self, rows: NDArray[np.int64], _checksums: NDArray[np.uint32]) -> NDArray[np.int8]:
        """The local descriptors of rows: int8 [k, C, L]."""
        if not any(self._shape):
            return np.empty((len(rows), *self._shape), np.int8)
        return self._form.locals(self._stored("local", rows))

    def _stored(self, kind: Kind, rows: NDArray[np.int64]) -> list[bytes]:
        """The stored form of rows.

        Raises:
            UnknownPlace: the place of a row was deleted a while ago.
        """
        wanted = [int(row) for row in rows]
        keys = {row: (self.generation, kind, row) for row in wanted}
        cached = self._cache.get(list(keys.values()))
        found = {row: cached[key] for row, key in keys.items() if key in cached}
        if missing := [row for row in keys if row not in found]:
            with self._database.glancing() as connection:
                read = _READ[kind](MapConnection(connection, self._map), missing)
            self._cache.put({keys[row]: value for row, value in read.items()})
            found |= read
        try:
            return [found[row] for row in wanted]
        except KeyError:
            raise UnknownPlace("A place was deleted while it was read.") from None
